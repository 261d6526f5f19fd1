"""Estimates of time and memory beside what a reconstruction takes.

    python -m benchmarks.estimates SCENE --max-side 480 --set iterations=300

CPU time and largest private memory of the whole command, the compilation of kernels included where they are
not in the cache. Prints a row for ``docs/notes/speed.md``.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import psutil
from PIL import Image

from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.cost_model import estimate_reconstruction
from octasplat.engine.runs.config import resolve_config


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--max-side", type=int)
    parser.add_argument("--set", dest="assignments", action="append", default=[])
    options = parser.parse_args()
    config = resolve_config(
        options.preset, settings={"max_side": options.max_side}, assignments=options.assignments
    )
    found = Counter(Image.open(path).size for path in sorted((options.scene / "images").iterdir()))
    sizes = [ImageSizes(width, height, count) for (width, height), count in found.items()]
    cores = len(os.sched_getaffinity(0))
    expected = estimate_reconstruction(config, sizes, cores)
    command = [sys.executable, "-m", "octasplat", "reconstruct", str(options.scene), "--quiet"]
    command += ["--preset", options.preset]
    command += ["--max-side", str(options.max_side)] if options.max_side else []
    for assignment in options.assignments:
        command += ["--set", assignment]
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen([*command, "-o", f"{folder}/run"])
        most = 0
        while process.poll() is None:
            try:
                memory = psutil.Process(process.pid).memory_info()
                most = max(most, memory.rss - memory.shared)
            except psutil.Error:
                break
            time.sleep(0.02)
        assert process.wait() == 0
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = used.ru_utime + used.ru_stime
    what = " ".join([options.preset, *options.assignments])
    print(
        f"| {options.scene.name}, {options.max_side or 'full size'} | {what} | {expected.cpu_seconds:.0f} s "
        f"| {cpu:.0f} s | {expected.memory_bytes / 1e6:.0f} MB | {most / 1e6:.0f} MB |"
    )


if __name__ == "__main__":
    main()
