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
<select class="photo-mode with-photographs"><option value=""><option value="over"><option value="corner"></select>
<input class="photo-share" type="range"></div><p id="place"></p>
<script type="module">
import { PerspectiveCamera, Vector3 } from "/files/vendor/three.js";
import { Photograph } from "/files/viewer/photograph.js";
const job = JOB, box = document.getElementById("box"), image = box.querySelector("img");
const photograph = new Photograph(box, document.getElementById("place"));
const choose = (mode) => { photograph.mode.value = mode; photograph.mode.dispatchEvent(new Event("change")); };
const after = (kind) => new Promise((resolve) => image.addEventListener(kind, () => setTimeout(resolve), { once: true }));
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
