"""Notes and distances of the 3D view by themselves: what is pressed twice, and what is answered late."""

from pathlib import Path
from typing import Any

import pytest

import octasplat.service.web as service_web
from tests.support.browser import open_page

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

STATIC = Path(service_web.__file__).parent / "static"
PAGE = """<!doctype html>
<html><body><div id="box" data-job="1" data-notes="[]"><canvas tabindex="0" width="100" height="100"></canvas>
<button data-do="measure"></button><button data-do="note"></button>
<form class="note-form" hidden><input required><button type="submit">Keep</button>
<button type="button" data-do="note-cancel">Cancel</button></form><ol class="view-notes"></ol></div>
<script type="module">
import { Vector3 } from "/files/vendor/three.js";
import { Marks } from "/files/viewer/marks.js";
const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
const box = document.getElementById("box");
const canvas = box.querySelector("canvas"), form = box.querySelector("form");
const picks = [];
const viewer = {
    box, canvas, overlay: { segment: [] }, place: document.createElement("p"), wake() {},
    camera: { position: new Vector3() }, controls: { target: new Vector3() },
    pick: () => new Promise((resolve) => picks.push(resolve)),
};
let stored = [];
window.fetch = async (_address, { method = "GET", body } = {}) => {
    await pause(100);
    if (method === "PATCH") stored = JSON.parse(body).view_notes;
    return new Response(JSON.stringify({ view_notes: stored }), { headers: { ETag: '"1"' } });
};
const marks = new Marks(viewer);
const enter = () => canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "Enter" }));
window.result = (async () => { BODY })();
</script></body></html>
"""


def in_page(body: str) -> Any:
    files = {path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*.js")}
    page = open_page(PAGE.replace("BODY", body), files=files)
    assert page.result is not None, page.messages
    return page.result


def test_note_that_is_sent_twice_is_kept_once() -> None:
    found = in_page(
        """
        marks.toggle("note");
        enter();
        picks[0]([1, 2, 3]);
        await pause(20);
        form.querySelector("input").value = "a note";
        form.requestSubmit();
        form.requestSubmit();
        await pause(600);
        const texts = stored.map(({ text }) => text);
        return { texts, mode: marks.mode, focus: document.activeElement.tagName };
        """
    )
    assert found == {"texts": ["a note"], "mode": None, "focus": "CANVAS"}


def test_point_that_comes_after_the_mode_was_left_is_no_mark() -> None:
    found = in_page(
        """
        marks.toggle("measure");
        enter();
        marks.toggle("note");
        picks[0]([1, 2, 3]);
        await pause(20);
        return { segment: viewer.overlay.segment, text: viewer.place.textContent };
        """
    )
    assert found == {"segment": [], "text": "Click a point."}
