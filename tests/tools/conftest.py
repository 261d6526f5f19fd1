import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.support.npm_packages import npm_folder

Validate = Callable[[Path], dict[str, Any]]


@pytest.fixture(scope="session")
def validate_glb() -> Validate:
    """The Khronos glTF validator's report on a file."""
    packages = npm_folder("gltf-validator", "2.0.0-dev.3.10")
    script = Path(__file__).with_name("validate_glb.mjs")

    def validate(path: Path) -> dict[str, Any]:
        node = shutil.which("node")
        assert node is not None
        done = subprocess.run(
            [node, str(script), str(packages), str(path)],
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        report: dict[str, Any] = json.loads(done.stdout)
        return report

    return validate
