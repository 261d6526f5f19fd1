"""The forms of light by themselves: files that take long to read, and what the service says of a stage."""

import uuid
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import octasplat.service.web as service_web
from octasplat.engine.pathtracing.stage.stage_file import parse_stage
from octasplat.engine.render.environment_files import write_environment
from octasplat.service.web.templating import render_template
from tests.support.browser import open_page

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

STATIC = Path(service_web.__file__).parent / "static"
JOB = SimpleNamespace(id=uuid.UUID(int=1), queue="cpu")
LIMITS = {"priority": 1, "max_file_bytes": 1 << 30}
MAP = SimpleNamespace(dataset_id=uuid.UUID(int=2), name="sky.hdr", title="")
VIEWS = [SimpleNamespace(name="a.jpg", render="renders/a.png", width=400, height=300)]
LIGHT = {"light": SimpleNamespace(views=VIEWS, has_learnt_light=False, **LIMITS)}
LEARNT = {"light": SimpleNamespace(views=VIEWS, has_learnt_light=True, **LIMITS)}
RELIGHT = {"relight": SimpleNamespace(views=["a.jpg"], maps=[MAP], learnt="layers/environment.png", **LIMITS)}
SCRIPT = """<script type="module">
const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
const json = (content, status = 200) => new Response(JSON.stringify(content), { status });
const find = (id) => document.getElementById(id);
const fire = (field, kind) => field.dispatchEvent(new Event(kind, { bubbles: true }));
window.result = (async () => { BODY })();
</script>"""


def in_form(template: str, values: dict[str, Any], body: str, files: dict[str, Path] | None = None) -> Any:
    form = render_template(template, job=JOB, base="/v1/jobs/1", **values)
    served = {path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*.js")} | (files or {})
    page = open_page(
        f"<!doctype html><html><body><div id='viewer' data-materials='yes'></div>{form}"
        f"{SCRIPT.replace('BODY', body)}</body></html>",
        files=served,
    )
    assert page.result is not None, page.messages
    return page.result


RELIGHT_PAGE = """
const maps = await Promise.all(["dim", "bright"].map(
    async (name) => (await original(`/files/${name}.hdr`)).arrayBuffer(),
));
let late = 0;
window.fetch = async (address) => {
    if (!String(address).includes("environment.hdr")) return new Response(maps[1]);
    await pause(late);
    return status === 200 ? new Response(maps[0]) : json({ detail: "It is gone." }, status);
};
const heard = [];
find("viewer").addEventListener("light", ({ detail }) => {
    heard.push([detail.map && detail.map.data[0], detail.degrees]);
});
await import("/files/relight/page.js");
const live = find("relight-live"), turned = find("relight-rotation_degrees");
const choose = (value) => { live.value = value; fire(live, "change"); };
find("relight-map").selectedIndex = 1;
"""


@pytest.fixture
def maps(tmp_path: Path) -> dict[str, Path]:
    for name, value in (("dim", 0.25), ("bright", 4.0)):
        write_environment(tmp_path / f"{name}.hdr", np.full((4, 8, 3), value, np.float32))
    return {path.name: path for path in tmp_path.glob("*.hdr")}


@pytest.mark.parametrize("status", [200, 404])
def test_light_that_comes_late_is_not_shown(status: int, maps: dict[str, Path]) -> None:
    found = in_form(
        "_relight.html",
        RELIGHT,
        f"const original = window.fetch, status = {status};"
        + RELIGHT_PAGE
        + """
        late = 400;
        choose("learnt");
        await pause(50);
        choose("this");
        await pause(800);
        return { heard, live: live.value, fault: document.querySelector(".fault").textContent };
        """,
        maps,
    )
    assert found["live"] == "this" and found["fault"] == ""
    assert [light for light, _ in found["heard"]] == pytest.approx([4.0])


def test_light_is_turned_as_the_slider_says_when_it_comes(maps: dict[str, Path]) -> None:
    found = in_form(
        "_relight.html",
        RELIGHT,
        "const original = window.fetch, status = 200;"
        + RELIGHT_PAGE
        + """
        window.fetch = async () => { await pause(300); return new Response(maps[1]); };
        choose("this");
        turned.value = 90;
        fire(turned, "input");
        await pause(600);
        return heard.at(-1);
        """,
        maps,
    )
    assert found == [pytest.approx(4.0), 90]


LIGHT_PAGE = """
const asked = [];
window.fetch = async (address, { body } = {}) => {
    const path = String(address);
    const views = [{ name: "a.jpg", forward: [1, 0, 0] }];
    if (path.endsWith("cameras.json")) return json({ up: [0, 0, 1], target: [0, 0, 0], radius: 5, views });
    asked.push([path, JSON.parse(body)]);
    return estimate(JSON.parse(body));
};
await import("/files/light/page.js");
await pause(100);
const mesh = find("light-mesh");
const take = (name, text, wait = 0) => {
    const file = new File([text], name), transfer = new DataTransfer();
    transfer.items.add(file);
    mesh.files = transfer.files;
    const chosen = mesh.files[0], read = chosen.text.bind(chosen);
    chosen.text = async () => { await pause(wait); return read(); };
    fire(mesh, "change");
};
const scale = () => Number(/scale = (\\S+)/.exec(document.querySelector(".stage-text").textContent)[1]);
"""


def test_mesh_is_as_large_as_it_is_although_one_before_takes_long_to_read() -> None:
    found = in_form(
        "_light.html",
        LIGHT,
        "const estimate = () => json({});"
        + LIGHT_PAGE
        + """
        find("light-thing").value = "file";
        take("small.obj", "v 0 0 0\\nv 1 0 0\\n");
        await pause(100);
        const small = scale();
        take("large.obj", "v 0 0 0\\nv 8 0 0\\n", 400);
        await pause(50);
        take("small.obj", "v 0 0 0\\nv 1 0 0\\n");
        await pause(700);
        return [small, scale()];
        """,
    )
    assert found[0] == found[1] > 0


def test_what_is_wrong_with_a_stage_is_told_by_itself() -> None:
    page = LIGHT_PAGE
    body = """
    await pause(900);
    return [asked.length, document.querySelector(".light-estimate").textContent];
    """
    refusal = 'const estimate = () => json({ errors: [{ detail: "The lamp is too large." }] }, 422);'
    text = 'options.mode === "views" ? "5 s" : "2 min"'
    taken = f"const estimate = ({{ options }}) => json({{ estimate: {{ text: {text} }} }});"
    assert in_form("_light.html", LIGHT, refusal + page + body) == [2, "The lamp is too large."]
    assert in_form("_light.html", LIGHT, taken + page + body) == [
        2,
        "With 100,000 Gaussians the held-out views would take at most 5 s, a turntable of 96 frames 2 min; "
        "fewer are faster.",
    ]


STAGES = """
const text = () => document.querySelector(".stage-text").textContent;
const choose = (id, value) => { find(id).value = value; fire(find(id), "input"); };
const found = { words: find("light-scene").selectedOptions[0].textContent, first: text() };
const sky = new DataTransfer();
sky.items.add(new File(["x"], "sky.hdr"));
document.querySelector("[name=sky]").files = sky.files;
choose("light-light", "sun");
found.sky = text();
choose("light-scene", "shadowed");
found.shadowed = text();
return found;
"""


def test_form_begins_with_the_light_that_a_run_has_learnt() -> None:
    page = "const estimate = () => json({});" + LIGHT_PAGE + STAGES
    found = in_form("_light.html", LEARNT, page)
    assert found["words"] == "in its own light"
    first, lit, shadowed = (parse_stage(found[name], name) for name in ("first", "sky", "shadowed"))
    assert first.gaussians[0].light is None and first.environment is None and first.lights == ()
    assert "# no light: materials, in the light that was learnt with them" in found["first"]
    assert lit.gaussians[0].light is None and lit.environment is not None and len(lit.lights) == 1
    assert "# no light: materials, in the light below" in found["sky"]
    assert shadowed.gaussians[0].light == "shadowed"
    # of a scene without materials it begins as ever
    found = in_form("_light.html", LIGHT, page)
    first = parse_stage(found["first"], "first")
    assert found["words"] == "takes shadows" and first.gaussians[0].light == "shadowed"
    assert len(first.lights) == 1
