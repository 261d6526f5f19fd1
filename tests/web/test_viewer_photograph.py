"""The photograph that lies over the 3D view or beside it is that of the view, and lies as it was taken."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import octasplat.service.web as service_web
from octasplat.engine.dataset.synthetic.files import write_photograph
from tests.support.browser import open_page

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

STATIC = Path(service_web.__file__).parent / "static"
PAGE = """<!doctype html>
<html><body>
<div id="box" data-photographs="/files/"><div><img class="photo" hidden></div>
<select class="photo-mode with-photographs">
<option value=""><option value="over"><option value="corner"></select>
<input class="photo-share" type="range"></div><p id="place"></p>
<script type="module">
import { PerspectiveCamera, Vector3 } from "/files/vendor/three.js";
import { Photograph } from "/files/viewer/photograph.js";
const job = JOB, box = document.getElementById("box"), image = box.querySelector("img");
const photograph = new Photograph(box, document.getElementById("place"));
const choose = (mode) => {
    photograph.mode.value = mode;
    photograph.mode.dispatchEvent(new Event("change"));
};
const after = (kind) => new Promise((resolve) => {
    image.addEventListener(kind, () => setTimeout(resolve), { once: true });
});
const view = (name, more = {}) => ({ name, fov_y_degrees: 40, aspect: 1, up: [0, 1, 0], ...more });
window.result = (async () => { BODY })();
</script></body></html>
"""


def in_page(body: str, folder: Path, **job: Any) -> Any:
    files = {path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*.js")}
    for name in ("a.png", "b.png"):
        write_photograph(folder / name, np.full((6, 8, 3), 90, np.uint8))
        files[f"images/{name}"] = folder / name
    page = open_page(PAGE.replace("JOB", json.dumps(job)).replace("BODY", body), files=files)
    assert page.result is not None, page.messages
    return page.result


def test_photograph_of_the_view_before_is_not_shown(tmp_path: Path) -> None:
    found = in_page(
        """
        choose("corner");
        photograph.goTo(view("a.png"));
        const hidden = [image.hidden];
        await after("load");
        hidden.push(image.hidden);
        photograph.goTo(view("b.png"));
        hidden.push(image.hidden);
        await after("load");
        hidden.push(image.hidden);
        return hidden;
        """,
        tmp_path,
    )
    assert found == [True, False, True, False]


def test_photograph_that_cannot_be_shown_stays_away(tmp_path: Path) -> None:
    found = in_page(
        """
        choose("corner");
        photograph.goTo(view("lost.png"));
        await after("error");
        const hidden = [image.hidden];
        photograph.leave();
        hidden.push(image.hidden);
        photograph.goTo(view("a.png"));
        await after("load");
        return [...hidden, image.hidden, document.getElementById("place").textContent];
        """,
        tmp_path,
    )
    assert found == [True, True, False, "This browser cannot show the photograph."]


@pytest.mark.parametrize("degrees", [0, 90, -35, 180])
def test_photograph_of_a_turned_camera_lies_turned(degrees: int, tmp_path: Path) -> None:
    """The photograph's top is in its direction in the view, whose own up stays that of the scene."""
    angle = np.radians(degrees)
    found = in_page(
        """
        const camera = new PerspectiveCamera(40, 1, 0.1, 100);
        camera.position.set(0, 0, 5);
        camera.lookAt(0, 0, 0);
        photograph.fit(camera);
        choose("over");
        photograph.goTo(view("a.png", { up: job.up }));
        await after("load");
        const turned = getComputedStyle(image).rotate;
        choose("corner");
        return [turned === "none" ? 0 : parseFloat(turned), getComputedStyle(image).rotate];
        """,
        tmp_path,
        up=[float(np.sin(angle)), float(np.cos(angle)), 0.0],
    )
    assert found[0] == pytest.approx(degrees, abs=1e-3) and found[1] == "none"
