"""What commands cost with an empty kernel cache, and with a full one.

    python -m benchmarks.cold_start                 # all commands; prints a Markdown table
    python -m benchmarks.cold_start info render     # some of them

Each command is run on a small generated run with an empty cache of its own, as on a fresh machine, and then
again with what that left there. CPU seconds are those of the command and of all processes that it started;
they hardly depend on what else the machine does, which the wall time does.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from octasplat.engine.core.kernel_folder import CACHE_VARIABLE
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset

RUN = ("--iterations", "300", "--rays-per-batch", "4096", "--max-gaussians", "10000")
COMMANDS: dict[str, tuple[str, ...]] = {
    "reconstruct": ("reconstruct", "{scene}", "-o", "{out}", *RUN),
    "reconstruct --materials": ("reconstruct", "{scene}", "-o", "{out}", "--materials", *RUN),
    "evaluate": ("evaluate", "{run}"),
    "info": ("info", "{run}"),
    "export scene.spz": ("export", "{run}", "{out}.spz"),
    "export mesh.glb": ("export", "{run}", "{out}.glb"),
    "surface": ("surface", "{run}", "-o", "{out}.glb", "--max-triangles", "10000"),
    "render": ("render", "{run}", "-o", "{out}"),
    "stage init": ("stage", "init", "{run}", "-o", "{out}.toml"),
    "render --stage": ("render", "{run}", "-o", "{out}", "--stage", "{stage}"),
    "clean": ("clean", "{run}", "-o", "{out}.ply", "--min-opacity", "0.01"),
    "simplify": ("simplify", "{run}", "-o", "{out}.ply", "-n", "1000"),
    "transform": ("transform", "{run}", "-o", "{out}.ply", "--scale", "2"),
}
"""Commands by the name that the table has, with the places of their files."""


def run_command(words: tuple[str, ...], places: dict[str, Path], cache: Path) -> tuple[float, float]:
    """Run a command; return its CPU and wall seconds.

    Raises:
        RuntimeError: it failed.
    """
    environment = {**os.environ, CACHE_VARIABLE: str(cache)}
    command = [sys.executable, "-m", "octasplat", *(word.format(**places) for word in words)]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}: {done.stderr[-2000:]}")
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return cpu, time.monotonic() - began


def main() -> None:
    """Measure the commands that are named, or all of them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("names", nargs="*", metavar="COMMAND", help=f"of {', '.join(COMMANDS)}")
    names = parser.parse_args().names or list(COMMANDS)
    if unknown := set(names) - set(COMMANDS):
        parser.error(f"there is no {' and no '.join(sorted(unknown))} here")
    with tempfile.TemporaryDirectory(prefix="octasplat-cold-") as folder:
        root = Path(folder)
        scene, shared = root / "scene", root / "cache"
        write_synthetic_dataset(
            scene, SyntheticDatasetConfig(views=12, width_px=160, height_px=120, points=2000)
        )
        places = {"scene": scene, "out": root / "run"}
        run_command(COMMANDS["reconstruct"], places, shared)
        places = {**places, "run": root / "run", "stage": root / "stage.toml"}
        run_command(COMMANDS["stage init"], {**places, "out": root / "stage"}, shared)
        print("| command | CPU cold | CPU warm | wall cold | wall warm |\n|---|---|---|---|---|")
        for number, name in enumerate(names):
            cache = root / f"cache{number}"
            found = [
                run_command(COMMANDS[name], {**places, "out": root / f"out{number}{state}"}, cache)
                for state in ("cold", "warm")
            ]
            (cpu_cold, wall_cold), (cpu_warm, wall_warm) = found
            row = (cpu_cold, cpu_warm, wall_cold, wall_warm)
            print(f"| `{name}` | " + " | ".join(f"{value:.1f} s" for value in row) + " |", flush=True)


if __name__ == "__main__":
    main()
