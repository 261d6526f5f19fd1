"""Pages in headless Chromium, with npm packages and files served from this machine; nothing else is loaded.

The page sets ``window.result`` to a value or a promise. When that is there, a screenshot is taken.
"""

import atexit
import contextlib
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
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
SCRIPT = Path(__file__).with_name("browser.mjs")


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


class _Browser:
    """The process that works through the jobs of this one, with one Chromium for all of them."""

    def __init__(self) -> None:
        command = [str(SCRIPT), str(npm_folder(*PLAYWRIGHT)), str(chromium())]
        node = shutil.which("node")
        assert node is not None
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 (closed by end)
        self._process = subprocess.Popen(
            [node, *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
        )

    def answer(self, job: Mapping[str, Any], seconds: float) -> dict[str, Any]:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(job).encode() + b"\n")
        self._process.stdin.flush()
        line = bytearray()
        deadline = time.monotonic() + seconds
        while not line.endswith(b"\n"):
            left = max(deadline - time.monotonic(), 0.0)
            ready, _, _ = select.select([self._process.stdout], [], [], left)
            part = os.read(self._process.stdout.fileno(), 1 << 20) if ready else b""
            if not part:
                self._errors.seek(0)
                raise AssertionError(f"the browser did not answer: {self._errors.read()[-3000:].decode()}")
            line += part
        found: dict[str, Any] = json.loads(line)
        return found

    def end(self) -> None:
        """End the process, kindly at first, as Chromium ends with it then."""
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._errors.close()


_browser: _Browser | None = None


def run_in_browser(job: Mapping[str, Any], seconds: float) -> dict[str, Any]:
    """Return what ``browser.mjs`` answers to a job; it is started with the first and ends with this process.

    Skips the test where there is no Chromium.
    """
    global _browser
    if _browser is None:
        _browser = _Browser()
        atexit.register(end_browser)
    try:
        return _browser.answer(job, seconds)
    except BaseException:
        end_browser()  # the next job is not given the answer of this one
        raise


def end_browser() -> None:
    """End the browser of this process, if there is one."""
    global _browser
    if _browser is not None:
        _browser.end()
    _browser = None


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
    with tempfile.TemporaryDirectory(prefix="octasplat-page-") as folder:
        root = Path(folder)
        (root / "page.html").write_text(html, encoding="utf-8")
        job = {
            "page": str(root / "page.html"),
            "packages": str(packages) if packages else None,
            "files": {name: str(path) for name, path in (files or {}).items()},
            "width": width,
            "height": height,
            "seconds": seconds,
            "screenshot": str(root / "page.png"),
        }
        found = run_in_browser(job, seconds + 60)
        assert "error" not in found, f"{found['error']}; console: {found.get('messages')}"
        image = oiio.ImageBuf(str(root / "page.png")).get_pixels(oiio.UINT8)
    return Page(found["result"], np.ascontiguousarray(image[:, :, :3]), tuple(found["messages"]))


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Peak signal-to-noise ratio of two images of 8 bits, dB."""
    error = np.mean((image.astype(np.float64) - reference.astype(np.float64)) ** 2)
    return float(10 * np.log10(255.0**2 / max(error, 1e-12)))
