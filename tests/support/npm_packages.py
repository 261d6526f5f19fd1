"""Programs from npm for tests, kept in the user's cache folder."""

import shutil
import subprocess
from pathlib import Path

import pytest
from platformdirs import user_cache_dir


def npm_folder(package: str, version: str, *beside: str) -> Path:
    """Folder whose ``node_modules`` holds ``package``, installed on first use; skips where that cannot be.

    ``beside`` are further packages of the same folder, as ``name@version``.
    """
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("node and npm are not installed")
    folder = Path(user_cache_dir("octasplat")) / "npm" / f"{package.replace('/', '_')}-{version}"
    wanted = [f"{package}@{version}", *beside]
    if not (folder / "node_modules" / package / "package.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        command = [npm, "install", "--no-audit", "--no-fund", "--prefix", str(folder), *wanted]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        if done.returncode != 0:
            pytest.skip(f"npm could not install {package}@{version}: {done.stderr.strip()[-300:]}")
    return folder
