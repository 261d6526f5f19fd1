"""The page of the 3D view as a whole, with a scene and cameras that are given to it, in headless Chromium."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

import octasplat.service.web as service_web
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.service.web.templating import render_template
from tests.support.browser import open_page
from tests.support.shell_scene import shell_scene

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

STATIC = Path(service_web.__file__).parent / "static"
STYLE = """<style>
.screen { position: relative; height: 300px } canvas { display: block; width: 100%; height: 100% }
.overlay { position: absolute; inset: 0 }
</style>"""
SCRIPT = """<script type="module">
import { viewOf } from "/files/viewer/view_link.js";
const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
const box = document.getElementById("viewer"), find = (selector) => box.querySelector(selector);
const until = async (holds) => { while (!holds()) await pause(30); };
const press = (name) => find(`[data-do=${name}]`).click();
const place = () => find(".place").textContent;
const canvas = find("canvas:not(.overlay)");
BEFORE
await import("/files/viewer/page.js");
window.result = (async () => { BODY })();
</script>"""


def view(name: str, aspect: float, **more: Any) -> dict[str, Any]:
    fixed = {"position": [0, 0, -4], "forward": [0, 0, 1], "up": [0, -1, 0], "fov_y_degrees": 40}
    return {"name": name, "aspect": aspect, "held_out": False, "nearest_world": 0, **fixed, **more}


def in_viewer(body: str, folder: Path, views: list[dict[str, Any]], before: str = "", **box: str) -> Any:
    write_gaussian_ply(shell_scene(300), folder / "scene.ply")
    cameras = {"up": [0, -1, 0], "target": [0, 0, 0], "radius": 4, "views": views}
    (folder / "cameras.json").write_text(json.dumps(cameras))
    files = {path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*.js")}
    files |= {name: folder / name for name in ("scene.ply", "cameras.json")}
    page = render_template(
        "viewer.html", name="a scene", page="/files/", size_bytes=1000, q=9.21,
        background="black", light="", up="null",
    )  # fmt: skip
    page = re.sub(r"<script.*?</script>|<link .*?>", "", page).replace("</head>", f"{STYLE}</head>")
    for name, value in box.items():
        page = re.sub(f' data-{name}="[^"]*"', f' data-{name}="{value}"', page)
    script = SCRIPT.replace("BODY", body).replace("BEFORE", before)
    shown = open_page(page.replace("</body>", f"{script}</body>"), files=files, width=400, height=500)
    assert shown.result is not None, shown.messages
    return shown.result


THREE = [view("a.jpg", 0.5), view("b.jpg", 1.0), view("c.jpg", 2.5)]
READY = 'await until(() => box.dataset.ready === "yes");'


def test_step_back_from_a_place_of_no_photograph_goes_to_the_last_one(tmp_path: Path) -> None:
    found = in_viewer(
        READY
        + """
        const places = [];
        for (const step of ["previous", "next"]) {
            location.hash = `#view=0,0,-3,0,0,0,${step.length + 40}`;
            await pause(100);
            press(step);
            places.push(place());
        }
        return places;
        """,
        tmp_path,
        THREE,
    )
    assert found == ["c.jpg", "a.jpg"]


def test_link_opens_as_wide_as_it_was_copied(tmp_path: Path) -> None:
    """In a narrow window a wide photograph is seen wholly, by a wider angle, which a link has to tell."""
    found = in_viewer(
        READY
        + """
        const saved = [], original = Blob;
        window.Blob = class extends original {
            constructor(parts, options) {
                super(parts, options);
                if (options?.type === "application/json") saved.push(JSON.parse(parts[0]));
            }
        };
        const angle = () => {
            for (const name of ["clear-path", "key", "save-path"]) press(name);
            return saved.at(-1).frames[0].fov_y_degrees;
        };
        press("previous");
        await pause(200);
        const wide = angle();
        press("link");
        const hash = location.hash;
        press("next");
        await pause(200);
        const narrow = angle();
        history.replaceState(null, "", location.pathname);
        location.hash = hash;
        await pause(300);
        return [wide, narrow, angle(), viewOf(hash).aspect];
        """,
        tmp_path,
        THREE,
    )
    wide, narrow, again, aspect = found
    assert wide > narrow + 5 and again == pytest.approx(wide) and aspect == 2.5


def test_newer_scene_is_shown_where_the_first_could_not_be_loaded(tmp_path: Path) -> None:
    found = in_viewer(
        """
        await Promise.race([until(() => box.dataset.ready === "yes"), pause(8000)]);
        return [box.dataset.ready, find(".count").textContent, find(".veil").hidden];
        """,
        tmp_path,
        THREE,
        """
        const post = Worker.prototype.postMessage;
        Worker.prototype.postMessage = function (message, ...others) {
            post.call(this, message, ...others);
            if (!message.load?.endsWith("gone.ply")) return;
            const detail = { scene: "/files/scene.ply", count: "newer" };
            box.dispatchEvent(new CustomEvent("scene", { detail }));
        };
        """,
        scene="/files/gone.ply",
    )
    assert found == ["yes", "newer", True]


def test_scene_comes_back_with_the_graphics_of_the_device(tmp_path: Path) -> None:
    found = in_viewer(
        """
        await until(() => box.dataset.rested === "yes");
        /** The mean of what the canvas shows. */
        const brightness = async () => {
            const image = await createImageBitmap(canvas);
            const context = new OffscreenCanvas(image.width, image.height).getContext("2d");
            context.drawImage(image, 0, 0);
            const { data } = context.getImageData(0, 0, image.width, image.height);
            return data.reduce((sum, value, k) => sum + (k % 4 < 3 ? value : 0), 0) / (0.75 * data.length);
        };
        const before = await brightness();
        const stopper = canvas.getContext("webgl2").getExtension("WEBGL_lose_context");
        stopper.loseContext();
        await pause(200);
        const lost = [find(".veil").hidden, find(".veil-text").textContent];
        press("background"); // which would draw
        press("background");
        await pause(300);
        stopper.restoreContext();
        await pause(300);
        await Promise.race([until(() => box.dataset.rested === "yes"), pause(8000)]);
        return { before, lost, after: await brightness(), veil: find(".veil").hidden };
        """,
        tmp_path,
        THREE,
        """
        const original = canvas.getContext.bind(canvas);
        canvas.getContext = (kind, options) => original(kind, { ...options, preserveDrawingBuffer: true });
        """,
    )
    assert found["lost"] == [
        False,
        "The graphics of this device have stopped; the scene comes back with them.",
    ]
    assert (
        found["veil"] and found["before"] > 5 and found["after"] == pytest.approx(found["before"], rel=0.02)
    )


def test_photograph_can_be_chosen_again_after_its_place_was_left(tmp_path: Path) -> None:
    found = in_viewer(
        READY
        + """
        const list = find(".views");
        list.value = "1";
        list.dispatchEvent(new Event("change", { bubbles: true }));
        await pause(200);
        const values = [list.value];
        canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft", code: "ArrowLeft" }));
        await pause(300);
        canvas.dispatchEvent(new KeyboardEvent("keyup", { key: "ArrowLeft", code: "ArrowLeft" }));
        await pause(100);
        return [...values, list.value];
        """,
        tmp_path,
        THREE,
    )
    assert found == ["1", ""]


def test_places_of_photographs_that_cannot_be_loaded_are_told(tmp_path: Path) -> None:
    """Once the service was only busy; else the scene is shown without them, and that is said."""
    busy = """
    const original = window.fetch;
    let left = 1;
    window.fetch = async (address) => (left-- > 0 ? new Response("{}", { status: 503 }) : original(address));
    """
    look = READY + 'return [find(".views").options.length, place()];'
    assert in_viewer(look, tmp_path, THREE, busy)[0] == 4
    words = "The places of the photographs could not be loaded."
    assert in_viewer(look, tmp_path, THREE, cameras="/files/gone.json") == [1, words]
