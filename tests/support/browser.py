"""Pages in headless Chromium, with npm packages and files served from this machine; nothing else is loaded.

The page sets ``window.result`` to a value or a promise. When that is there, a screenshot is taken.
"""

import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from jaxtyping import UInt8

from tests.support.npm_packages import npm_folder

CHROMIUM_NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
PLAYWRIGHT = ("playwright-core", "1.65.1")


@dataclass(frozen=True)
class Page:
    """What a page showed.

    Attributes:
        result: its ``window.result``, as JSON values.
        image: the screenshot, display values.
        messages: what it wrote to the console.
    """

    result: Any
    image: UInt8[np.ndarray, "h w 3"]
    messages: tuple[str, ...]


def chromium() -> Path:
    """The browser; skips the test where there is none."""
    for name in (os.environ.get("OCTASPLAT_CHROMIUM", ""), *CHROMIUM_NAMES):
        found = shutil.which(name) if name else None
        if found:
            return Path(found)
    pytest.skip("Chromium is not installed (apt-get install chromium-headless-shell)")


def open_page(
    html: str,
    *,
    packages: Path | None = None,
    files: Mapping[str, Path] | None = None,
    width: int = 256,
    height: int = 256,
    seconds: float = 120.0,
) -> Page:
    """Open ``html`` and wait for its ``window.result``.

    Args:
        html: the page; its origin serves ``/node_modules/...`` and ``/files/<name>``.
        packages: folder with ``node_modules``, as of `npm_packages.npm_folder`.
        files: name to path of what is served under ``/files/``.
        width: of the window, pixels.
        height: of the window, pixels.
        seconds: how long the page may take.
    """
    browser, playwright = chromium(), npm_folder(*PLAYWRIGHT)
    node = shutil.which("node")
    assert node is not None
    with tempfile.TemporaryDirectory(prefix="octasplat-page-") as folder:
        root = Path(folder)
        (root / "page.html").write_text(html, encoding="utf-8")
        job = {
            "page": str(root / "page.html"),
            "packages": str(packages) if packages else None,
            "files": {name: str(path) for name, path in (files or {}).items()},
            "playwright": str(playwright),
            "chromium": str(browser),
            "width": width,
            "height": height,
            "seconds": seconds,
            "screenshot": str(root / "page.png"),
        }
        (root / "job.json").write_text(json.dumps(job), encoding="utf-8")
        script = Path(__file__).with_name("browser.mjs")
        done = subprocess.run(
            [node, str(script), str(root / "job.json")],
            capture_output=True,
            text=True,
            timeout=seconds + 60,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout.splitlines()[-1])
        assert "error" not in found, f"{found['error']}; console: {found['messages']}"
        image = oiio.ImageBuf(str(root / "page.png")).get_pixels(oiio.UINT8)
    return Page(found["result"], np.ascontiguousarray(image[:, :, :3]), tuple(found["messages"]))


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Peak signal-to-noise ratio of two images of 8 bits, dB."""
    error = np.mean((image.astype(np.float64) - reference.astype(np.float64)) ** 2)
    return float(10 * np.log10(255.0**2 / max(error, 1e-12)))
