"""The client as a Python API: it needs no command line and prints nothing of its own."""

import ast
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_client_loads_no_cli_or_heavy_modules() -> None:
    code = (
        "import sys, octasplat.workers.client.submission, octasplat.workers.client.watch\n"
        "heavy = {'torch', 'numba'} & sys.modules.keys()\n"
        "print([name for name in sys.modules if name.startswith('octasplat.workers.cli.')], sorted(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[] []"


def test_client_modules_do_not_print() -> None:
    paths = sorted((ROOT / "workers" / "client").glob("*.py"))
    assert paths
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = {alias.name for alias in node.names} | {getattr(node, "module", None) or ""}
                assert not {name.split(".")[0] for name in names} & {"click", "rich"}, path
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id != "print", path
