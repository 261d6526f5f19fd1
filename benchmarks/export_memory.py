"""Peak memory beyond the scene's own arrays, and CPU time, of writing and reading it in every format.

    python -m benchmarks.export_memory [COUNT ...] [--format NAME ...] [--sh-degree 3] [--folder FOLDER]

Each step runs in a process of its own. Another process reads its anonymous memory (``RssAnon``, which leaves
out pages of files) every few milliseconds. ``losses`` is :func:`octasplat.engine.files.dropped_on_export`,
which every export command asks first.
"""

import argparse
import select
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from octasplat.engine.files import dropped_on_export, export_scene, read_scene
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.splat_transform import find_converter
from octasplat.engine.gaussians.model import FlatGaussians

FILES = {
    "ply": "scene.ply",
    "compressed-ply": "scene.compressed.ply",
    "splat": "scene.splat",
    "spz3": "scene.spz",
    "spz4": "scene.spz",
    "khr-glb": "scene.splats.glb",
    "octagon-glb": "scene.glb",
    "mesh-ply": "scene.mesh.ply",
    "obj": "scene.obj",
    "3d-tiles": "tiles/tileset.json",
    "usd": "scene.usdc",
    "sog": "scene.sog",
    "streamed-sog": "streamed/lod-meta.json",
}
READ = ("ply", "compressed-ply", "splat", "spz3", "spz4", "khr-glb", "octagon-glb", "mesh-ply", "sog")
NEEDS_PROGRAM = ("sog", "streamed-sog")
POLL_SECONDS = 0.002
READY, DONE = "ready", "done"


def random_scene(count: int, sh_degree: int) -> FlatGaussians:
    """Gaussians of plausible size, opacity and color, in no order."""
    random = np.random.default_rng(0)

    def normal(*shape: int, scale: float = 1.0, shift: float = 0.0) -> np.ndarray:
        values = random.standard_normal(shape, dtype=np.float32)
        values *= np.float32(scale)
        values += np.float32(shift)
        return values

    return FlatGaussians(
        normal(count, 3, scale=3.0),
        normal(count, 4),
        normal(count, 2, scale=0.5, shift=-4.0),
        normal(count, scale=2.0),
        normal(count, (sh_degree + 1) ** 2, 3, scale=0.3),
    )


def scene_bytes(count: int, sh_degree: int) -> int:
    """Bytes of the arrays of a scene."""
    return 4 * count * (10 + 3 * (sh_degree + 1) ** 2)


def work(action: str, name: str, path: Path, count: int, sh_degree: int) -> None:
    """Do one step in this process; the other one is told where it begins and ends."""
    options = ExportOptions(spz_version=4) if name == "spz4" else ExportOptions()
    small = path.parent / "small" / path.name
    if action != "read":
        scene = random_scene(count, sh_degree)
        small.parent.mkdir(parents=True, exist_ok=True)
        dropped_on_export(scene.select(np.arange(300)), [small])
        export_scene(scene.select(np.arange(300)), small, options)
    else:
        read_scene(small)
    tell(READY)
    began = time.process_time()
    if action == "losses":
        dropped_on_export(scene, [path])
    elif action == "write":
        export_scene(scene, path, options)
    else:
        found, _ = read_scene(path)
    seconds = time.process_time() - began
    tell(f"{DONE} {seconds} {len(found) if action == 'read' else count}")


def tell(line: str) -> None:
    """Tell the process that measures, and wait for it."""
    print(line, flush=True)
    sys.stdin.readline()


def anonymous_bytes(pid: int) -> int:
    """Anonymous memory of a process now, with that of the programs that it has started."""
    total = 0
    for process in [pid, *children_of(pid)]:
        try:
            status = Path(f"/proc/{process}/status").read_text()
        except OSError:
            continue
        total += sum(int(line.split()[1]) for line in status.splitlines() if line.startswith("RssAnon"))
    return 1024 * total


def children_of(pid: int) -> list[int]:
    """Return the ids of the programs that a process has started."""
    try:
        children = [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
        # until it is another program it shares the memory of the one that starts it
        return [child for child in children if _command_of(child) != _command_of(pid)]
    except OSError:
        return []


def _command_of(pid: int) -> bytes:
    return Path(f"/proc/{pid}/cmdline").read_bytes()


def measure(action: str, name: str, path: Path, count: int, sh_degree: int) -> tuple[float, int, int]:
    """Return the CPU seconds of a step, the peak of the bytes beyond those before, and its Gaussians.

    Raises:
        RuntimeError: the step failed.
    """
    command = ["benchmarks.export_memory", str(count), "--step", action]
    return measured([*command, "--format", name, "--sh-degree", str(sh_degree), "--folder", str(path)])


def measured(module: list[str]) -> tuple[float, int, int]:
    """Run a module that tells where its work begins and ends; return what :func:`measure` does.

    Args:
        module: its name, and arguments.

    Raises:
        RuntimeError: it failed.
    """
    failure = RuntimeError(f"{' '.join(module)} failed")
    command = [sys.executable, "-m", *module]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None and process.stdout is not None
        if process.stdout.readline().strip() != READY:
            raise failure
        before = peak = anonymous_bytes(process.pid)
        process.stdin.write("\n")
        process.stdin.flush()
        while not select.select([process.stdout], [], [], POLL_SECONDS)[0]:
            peak = max(peak, anonymous_bytes(process.pid))
        words = process.stdout.readline().split()
        if words[:1] != [DONE]:
            raise failure
        process.stdin.write("\n")
        process.stdin.flush()
    return float(words[1]), peak - before, int(words[2])


def print_rows(name: str, count: int, sh_degree: int, place: Path) -> None:
    """Print the row of each step of a format."""
    with tempfile.TemporaryDirectory(dir=place) as folder:
        path = Path(folder) / FILES[name]
        path.parent.mkdir(exist_ok=True)
        for action in ("losses", "write", "read"):
            if action == "read" and name not in READ:
                continue
            try:
                seconds, peak, found = measure(action, name, path, count, sh_degree)
            except RuntimeError as error:
                print(f"{count:>10,}  {error}", flush=True)
                return
            # what was read is not beyond the scene
            beyond = peak - (scene_bytes(found, sh_degree_of(name, sh_degree)) if action == "read" else 0)
            size = sum(file.stat().st_size for file in Path(folder).rglob("*") if file.is_file())
            memory = f"{beyond / count:8.1f} B a Gaussian, {beyond / 1e6:8.0f} MB"
            rest = f"{seconds:7.1f} s of CPU, {size / 1e6:8.0f} MB on disk"
            print(f"{count:>10,}  {name:14} {action:6} {memory}, {rest}", flush=True)


def sh_degree_of(name: str, sh_degree: int) -> int:
    """Return the degree of the harmonics that a format keeps."""
    return 0 if name in ("splat", "octagon-glb", "mesh-ply") else sh_degree


def main() -> None:
    """Print a row for each count, format and step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("counts", nargs="*", type=int, default=[500_000, 2_000_000])
    parser.add_argument("--format", action="append", choices=list(FILES))
    parser.add_argument("--sh-degree", type=int, default=3)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--step", choices=("losses", "write", "read"))
    given = parser.parse_args()
    if given.step is not None:
        work(given.step, given.format[0], given.folder, given.counts[0], given.sh_degree)
        return
    print(
        f"scene itself: {scene_bytes(1, given.sh_degree)} B a Gaussian; below what each step takes beyond it"
    )
    has_program = find_converter() is not None
    for name in given.format or [name for name in FILES if has_program or name not in NEEDS_PROGRAM]:
        for count in given.counts:
            print_rows(name, count, given.sh_degree, given.folder)


if __name__ == "__main__":
    main()
