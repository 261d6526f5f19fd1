"""The client as a Python API: it needs no command line and prints nothing of its own."""

import ast
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_it_loads_neither_click_nor_rich_nor_torch() -> None:
    code = (
        "import sys, workers.client.submission, workers.client.watch\n"
        "print(sorted({'click', 'rich', 'torch', 'numba'} & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_nothing_in_it_prints() -> None:
    for path in sorted((ROOT / "workers" / "client").glob("*.py")):
        calls = [node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
        assert not [call for call in calls if isinstance(call, ast.Name) and call.id == "print"], path
