"""The viewer stays where photographs were taken, and draws less while frames take long."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import octasplat.service.web as service_web
from tests.support.browser import open_page

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

STATIC = Path(service_web.__file__).parent / "static"
PAGE = """<!doctype html>
<html><body><script type="module">
import { PerspectiveCamera, Vector3 } from "/files/vendor/three.js";
import { Limits } from "/files/viewer/limits.js";
import { Pacing } from "/files/viewer/pacing.js";
import { Walking } from "/files/viewer/walking.js";
import { makeSorter, shownBy } from "/files/viewer/sorting.js";
const job = JOB;
window.result = (() => { BODY })();
</script></body></html>
"""


def in_page(body: str, **job: Any) -> Any:
    files = {path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*.js")}
    page = open_page(PAGE.replace("JOB", json.dumps(job)).replace("BODY", body), files=files)
    assert page.result is not None, page.messages
    return page.result


def view(position: tuple[float, float, float], forward: tuple[float, float, float]) -> dict[str, Any]:
    return {
        "position": position,
        "forward": forward,
        "up": (0, -1, 0),
        "fov_y_degrees": 50,
        "aspect": 1.0,
    }


FRONT = [view((x, y, -4), (0, 0, 1)) for x in (-1, 0, 1) for y in (-0.5, 0.5)]
"""Photographs from one side, of what is at the origin."""


def test_camera_stays_on_the_side_of_the_photographs() -> None:
    asked = {
        "there": [0.5, 0, -4],
        "behind": [0.1, 0, 4],
        "beside": [4, 0, 0],
        "far": [0, 0, -40],
        "inside": [0, 0, -0.01],
    }
    found = in_page(
        """
        const limits = new Limits({ views: job.views, target: [0, 0, 0], radius: 4 });
        return Object.fromEntries(Object.entries(job.asked).map(([name, place]) => {
            const position = new Vector3().fromArray(place);
            const moved = limits.clamp(position);
            const again = position.clone();
            limits.clamp(again);
            return [name, { moved, place: position.toArray(), drift: again.distanceTo(position) }];
        }));
        """,
        views=FRONT,
        asked=asked,
    )
    assert not found["there"]["moved"] and found["there"]["place"] == pytest.approx(asked["there"])
    directions = np.array([photograph["position"] for photograph in FRONT], float)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for name in ("behind", "beside", "far", "inside"):
        place = np.array(found[name]["place"])
        assert found[name]["moved"] and found[name]["drift"] < 1e-6
        angle = np.degrees(np.arccos((directions @ (place / np.linalg.norm(place))).max()))
        assert angle < 20.01 and place[2] < 0
        assert 0.9 < np.linalg.norm(place) < 5.5


def test_scene_without_photographs_has_no_limits() -> None:
    found = in_page(
        """
        const position = new Vector3(0, 0, 99);
        return [new Limits({ views: [], target: [0, 0, 0], radius: 1 }).clamp(position), position.z];
        """
    )
    assert found == [False, 99]


def test_gaussians_outside_of_all_photographs_are_left_out_and_the_heaviest_come_first() -> None:
    legs = {"seen": 0.1, "large": 0.5, "beside": 0.1, "behind": 0.1}
    means = {"seen": (0, 0, 0), "large": (0.2, 0, 1), "beside": (30, 0, 0), "behind": (0, 0, -9)}
    geometry = [
        value
        for name, mean in means.items()
        for value in (*mean, 0.9, legs[name], 0, 0, 0, 0, legs[name], 0, 0)
    ]
    found = in_page(
        """
        const geometry = new Float32Array(job.geometry), bounds = new Float32Array([0.1, 0.5, 0.1, 0.1]);
        const sort = makeSorter({ count: 4, geometry, bounds, views: job.views });
        const ordered = (limit) => {
            const order = new Uint32Array(4);
            const count = sort([0, 0, -20], [0, 0, 1], 3, order, limit);
            return Array.from(order.slice(0, count));
        };
        const shown = (views) => Array.from(shownBy(4, geometry, views));
        return { shown: shown(job.views), free: shown([]), all: ordered(), one: ordered(1) };
        """,
        geometry=geometry,
        views=FRONT,
    )
    assert found["shown"] == [1, 1, 0, 0] and found["free"] == [1, 1, 1, 1]
    assert found["all"] == [1, 0]  # the farthest first
    assert found["one"] == [1]  # the heaviest


KEYS = [
    ("m", "KeyM", "measure"),
    ("M", "KeyM", "measure"),
    ("m", "Semicolon", "measure"),  # of a French keyboard
    ("\u0442", "KeyN", "next"),  # of a Russian one
    ("b", "KeyN", "background"),  # of a Dvorak keyboard, whose N lies elsewhere
    ("l", "KeyP", "materials"),
    ("+", "BracketRight", "nearer"),  # of a German keyboard
    ("-", "Slash", "farther"),
    ("=", "Equal", "nearer"),
    ("-", "Minus", "farther"),
    ("z", "KeyW", "nearer"),  # as W lies
    ("x", "KeyX", None),
]
"""What is on a key, its place, and what it does."""


def test_keys_do_what_is_on_them() -> None:
    found = in_page(
        """
        return job.keys.map(([key, code]) => {
            const canvas = document.createElement("canvas"), done = [];
            const camera = new PerspectiveCamera(50, 1, 0.1, 100);
            camera.position.set(0, 0, 5);
            const controls = { target: new Vector3() };
            const walking = new Walking(canvas, camera, controls, 1, (action) => done.push(action), () => {});
            canvas.dispatchEvent(new KeyboardEvent("keydown", { key, code }));
            walking.step(0.05);
            // With Shift pressed meanwhile.
            canvas.dispatchEvent(new KeyboardEvent("keyup", { key: "*", code }));
            const { z } = camera.position;
            walking.step(0.05);
            return [done[0] ?? (z < 5 ? "nearer" : z > 5 ? "farther" : null), camera.position.z === z];
        });
        """,
        keys=[key[:2] for key in KEYS],
    )
    assert found == [[does, True] for _, _, does in KEYS]


@pytest.mark.parametrize("overlap", [3, 9, 16, 25])
def test_nothing_that_photographs_show_is_left_out_of_a_large_scene(overlap: int) -> None:
    """A field from above in 20 x 20 photographs, each point in ``overlap`` of them; and streaks far away."""
    side, height = 20, 10.0
    angle = 2 * np.degrees(np.arctan(np.sqrt(overlap) / 2 / height))
    places = [(x, y) for y in range(side) for x in range(side)]
    views = [{**view((x, y, height), (0, 0, -1)), "up": (0, 1, 0), "fov_y_degrees": angle} for x, y in places]
    random = np.random.default_rng(4)
    field = np.pad(random.uniform(2.5, side - 3.5, (300, 2)), ((0, 0), (0, 1)))
    streaks = random.uniform(200, 300, (60, 3))
    geometry = np.pad(np.concatenate([field, streaks]), ((0, 0), (0, 9)))
    found = in_page(
        "return Array.from(shownBy(360, new Float32Array(job.geometry), job.views));",
        geometry=geometry.ravel().tolist(),
        views=views,
    )
    assert found[:300] == [1] * 300
    # Where hardly any photograph shows what, streaks are not told from the field.
    assert found[300:] == [1 if overlap == 3 else 0] * 60


def test_panoramas_show_what_is_behind_them() -> None:
    """Four of six Gaussians are before no camera, but all of them are in each panorama."""
    means = [(0, 0, 9), (0.1, 0, 9), (0, 0, -9), (9, 0, 0), (-9, 0, 0), (0, 9, 0)]
    found = in_page(
        """
        const shown = (views) => Array.from(shownBy(6, new Float32Array(job.geometry), views));
        return [shown(job.views.map((one) => ({ ...one, panorama: true }))), shown(job.views)];
        """,
        geometry=[value for mean in means for value in (*mean, 0.9, *[0] * 8)],
        views=[view((0.1 * k, 0, 0), (0, 0, 1)) for k in range(4)] + [view((0, 0, 0), (1, 0, 0))] * 2,
    )
    assert found == [[1, 1, 1, 1, 1, 1], [1, 1, 0, 1, 0, 0]]


@pytest.mark.parametrize("count", [40_000, 1_000_000])
def test_frames_come_in_time_on_slow_and_fast_machines(count: int) -> None:
    """Frames of a renderer that takes a fixed time, so much a pixel and so much a Gaussian."""
    found = in_page(
        """
        const run = (fixed, full, each) => {
            const pacing = new Pacing(job.count), times = [];
            for (let k = 0; k < 40; k++) {
                const pixels = full * pacing.scale ** 2 * Math.sqrt(pacing.limit / job.count);
                times.push(fixed + pixels + each * pacing.limit);
                pacing.noteFrame(times.at(-1));
            }
            return { late: Math.max(...times.slice(8)), limit: pacing.limit, scale: pacing.scale };
        };
        return { slow: run(10, 1500, 2e-3), fast: run(2, 8, 2e-6) };
        """,
        count=count,
    )
    assert found["slow"]["late"] <= 100 and found["slow"]["limit"] < count
    assert found["fast"]["limit"] == count and found["fast"]["scale"] == 1
