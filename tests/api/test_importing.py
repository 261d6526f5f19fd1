"""What ``import octasplat`` loads, and how long that takes."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import octasplat

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


def test_type_checkers_see_all_public_names() -> None:
    tree = ast.parse(Path(octasplat.__file__).read_text(encoding="utf-8"))
    (seen,) = (node for node in tree.body if isinstance(node, ast.If))
    imported = [name for node in ast.walk(seen) if isinstance(node, ast.ImportFrom) for name in node.names]
    assert {name.asname or name.name for name in imported} == set(octasplat.__all__) - {"__version__"}
