"""Blender as a Python package (bpy), which lives outside of this project's environment."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[1] / "tools" / "blender"
_EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "blender"
IMPORT_SCRIPT = _EXAMPLES / "import_octasplat.py"
EXPORT_PATH_SCRIPT = _EXAMPLES / "export_camera_path.py"


def run_blender(script: Path, *arguments: object, fails: bool = False) -> str:
    """Run a script as ``blender -b --python SCRIPT -- ARGUMENTS`` would; returns what it wrote.

    The environment variable OCTASPLAT_BPY_PYTHON names a Python that has bpy; skips where there is none.
    """
    python = shutil.which(os.environ.get("OCTASPLAT_BPY_PYTHON", ""))
    if python is None:
        pytest.skip("OCTASPLAT_BPY_PYTHON does not name a Python with bpy (pip install bpy==5.0.1)")
    done = subprocess.run(
        [python, str(script), "--", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
    )
    assert (done.returncode != 0) == fails, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout + done.stderr
