"""How time and memory of a training in blocks grow with the number of photographs, at one density.

    python -m benchmarks.large_growth -o FOLDER [--views 250 500 1000 2000] [--each 250]

Makes a street for each number of views, longer with more of them, so that every metre is seen alike
(``scene="street"`` of ``octasplat.engine.dataset.synthetic``, a house on each side for 125 views). Trains it
with ``--preset fast --threads 1`` in one block for each ``--each`` views, in a process of its own, and prints
a table of Markdown. What is there already is kept, so that an interrupted benchmark goes on.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path

from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset

VIEWS_PER_HOUSE = 125
POINTS_PER_VIEW = 60


def street_of(views: int) -> SyntheticDatasetConfig:
    """Return the street of so many views."""
    return SyntheticDatasetConfig(
        views=views, width_px=320, height_px=240, samples_per_side=2, points=POINTS_PER_VIEW * views,
        scene="street", houses=max(1, round(views / VIEWS_PER_HOUSE)),
    )  # fmt: skip


def measured(command: list[str]) -> tuple[float, float]:
    """Return the CPU seconds of a command and the largest memory of its processes, bytes.

    Raises:
        SystemExit: it failed.
    """
    pid = os.posix_spawn(command[0], command, os.environ)
    _, status, usage = os.wait4(pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)} ended with {os.waitstatus_to_exitcode(status)}.")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024.0


def train(folder: Path, views: int, each: int) -> dict[str, float]:
    """Return what the training of the street of so many views takes."""
    scene, out, kept = folder / f"street-{views}", folder / f"out-{views}", folder / f"{views}.json"
    if kept.exists():
        return json.loads(kept.read_text())
    write_synthetic_dataset(scene, street_of(views))
    command = [sys.executable, "-m", "octasplat", "reconstruct", str(scene), "-o", str(out)]
    blocks = max(1, round(views / each))
    command += ["--preset", "fast", "--threads", "1", "--blocks", str(blocks)]
    began = time.monotonic()
    cpu, memory = measured(command)
    metrics = json.loads((out / "metrics.json").read_text())
    row = {
        "blocks": blocks, "cpu_seconds": cpu, "seconds": time.monotonic() - began, "memory_bytes": memory,
        "gaussians": metrics["gaussians"], "psnr": metrics["mean"]["psnr"],
    }  # fmt: skip
    write_json(kept, row)
    return row


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--views", type=int, nargs="+", default=[250, 500, 1000, 2000])
    parser.add_argument("--each", type=int, default=250)
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    print(
        "| Photographs | Blocks | CPU time | for each photograph | Memory | Gaussians | Held out |",
        flush=True,
    )
    print("|---|---|---|---|---|---|---|", flush=True)
    for views in given.views:
        row = train(given.output, views, given.each)
        seconds, memory = row["cpu_seconds"], row["memory_bytes"] / 1e9
        print(
            f"| {views:,} | {row['blocks']} | {seconds:,.0f} s | {seconds / views:.2f} s | {memory:.2f} GB | "
            f"{row['gaussians']:,} | {row['psnr']:.2f} dB |",
            flush=True,
        )


if __name__ == "__main__":
    main()
