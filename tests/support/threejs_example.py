"""The page of examples/threejs, opened in headless Chromium."""

import json
from pathlib import Path

import numpy as np

from octasplat.engine.render.path_file import read_camera_path
from tests.support.browser import Page, open_page
from tests.support.npm_packages import npm_folder

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "threejs"


def draw_glb(file: Path, cameras: Path, frame: int, *, sort: bool = True, refine: int = 0) -> Page:
    """``file`` from one camera of a path; without ``sort`` as any viewer draws it, by chunks.

    ``refine`` is the number of frames to average, 0 for the sorted octagons.

    Raises:
        AssertionError: the page shows a message in place of the scene.
    """
    version = json.loads((EXAMPLE / "package.json").read_text())["dependencies"]["three"]
    query = f"?file=/files/{file.name}&cameras=/files/{cameras.name}&frame={frame}" + "&sort=off" * (not sort)
    query += f"&refine={refine}"
    size = read_camera_path(cameras).cameras[frame]
    page = open_page(
        page_of(query),
        packages=npm_folder("three", version),
        files={path.name: path for path in (file, cameras, *EXAMPLE.glob("*.js"))},
        width=size.width_px,
        height=size.height_px,
        seconds=240.0 + refine,
    )
    assert page.result == "drawn", page.messages
    return page


def page_of(query: str) -> str:
    """The example's page with ``query`` behind its address, and its modules where tests serve them."""
    html = (EXAMPLE / "index.html").read_text(encoding="utf-8")
    changes = {
        "location.search": json.dumps(query),
        '"./cameras.js"': '"/files/cameras.js"',
        '"./octagons.js"': '"/files/octagons.js"',
        '"./refine.js"': '"/files/refine.js"',
        "\nmain().catch": "\nwindow.result = main().catch",
    }
    for old, new in changes.items():
        assert html.count(old) == 1, old
        html = html.replace(old, new)
    return html


def display_values(page: Page) -> np.ndarray:
    """The screenshot in [0, 1]."""
    return page.image.astype(np.float32) / np.float32(255)
