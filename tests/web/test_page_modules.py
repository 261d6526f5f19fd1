"""Modules of the pages by themselves: what is wrong is told, what comes late or is refused does no harm."""

import json
from pathlib import Path
from typing import Any

import pytest

import octasplat.service.web as service_web
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
