"""The front end starts without the engine's heavy parts."""

import json
import subprocess
import sys
from pathlib import Path

HEAVY = ("torch", "numba", "llvmlite", "pycolmap", "embreex", "scipy", "OpenImageIO", "matplotlib")
CODE = f"""
import json, sys
import service.app, service.__main__
service.app.create_app()
print(json.dumps([name for name in {HEAVY!r} if name in sys.modules]))
"""


def test_no_heavy_module_is_imported() -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
        timeout=60,
    )
    assert json.loads(done.stdout) == []
