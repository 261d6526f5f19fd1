"""The form of crop and clean by itself: what it asks for, and what it says, wherever the scene lies."""

import json
import uuid
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import octasplat.service.web as service_web
from octasplat.engine.operations.clean import CleanOptions
from octasplat.service.web.templating import render_template
from tests.support.browser import open_page

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

STATIC = Path(service_web.__file__).parent / "static"
JOB = SimpleNamespace(id=uuid.UUID(int=1), kind="reconstruct", dataset_id=uuid.UUID(int=2))
SCRIPT = """<script type="module">
import { EditPanel } from "/files/viewer/edit_panel.js";
const job = JOB, geometry = new Float32Array(12 * job.points.length);
job.points.forEach((point, k) => geometry.set(point, 12 * k));
const edits = [];
const viewer = {
    scene: { count: job.points.length, geometry }, box: document.createElement("div"), overlay: {}, wake() {},
    edit(wanted, show) { edits.push({ ...wanted, show }); },
};
const asked = [];
window.fetch = async (address, { body }) => {
    asked.push(JSON.parse(body));
    return new Response('{"detail": "not now"}', { status: 409 });
};
const panel = new EditPanel(document.getElementById("edit"), viewer), { form } = panel;
const fill = (name, value) => {
    const field = form.elements[name];
    if (field.type === "checkbox") field.checked = value;
    else field.value = value;
    field.dispatchEvent(new Event("input", { bubbles: true }));
};
const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
window.result = (async () => { BODY })();
</script>"""


def in_panel(body: str, origin: list[float]) -> Any:
    edit = {"origin": origin, "clean": CleanOptions().model_dump(mode="json")}
    points = np.random.default_rng(1).uniform(-2, 2, (400, 3)).round(3).tolist()
    panel = render_template("_edit.html", job=JOB, edit=edit)
    script = SCRIPT.replace("JOB", json.dumps({"points": points})).replace("BODY", body)
    files = {path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*.js")}
    page = open_page(f"<!doctype html><html><body>{panel}{script}</body></html>", files=files)
    assert page.result is not None, page.messages
    return page.result


@pytest.mark.parametrize("origin", [[0.0, 0.0, 0.0], [448262.5, 5411900.25, 312.0]])
def test_box_of_a_scene_far_from_the_origin_is_as_fine_as_any(origin: list[float]) -> None:
    found = in_panel(
        """
        fill("crop", true);
        const { href } = document.getElementById("edit-region");
        const link = href.split("#region=")[1].split(",").map(Number);
        const low = form.elements.x_low, output = form.querySelector("output[for=edit-x-low]");
        const shown = () => output.textContent;
        const texts = [];
        for (let k = 0; k < 3; k++) {
            texts.push(shown());
            low.stepUp();
            fill("x_low", low.value);
        }
        return { link, box: panel.inFile(panel.wanted().box), texts };
        """,
        origin,
    )
    x_low, *others = found["box"]
    np.testing.assert_allclose(found["link"][1:], others, atol=1e-3)
    assert len(set(found["texts"])) == 3 and float(found["texts"][0]) == pytest.approx(x_low, abs=0.04)


def test_what_is_wrong_is_told_and_hinders_nothing_else() -> None:
    found = in_panel(
        """
        document.getElementById("edit").open = true;
        fill("crop", true);
        fill("clean", true);
        fill("min_group", "1");
        await pause(300);
        const said = panel.state.textContent, edited = edits.length;
        fill("clean", false);
        form.querySelector("[value=crop]").click();
        await pause(300);
        return { said, edited, later: edits.length, asked, fault: form.querySelector(".fault").textContent };
        """,
        [0.0, 0.0, 0.0],
    )
    assert found["said"].startswith("Groups smaller than: ") and found["later"] > found["edited"]
    assert [body["kind"] for body in found["asked"]] == ["crop"] and found["fault"] == "not now"


def test_look_that_fails_is_told() -> None:
    found = in_panel(
        """
        // As it holds no scene yet, the worker can look at nothing.
        const worker = new Worker("/files/viewer/scene_worker.js", { type: "module" });
        const answer = await Promise.race([pause(3000), new Promise((resolve) => {
            worker.onmessage = ({ data }) => resolve(data);
            worker.onerror = () => resolve(null);
            worker.postMessage({ edit: { box: null, clean: null }, show: "kept" });
        })]);
        if (answer) viewer.box.dispatchEvent(new CustomEvent("edited", { detail: answer.edited }));
        return panel.state.textContent;
        """,
        [0.0, 0.0, 0.0],
    )
    assert found.startswith("What this would do cannot be shown here (")


def test_job_is_asked_for_once() -> None:
    found = in_panel(
        """
        fill("crop", true);
        const button = form.querySelector("[value=crop]");
        button.click();
        button.click();
        await pause(100);
        const once = asked.length;
        button.click(); // as the first was refused
        await pause(100);
        return [once, asked.length];
        """,
        [0.0, 0.0, 0.0],
    )
    assert found == [1, 2]
