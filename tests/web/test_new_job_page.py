"""The page of a new job by itself: what it asks the service for, and when."""

import json
from pathlib import Path
from typing import Any

import pytest

import octasplat.service.web as service_web
from tests.support.browser import open_page

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

STATIC = Path(service_web.__file__).parent / "static"
PAGE = """<!doctype html>
<html><body>
<form id="new-job" data-kind="reconstruct" data-given='GIVEN'>
<div id="drop"><button type="button" data-pick="pick-folder">Folder</button>
<input type="file" id="pick-folder" multiple>
<button type="button" data-pick="pick-files">Files</button><input type="file" id="pick-files" multiple></div>
<div id="chosen" hidden><p id="chosen-text" tabindex="-1"></p>
<button type="button" id="forget">Others</button>
<ul id="chosen-notes"></ul></div>
<select id="dataset"><option value=""><option value="known"></select>
<fieldset data-path="preset" data-type="radio" data-default="standard">
<input type="radio" name="preset" value="standard" checked></fieldset>
<label for="label">Name</label><input id="label">
<label for="steps">Steps</label>
<input id="steps" type="number" data-path="train.iterations" data-type="number" data-default="">
<label for="odd">Odd</label><input id="odd" data-path="train.odd" data-type="json" data-default="">
<fieldset data-path="exports" data-type="files"><legend>Files</legend>
<label class="check"><input type="checkbox" value="viewer.glb" checked></label>
<label class="check"><input type="checkbox" value="scene.spz"></label></fieldset>
<section id="going" hidden><progress id="going-bar"></progress><p id="going-text"></p></section>
<p id="estimate" hidden></p><div id="faults" tabindex="-1" hidden></div>
<button id="start" type="submit">Start</button><button type="button" id="pause" hidden>Pause</button>
</form>
<script type="module">
const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
const find = (id) => document.getElementById(id);
const asked = []; // [method, path, body]
let answers = {}; // by method and path
window.fetch = async (address, { method = "GET", body } = {}) => {
    const path = String(address).split("?")[0], sent = typeof body === "string" ? JSON.parse(body) : null;
    asked.push([method, path, sent]);
    const answer = answers[`${method} ${path}`];
    const { content = {}, status = 200 } = answer ? await answer(sent) : { status: 404 };
    return new Response(JSON.stringify(content), { status });
};
answers["POST /v1/scene-previews"] = ({ files }) => ({ content: {
    files: files.map(({ path, size_bytes }) => ({ name: `images/${path}`, path, size_bytes })),
    refusals: files.length ? [] : [{ detail: "There are no photographs." }],
    folder: "", notes: [], photographs: files.length, has_poses: false,
} });
const choose = (...names) => {
    const transfer = new DataTransfer();
    names.forEach((name) => transfer.items.add(new File(["x"], name)));
    find("pick-files").files = transfer.files;
    find("pick-files").dispatchEvent(new Event("change"));
};
await import("/files/new.js");
window.result = (async () => { BODY })();
</script></body></html>
"""


def in_page(body: str, given: dict[str, Any] | None = None) -> Any:
    files = {path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*.js")}
    page = open_page(PAGE.replace("GIVEN", json.dumps(given or {})).replace("BODY", body), files=files)
    assert page.result is not None, page.messages
    return page.result


def test_wrong_settings_are_told_before_anything_is_sent() -> None:
    found = in_page(
        """
        choose("a.jpg");
        await pause(100);
        find("odd").value = "{";
        find("odd").dispatchEvent(new Event("input", { bubbles: true }));
        await pause(600);
        const estimate = find("estimate").textContent;
        find("start").click();
        await pause(300);
        return { estimate, faults: find("faults").textContent, asked: asked.map(([, path]) => path) };
        """
    )
    assert found["estimate"] == found["faults"] == "Odd: this is not JSON."
    assert found["asked"] == ["/v1/scene-previews"]


def test_nothing_else_is_begun_while_photographs_are_sent() -> None:
    found = in_page(
        """
        choose("a.jpg");
        await pause(100);
        answers["POST /v1/datasets"] = () => new Promise(() => {});
        find("start").click();
        await pause(100);
        find("forget").click();
        choose("b.jpg");
        await pause(100);
        find("start").click();
        await pause(100);
        const begun = asked.filter(([, path]) => path === "/v1/datasets");
        return { text: find("chosen-text").textContent, asked: begun.length };
        """
    )
    assert "1 photographs" in found["text"] and found["asked"] == 1


def test_late_drop_does_not_replace_what_was_chosen_since_and_broken_ones_are_told() -> None:
    found = in_page(
        """
        const dropped = (getFile) => {
            const entry = { name: "dropped.jpg", isFile: true, file: getFile };
            const event = new Event("drop", { bubbles: true, cancelable: true });
            event.dataTransfer = { types: ["Files"], items: [{ webkitGetAsEntry: () => entry }], files: [] };
            document.dispatchEvent(event);
        };
        dropped((resolve) => setTimeout(() => resolve(new File(["xyz"], "dropped.jpg")), 300));
        await pause(50);
        choose("a.jpg", "b.jpg");
        await pause(600);
        const texts = [find("chosen-text").textContent];
        dropped((_resolve, reject) => reject(new DOMException("It cannot be read.", "NotReadableError")));
        await pause(200);
        return [...texts, find("faults").textContent];
        """
    )
    assert found == ["2 photographs, 2 B", "It cannot be read."]


def test_word_that_is_dropped_on_a_field_leaves_the_photographs() -> None:
    found = in_page(
        """
        choose("a.jpg");
        await pause(100);
        const dataTransfer = new DataTransfer();
        const event = new DragEvent("drop", { bubbles: true, cancelable: true, dataTransfer });
        event.dataTransfer.setData("text/plain", "a name");
        find("label").dispatchEvent(event);
        await pause(200);
        const chosen = !find("chosen").hidden;
        return { stopped: event.defaultPrevented, chosen, faults: find("faults").textContent };
        """
    )
    assert found == {"stopped": False, "chosen": True, "faults": ""}


def test_files_of_another_job_are_asked_for_whatever_they_are_called() -> None:
    found = in_page(
        """
        const { readOptions } = await import("/files/options.js");
        const before = readOptions(find("new-job")).exports;
        document.querySelector("[value='<b>.glb']").click();
        return [before, readOptions(find("new-job")).exports];
        """,
        {"exports": ["scene.spz", "other.glb", "<b>.glb"]},
    )
    assert found == [["scene.spz", "other.glb", "<b>.glb"], ["scene.spz", "other.glb"]]
