"""Kernels that each command calls, with the types of their arguments, to compile them beforehand.

    python -m benchmarks.kernel_signatures            # print what the table lacks and has too many
    python -m benchmarks.kernel_signatures --write    # write engine/operations/kernel_signatures.json
    python -m benchmarks.kernel_signatures --time     # compile all of it once more and write the seconds

Runs the commands on a small generated scene and notes the kernels in the order of their first call. A kernel
that is new to the table is given the seconds that its compilation took there, if any.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from octasplat.engine.operations.precompile import FIRST_ITERATION, TABLE

PROCESSES = 4
Table = dict[str, Any]
RUN = ("--max-side", "320", "--iterations", "60", "--set", "max_gaussians=2000", "--threads", "1")
"""Of the reconstruction: short, and long enough for each kind of iteration. The photographs are large enough
for rays that are traced alone, as those of users are."""


def commands(folder: Path) -> dict[str, list[list[str]]]:
    """Return the commands of each group; those of one group run one after another."""
    run, stage = str(folder / "run"), str(folder / "stage.toml")
    views = ("--views", "held-out", "--max-side", "64", "--threads", "1")
    return {
        "reconstruct": [["reconstruct", str(folder / "scene"), "-o", run, "--preset", "fast", *RUN]],
        "evaluate": [["evaluate", run]],
        "info": [["info", run], ["info", f"{run}/scene.ply"]],
        "stage-init": [["stage", "init", run, "-o", stage]],
        "export": [["export", run, str(folder / "mesh.glb")], ["export", run, str(folder / "scene.spz")]],
        "render": [
            ["render", run, "-o", str(folder / "views"), *views],
            ["render", run, "--turntable", "--frames", "1", "--width", "64", "--height", "64", "-o",
             str(folder / "turn")],
        ],
        "render-stage": [
            ["render", run, "--stage", stage, "-o", str(folder / "staged.png"), "--preview"],
        ],
        "surface": [["surface", run, "-o", str(folder / "surface.glb"), "--resolution", "48"]],
    }  # fmt: skip


def record(arguments: list[str]) -> list[dict[str, Any]]:
    """Run a command in this process; return its kernels in the order of their first call."""
    from numba.core.caching import NullCache
    from numba.core.dispatcher import Dispatcher

    from octasplat.engine.core.events import TrainingProgress
    from octasplat.engine.trace.kernels.native import NativeCallback

    called: list[tuple[Any, Any, float, bool]] = []
    compile_overload = Dispatcher.compile
    make_event, has_begun = TrainingProgress.__init__, False

    def note_progress(self: Any, *values: Any, **named: Any) -> None:
        nonlocal has_begun
        has_begun = True
        make_event(self, *values, **named)

    def note(self: Any, signature: Any) -> Any:
        began = time.thread_time()
        try:
            return compile_overload(self, signature)
        finally:
            if not isinstance(self._cache, NullCache):
                called.append((self, signature, time.thread_time() - began, has_begun))

    compile_callback = NativeCallback.compile

    def note_callback(self: NativeCallback) -> Any:
        began = time.thread_time()
        try:
            return compile_callback(self)
        finally:
            called.append((self.function, (), time.thread_time() - began, has_begun))

    Dispatcher.compile = note
    NativeCallback.compile = note_callback  # type: ignore[method-assign]
    TrainingProgress.__init__ = note_progress  # type: ignore[method-assign]
    from octasplat.engine.core.kernel_signatures import encode_type
    from octasplat.workers.cli.main import main

    sys.argv = ["octasplat", *arguments]
    try:
        main()
    except SystemExit as end:
        if end.code not in (0, None):
            raise
    return [
        {
            "module": kernel.__module__,
            "function": kernel.__name__,
            "arguments": list(map(encode_type, types)),
            "seconds": round(seconds, 2),
            "is_after_first_iterations": is_late,
        }
        for kernel, types, seconds, is_late in called
    ]


def collect(folder: Path) -> Table:
    """Run all commands, the reconstruction first and the others beside each other; return the table."""
    from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset

    config = SyntheticDatasetConfig(views=8, width_px=320, height_px=240, samples_per_side=1, points=200)
    write_synthetic_dataset(folder / "scene", config)

    def kernels_of_group(group: str, lines: list[list[str]]) -> list[dict[str, Any]]:
        found = []
        for number, line in enumerate(lines):
            noted = folder / f"{group}-{number}.json"
            subprocess.run(
                [sys.executable, "-m", "benchmarks.kernel_signatures", "--record", str(noted), *line],
                stdout=subprocess.DEVNULL,
                check=True,
            )
            found += json.loads(noted.read_text())
        return found

    (first, *others), noted = commands(folder).items(), {}
    noted[first[0]] = kernels_of_group(*first)
    with ThreadPoolExecutor(PROCESSES) as pool:
        names = [name for name, _ in others]
        noted |= zip(names, pool.map(lambda item: kernels_of_group(*item), others), strict=True)
    seconds: dict[str, float] = {}
    groups: dict[str, list[str]] = {}
    for group, kernels in noted.items():
        for kernel in kernels:
            took, is_late, key = kernel["seconds"], kernel.pop("is_after_first_iterations"), identity(kernel)
            seconds[key] = max(took, seconds.get(key, 0.0))
            if group == "reconstruct" and not is_late:
                groups.setdefault(FIRST_ITERATION, []).append(key)
            groups.setdefault(group, []).append(key)
    order = list(seconds)
    return {
        "groups": {name: list(dict.fromkeys(map(order.index, keys))) for name, keys in groups.items()},
        "kernels": [{**json.loads(key), "seconds": took} for key, took in seconds.items()],
    }


def time_kernels(table: Table) -> None:
    """Compile all kernels in this process, into an empty cache; put the CPU seconds into the table."""
    with tempfile.TemporaryDirectory() as code:
        os.environ["NUMBA_CACHE_DIR"] = code
        from octasplat.engine.core.kernel_signatures import compile_kernel

        for kernel in table["kernels"]:
            began = time.thread_time()
            compile_kernel(kernel["module"], kernel["function"], kernel["arguments"], skip_busy=False)
            kernel["seconds"] = round(time.thread_time() - began, 2)


def write(table: Table) -> None:
    """Write the table with a line a kernel."""
    lines = ",\n".join(f"    {json.dumps(kernel)}" for kernel in table["kernels"])
    groups = ",\n".join(f'    "{group}": {found}' for group, found in table["groups"].items())
    TABLE.write_text(f'{{\n  "groups": {{\n{groups}\n  }},\n  "kernels": [\n{lines}\n  ]\n}}\n')


def identity(kernel: dict[str, Any]) -> str:
    """Return the kernel and its arguments as text."""
    return json.dumps({name: value for name, value in kernel.items() if name != "seconds"})


def main() -> None:
    """Compare or write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--time", action="store_true")
    arguments = parser.parse_args()
    former: Table = json.loads(TABLE.read_text())
    if arguments.time:
        time_kernels(former)
        write(former)
        return
    with tempfile.TemporaryDirectory() as name:
        table = collect(Path(name))
    known = {identity(kernel): kernel["seconds"] for kernel in former["kernels"]}
    found = set(map(identity, table["kernels"]))
    if arguments.write:
        for kernel in table["kernels"]:
            kernel["seconds"] = known.get(identity(kernel), kernel["seconds"])
        write(table)
        return
    for mark, rows in (("lacks", found - known.keys()), ("has too many", known.keys() - found)):
        for row in sorted(rows):
            print(f"{mark}: {row}")
    sys.exit(1 if found - known.keys() else 0)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--record"]:
        Path(sys.argv[2]).write_text(json.dumps(record(sys.argv[3:])))
    else:
        main()
