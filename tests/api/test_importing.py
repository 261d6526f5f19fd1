"""What ``import octasplat`` loads, and how long that takes."""

import json
import subprocess
import sys

CODE = """
import json, sys, time
began = time.perf_counter()
import octasplat
seconds = time.perf_counter() - began
heavy = ["torch", "numba", "numpy", "fastapi", "pydantic", "click"]
loaded = [name for name in heavy if name in sys.modules]
octasplat.Client, octasplat.Job
client = [name for name in ["torch", "numba", "numpy", "fastapi", "click.testing"] if name in sys.modules]
print(json.dumps([seconds, loaded, client, dir(octasplat) == sorted(octasplat.__all__)]))
"""


def test_import_loads_no_heavy_modules() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    seconds, loaded, client, lists_public = json.loads(done.stdout)
    assert loaded == [] and client == [] and lists_public
    assert seconds < 0.5
    assert done.stderr == ""
