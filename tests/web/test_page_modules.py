"""Modules of the pages by themselves: what is wrong is told, what comes late or is refused does no harm."""

import json
from pathlib import Path
from typing import Any

import pytest

import octasplat.service.web as service_web
from octasplat.service.web.formatting import format_duration, format_thousands
from tests.support.browser import open_page

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

STATIC = Path(service_web.__file__).parent / "static"
PAGE = """<!doctype html>
<html><body><div id="notices"></div>HTML
<script type="module">
const job = JOB;
const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
const json = (content, status = 200) => new Response(JSON.stringify(content), { status });
window.result = (async () => { BODY })();
</script></body></html>
"""


def in_page(body: str, html: str = "", **job: Any) -> Any:
    files = {path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*.js")}
    page = PAGE.replace("HTML", html).replace("JOB", json.dumps(job)).replace("BODY", body)
    shown = open_page(page, files=files)
    assert shown.result is not None, shown.messages
    return shown.result


def test_wrong_field_is_shown_wherever_it_is_folded_away() -> None:
    found = in_page(
        """
        await import("/files/app.js");
        document.querySelector("button").click();
        await pause(100);
        const folds = [...document.querySelectorAll("details")].map((fold) => fold.open);
        return { folds, active: document.activeElement.id };
        """,
        "<form><details><summary>all</summary><details><summary>more</summary>"
        '<input id="wrong" type="number" max="3" value="9"></details></details>'
        "<details><summary>others</summary><input></details><button>Start</button></form>",
    )
    assert found == {"folds": [True, True, False], "active": "wrong"}


UPLOAD = """
const { Upload } = await import("/files/upload.js");
const deleted = [];
window.fetch = async (address, { method }) => {
    deleted.push(`${method} ${address}`);
    const status = job.statuses[Math.min(deleted.length, job.statuses.length) - 1];
    return status === 204 ? new Response(null, { status }) : json({ detail: "not now" }, status);
};
const upload = new Upload({ files: [], bytes: 0 }, "title", () => {});
const there = new Map([["images/a.jpg", {}], ["images/old b.jpg", {}]]);
const error = await upload.removeOthers("d", there, [{ name: "images/a.jpg" }])
    .then(() => null, ({ message }) => message);
return { error, deleted };
"""


@pytest.mark.parametrize(
    ("statuses", "error", "tries"),
    [([204], None, 1), ([404], None, 1), ([503, 204], None, 2), ([409], "not now", 1)],
)
def test_photographs_of_before_are_removed_or_it_is_told(
    statuses: list[int], error: str | None, tries: int
) -> None:
    found = in_page(UPLOAD, statuses=statuses)
    assert found == {"error": error, "deleted": ["DELETE /v1/datasets/d/files/images/old%20b.jpg"] * tries}


TRIALS = """
const { Trials } = await import("/files/trial.js");
const section = document.querySelector("section"), trials = new Trials(section);
const late = {}, gone = [];
window.fetch = async (address, { method }) => {
    const [id, ...rest] = String(address).replace("/v1/jobs/", "").split(/[/?]/);
    if (method === "DELETE") {
        gone.push(id);
        return json({}, gone.length === 1 ? 503 : 200);
    }
    if (!rest.length) return json({ state: "succeeded", notes: [] });
    if (rest.length === 1) return json({ artifacts: job.artifacts });
    if (late[id]) await pause(late[id]);
    return job.status === 200 ? new Response(new Blob([id])) : json({ detail: "It is gone." }, job.status);
};
const shown = async () => {
    const { src, alt } = section.querySelector("img");
    return src ? [await new Promise((resolve) => {
        const request = new XMLHttpRequest();
        request.onload = () => resolve(request.responseText);
        request.open("GET", src);
        request.send();
    }), alt] : null;
};
const show = (name) => trials.show(async () => name, name, "so", "about it");
"""
SECTION = (
    '<section><figure class="preview" hidden><img><figcaption></figcaption></figure>'
    '<p class="light-state"></p><p class="fault" hidden></p></section>'
)
PICTURE = [{"name": "views/a.png"}]


def test_late_preview_does_not_replace_a_newer_one() -> None:
    found = in_page(
        TRIALS
        + """
        late.first = 600;
        const first = show("first");
        await pause(100);
        await show("second");
        await first;
        await pause(2600); // what is deleted is tried again after two seconds
        return { shown: await shown(), gone: gone.sort() };
        """,
        SECTION,
        artifacts=PICTURE,
        status=200,
    )
    assert found["shown"] == ["second", "Preview of second so"]
    assert found["gone"] in (["first", "second", "second"], ["first", "first", "second"])


@pytest.mark.parametrize(
    ("artifacts", "status", "words"),
    [(PICTURE, 404, "It is gone."), ([{"name": "log.txt"}], 200, "The preview made no picture.")],
)
def test_preview_without_a_picture_is_told(artifacts: list[dict[str, str]], status: int, words: str) -> None:
    found = in_page(
        TRIALS + 'await show("a"); return [await shown(), section.querySelector(".fault").textContent];',
        SECTION,
        artifacts=artifacts,
        status=status,
    )
    assert found == [None, words]


def test_end_of_a_job_takes_nothing_away_that_is_being_written() -> None:
    """The page is loaded again once what was written is kept or deleted; each time it begins anew here."""
    page = """<!doctype html><html><body><section id="status"></section>
    <input type="text" value="a name"><section id="about" data-job="1" data-state="running"></section>
    <details id="log-fold"><pre id="log"></pre></details>
    <script type="module">
    const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
    const seen = JSON.parse(sessionStorage.seen ?? "[]"), field = document.querySelector("input");
    const see = (what) => { seen.push(what); sessionStorage.seen = JSON.stringify(seen); };
    let over = null;
    window.fetch = async () => new Response('{"events": []}');
    window.EventSource = class extends EventTarget { constructor() { super(); over = this; } close() {} };
    see("loaded");
    if (seen.length > 1) window.result = seen;
    else {
        await import("/files/job.js");
        while (!over) await pause(20);
        field.value = "half of a na";
        over.dispatchEvent(new MessageEvent("state", { data: '{"state": "succeeded"}', lastEventId: "1" }));
        await pause(1500);
        see(field.value);
        field.value = "a name";
    }
    </script></body></html>"""
    files = {path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*.js")}
    assert open_page(page, files=files).result == ["loaded", "half of a na", "loaded"]


def test_link_to_a_view_outlives_the_sign_in() -> None:
    found = in_page(
        """
        location.hash = "#view=1,2,3,4,5,6,50";
        await import("/files/app.js");
        return document.querySelector("[name=next]").value;
        """,
        '<form class="card sign-in"><input type="hidden" name="next" value="/jobs/1"></form>',
    )
    assert found == "/jobs/1#view=1,2,3,4,5,6,50"


def test_scripts_write_numbers_and_times_as_the_service_does() -> None:
    seconds = [0, 59.4, 61, 119.7, 600, 3599, 3600, 9000, 86_399, 86_400, 200_000]
    numbers = [0, 999, 1000, 1_234_567]
    found = in_page(
        """
        const { duration, thousands } = await import("/files/numbers.js");
        return [job.seconds.map(duration), job.numbers.map((value) => thousands(value))];
        """,
        seconds=seconds,
        numbers=numbers,
    )
    assert found == [[format_duration(value) for value in seconds], [format_thousands(n) for n in numbers]]
