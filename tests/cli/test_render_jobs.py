"""Jobs of the kinds ``render`` and ``relight``: the bytes of the commands, kept frames, former options."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from octasplat.engine.core.errors import CancelledError, ConfigError
from octasplat.engine.core.events import CheckpointWritten, Event, ImagesSaved, PhaseProgress, Warned
from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.registry import operation
from octasplat.engine.operations.relight import RelightRequest
from octasplat.engine.operations.render import RenderRequest
from octasplat.engine.render.environment_files import write_environment
from octasplat.engine.render.image_files import read_image
from octasplat.engine.runs.run_folder import run_viewpoints
from octasplat.workers.client.submission import Derivation, with_camera_path
from octasplat.workers.worker.handlers import run_operation
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.task import Task

POSE = [[1, 0, 0, 2], [0, 0, -1, 14], [0, 1, 0, 3], [0, 0, 0, 1]]
PATH = {
    "width": 32, "height": 24, "fps": 5,
    "frames": [{"camera_to_world": POSE, "fov_y_degrees": degrees} for degrees in (40, 50)],
}  # fmt: skip
SIZE = {"width_px": 32, "height_px": 24}
SIZE_WORDS = ("--width", 32, "--height", 24)
STAGE = "[[meshes]]\nshape = 'sphere'\nscale = 0.5\n[integrator]\nsamples = 2\n"


def attempt_of(kind: str, run: Path, folder: Path) -> Path:
    """The folder of a job's attempt, with what a run publishes."""
    (folder / "run").mkdir(parents=True)
    for name in get_job_kind(kind).source_files:
        if (run / name).exists():
            shutil.copy(run / name, folder / "run" / name)
    return folder


def kept_options(kind: str, options: dict) -> dict:
    """The options as the database keeps them."""
    dumped = get_job_kind(kind).resolve(options).model_dump(mode="json")
    again: dict = json.loads(json.dumps(dumped))
    assert get_job_kind(kind).resolve(again).model_dump(mode="json") == dumped
    return again


def results_of(kind: str, run: Path, folder: Path, options: dict, **task: object) -> Path:
    attempt = attempt_of(kind, run, folder)
    run_operation(Task(attempt, kept_options(kind, options), threads=1, kind=kind, **task))
    return attempt / "results"


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*")) if path.is_file()
    }  # fmt: skip


def assert_same_pictures(results: Path, output: Path) -> None:
    """The job has written what the command has."""
    if output.is_file():
        (name,) = contents(results)
        assert contents(results)[name] == output.read_bytes()
        assert (name in ("turntable.mp4", "path.mp4")) == (output.suffix == ".mp4")
    else:
        assert contents(results) == {f"views/{name}": data for name, data in contents(output).items()}


@pytest.mark.parametrize(
    ("options", "words", "output"),
    [
        ({"frames": 3, **SIZE}, ("--turntable", "--frames", 3, *SIZE_WORDS), "turn.mp4"),
        (
            {"seconds": 0.4, "fps": 5, "look_at": [1, 0, 0], "distance": 20, "elevation_degrees": 40, **SIZE},
            (
                "--turntable", "--seconds", 0.4, "--fps", 5, "--look-at", 1, 0, 0, "--distance", 20,
                "--elevation", 40, *SIZE_WORDS,
            ),
            "turn.mp4",
        ),
        (
            {"mode": "views", "views": "train", "format": "png", "max_side": 24, "background": "white"},
            ("--views", "train", "--max-side", 24, "--background", "white"),
            "views",
        ),
        (
            {"mode": "views", "format": "exr", "max_side": 24, "photographs": ["view_000.png"]},
            ("--photograph", "view_000.png", "--max-side", 24, "--exr"),
            "views",
        ),
        (
            {
                "mode": "camera", "camera": [12, 12, 8], "look_at": [0, 0, 0], "fov_y_degrees": 30,
                "background": "transparent", "format": "png", **SIZE,
            },
            (
                "--camera", 12, 12, 8, "--look-at", 0, 0, 0, "--fov", 30, "--background", "transparent",
                *SIZE_WORDS,
            ),
            "still",
        ),
        ({"mode": "path", "camera_path": PATH}, ("--path", "PATH"), "path.mp4"),
        (
            {"mode": "path", "camera_path": json.dumps(PATH), "format": "png"},
            ("--path", "PATH"),
            "path",
        ),
        (
            {"frames": 2, "format": "exr", "stage": STAGE, "layers": True, **SIZE},
            ("--turntable", "--frames", 2, "--stage", "STAGE", "--layers", *SIZE_WORDS),
            "layers",
        ),
    ],
)  # fmt: skip
def test_render_job_and_command_of_one_request_give_the_same_bytes(
    run, octasplat, tmp_path, options, words, output
):
    (tmp_path / "path.json").write_text(json.dumps(PATH))
    (tmp_path / "stage.toml").write_text(STAGE)
    places = {"PATH": tmp_path / "path.json", "STAGE": tmp_path / "stage.toml"}
    words = tuple(places.get(word, word) for word in words)
    done = octasplat("render", run.output, "-o", tmp_path / "out" / output, "--threads", 1, *words)
    assert done.exit_code == 0, done.output
    results = results_of("render", run.output, tmp_path / "attempt", options)
    assert_same_pictures(results, tmp_path / "out" / output)
    if "camera" in options:
        alpha = read_image(results / "views" / "frame_0000.png")[..., 3]
        assert alpha.min() < 0.1 < 0.9 < alpha.max()


def test_preview_job_is_one_picture(run, octasplat, tmp_path):
    (tmp_path / "stage.toml").write_text(STAGE)
    one = tmp_path / "preview.png"
    done = octasplat(
        "render", run.output, "-o", one, "--stage", tmp_path / "stage.toml", "--preview", "--max-side", 24,
        "--threads", 1,
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    options = {"mode": "views", "format": "png", "stage": STAGE, "preview": True, "max_side": 24}
    results = results_of("render", run.output, tmp_path / "attempt", options)
    assert contents(results) == {"views/preview.png": one.read_bytes()}


@pytest.mark.parametrize(
    ("options", "words", "output"),
    [
        (
            {"frames": 2, "spin": True, "rotation_degrees": 20, "clamp": 0.4, **SIZE},
            ("--turntable", "--frames", 2, "--spin", "--rotation", 20, "--clamp", 0.4, *SIZE_WORDS),
            "turn.mp4",
        ),
        (
            {
                "mode": "camera", "camera": [12, 12, 8], "format": "png", "background": "environment",
                "integrator": "path", "samples": 2, "max_bounces": 3, "up": "z", **SIZE,
            },
            (
                "--camera", 12, 12, 8, "--background", "environment", "--integrator", "path", "--samples", 2,
                "--max-bounces", 3, "--up", "z", *SIZE_WORDS,
            ),
            "still",
        ),
    ],
)  # fmt: skip
def test_relight_job_and_command_of_one_request_give_the_same_bytes(
    shiny_run, octasplat, tmp_path, options, words, output
):
    sides = np.zeros((16, 32, 3), np.float32)
    sides[:, 8:24, 0], sides[:, :8, 2] = 0.5, 0.5
    (tmp_path / "attempt" / "files").mkdir(parents=True)
    write_environment(tmp_path / "attempt" / "files" / "sides.exr", sides)
    light = ("--environment", tmp_path / "attempt" / "files" / "sides.exr", "--threads", 1)
    done = octasplat("relight", shiny_run, "-o", tmp_path / "out" / output, *light, *words)
    assert done.exit_code == 0, done.output
    options = {**options, "environments": ["sides.exr"]}
    assert_same_pictures(
        results_of("relight", shiny_run, tmp_path / "attempt", options), tmp_path / "out" / output
    )


def test_stage_init_job_matches_command(run, octasplat, tmp_path):
    done = octasplat("stage", "init", run.output, "--up", "x", "-o", tmp_path / "stage.toml")
    assert done.exit_code == 0 and "up is" in done.output, done.output
    assert "(up) goes with a file" in done.stderr
    results = results_of("stage-init", run.output, tmp_path / "attempt", {})
    assert contents(results) == {"stage.toml": (tmp_path / "stage.toml").read_bytes()}


def test_stage_job_tells_of_lamps_that_add_nothing_to_emissive_gaussians(run, tmp_path):
    heard: list[Event] = []
    lamp = {"kind": "directional", "direction": [0, 1, 0], "irradiance": 1, "adds_light": True}
    stage = {"gaussians": [{"light": "emissive"}], "lights": [lamp], "integrator": {"samples": 1}}
    results_of(
        "render",
        run.output,
        tmp_path / "attempt",
        {"mode": "turntable", "frames": 1, "format": "png", **SIZE, "stage": stage},
        progress=heard.append,
    )
    assert [
        event.message
        for event in heard
        if isinstance(event, Warned) and "lights[0].adds_light" in event.message
    ]


def test_stopped_render_job_resumes_from_stored_frames(run, octasplat, tmp_path):
    options = kept_options("render", {"frames": 5, **SIZE})
    first = attempt_of("render", run.output, tmp_path / "first")
    heard: list[Event] = []

    def two_are_done() -> bool:
        return any(isinstance(event, PhaseProgress) and event.step >= 2 for event in heard)

    with pytest.raises(CancelledError):
        run_operation(
            Task(first, options, threads=1, kind="render", progress=heard.append, should_stop=two_are_done)
        )
    # At once after the first one, and at the end; that one is done is not told to anybody else.
    stored = [event for event in heard if isinstance(event, CheckpointWritten)]
    assert [(event.iteration, event.path) for event in stored] == [(1, "frames"), (2, "frames")]
    assert not any(isinstance(event, ImagesSaved) for event in heard)
    frames = first / "run" / "frames"
    rows = [json.loads(line) for line in (frames / "unfinished.jsonl").read_text().splitlines()]
    assert [row["file"] for row in rows[1:]] == ["000000.png", "000001.png"]

    second = attempt_of("render", run.output, tmp_path / "second")
    shutil.copytree(frames, second / "run" / "frames")
    before = (second / "run" / "frames" / "000000.png").stat().st_mtime_ns
    rendered: list[int] = []

    def listen(event: Event) -> None:
        if isinstance(event, PhaseProgress) and event.part == 0:
            rendered.append(event.step)
        path = second / "run" / "frames" / "000000.png"
        assert not path.exists() or path.stat().st_mtime_ns == before

    run_operation(Task(second, options, threads=1, kind="render", progress=listen))
    assert min(rendered) == 2, "the kept frames are rendered again"
    whole = tmp_path / "whole.mp4"
    words = ("--turntable", "--frames", 5, *SIZE_WORDS, "--threads", 1)
    assert octasplat("render", run.output, "-o", whole, *words).exit_code == 0
    assert contents(second / "results") == {"turntable.mp4": whole.read_bytes()}


def test_options_of_the_last_version_are_still_read():
    """As a database of the last version has them, and what was left out then."""
    old = {
        "mode": "turntable", "views": "held-out", "format": "mp4", "frames": 120, "fps": 30.0,
        "width_px": 640, "height_px": 480, "fov_y_degrees": None, "max_side": None, "photographs": None,
        "background": None,
    }  # fmt: skip
    for asked in ({}, {**old, "stage": None}):
        found = get_job_kind("render").resolve(asked)
        assert (found.mode, found.format, found.frame_count, found.frame_rate) == (
            "turntable",
            "mp4",
            120,
            30,
        )
        assert (found.width_px, found.height_px, found.background) == (640, 480, None)
    light = {
        "environments": ["a.hdr"], "integrator": "path", "samples": None, "max_bounces": 6,
        "rotation_degrees": -90.0, "clamp": None, "spin": False,
    }  # fmt: skip
    found = get_job_kind("relight").resolve({**old, **light})
    assert [path.as_posix() for path in found.environments] == ["a.hdr"]
    assert (found.integrator, found.samples_per_pixel, found.rotation_degrees) == ("path", 64, -90)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"mode": "views"}, "views of photographs are images"),
        ({"photographs": ["a.png"]}, "choose the mode views"),
        ({"mode": "path"}, "`camera_path` go together"),
        ({"mode": "path", "camera_path": "{"}, "is no JSON"),
        ({"mode": "path", "camera_path": {**PATH, "frames": []}}, "at least 1 item"),
        ({"camera": [0, 0, 1]}, "`camera` go together"),
        ({"mode": "camera", "camera": [0, 0, float("nan")]}, "finite"),
        ({"mode": "camera", "camera": [0, 0, 1]}, "there is one image"),
        ({"mode": "camera", "camera": [0, 0, 1], "format": "png", "distance": 2}, "where the camera stands"),
        ({"mode": "views", "format": "png", "look_at": [0, 0, 1]}, "a turntable or a single camera"),
        ({"seconds": 3, "frames": 30}, "choose one of"),
        ({"seconds": 1e6}, "make more than 100,000"),
        ({"background": "transparent"}, "a video has no alpha"),
        ({"background": "transparent", "stage": STAGE}, "a video has no alpha"),
        ({"layers": True}, "goes with `stage`"),
        ({"layers": True, "stage": STAGE}, "choose the format exr"),
    ],
)  # fmt: skip
def test_contradictory_options_are_refused(options, words):
    with pytest.raises(ValidationError, match=words):
        get_job_kind("render").resolve(options)


def test_pixels_of_each_mode_are_counted_before_the_work(tmp_path):
    kind, sizes = get_job_kind("render"), [ImageSizes(100, 50, 4)]

    def pixels(options: dict) -> tuple[str, float]:
        found = kind.resource_demands(kind.resolve(options), sizes)
        (demand,) = [demand for demand in found if demand.resource == "render_pixels"]
        return demand.path, demand.amount

    assert pixels({"seconds": 2, "fps": 10, **SIZE}) == ("frames", 20 * 32 * 24)
    single = {"mode": "camera", "camera": [0, 0, 1], "format": "png"}
    assert pixels({**single, **SIZE}) == ("width_px", 32 * 24)
    keys = {**PATH, "frames": None, "keys": PATH["frames"], "seconds": 3}
    assert pixels({"mode": "path", "camera_path": keys}) == ("camera_path", 15 * 32 * 24)
    assert pixels({"mode": "views", "format": "png"}) == ("max_side", 4 * 100 * 50)
    (tmp_path / "path.json").write_text(json.dumps(PATH))
    sent = with_camera_path(Derivation("j", "render"), tmp_path / "path.json")
    assert pixels(dict(sent.options)) == ("camera_path", 2 * 32 * 24)


def test_numbered_images_are_gone_on_with_for_the_same_views_only(run, octasplat, tmp_path):
    frames, images = tmp_path / "%04d.png", []
    names = [view.name for view in run_viewpoints(run.output).views][:4]
    with pytest.raises(CancelledError):
        operation("render").run(
            RenderRequest(source=run.output, output=frames, photographs=names[:3]),
            progress=images.append,
            should_stop=lambda: len([event for event in images if isinstance(event, PhaseProgress)]) > 1,
        )
    assert (tmp_path / "0000.png").exists()
    others = [word for name in names[1:] for word in ("--photograph", name)]
    refused = octasplat("render", run.output, *others, "-o", frames, "--resume")
    assert refused.exit_code == 1 and "another render" in refused.stderr
    same = [word for name in names[:3] for word in ("--photograph", name)]
    assert octasplat("render", run.output, *same, "-o", frames, "--resume").exit_code == 0


@pytest.mark.parametrize("verb", ["render", "relight"])
def test_images_that_move_are_gone_on_with_in_the_same_order_only(shiny_run, tmp_path, verb):
    """Keys and turns count images, so that the same photographs in another order are other images."""
    names, images = [view.name for view in run_viewpoints(shiny_run).views][:3], []
    options: dict[str, object] = {"source": shiny_run, "output": tmp_path / "views", "max_side": 16}
    if verb == "relight":
        options |= {"environments": (shiny_run / "environment.exr",), "spin": True}
        options |= {"integrator": "path", "samples": 1}
    else:
        keys = [{"frame": frame, "position": [0, -frame, 0]} for frame in range(3)]
        lamp = {"kind": "point", "position": [0, 0, 0], "intensity": 1, "keys": keys}
        options["stage"] = {"lights": [lamp], "integrator": {"samples": 1}}
    request = {"render": RenderRequest, "relight": RelightRequest}[verb]
    with pytest.raises(CancelledError):
        operation(verb).run(
            request(photographs=names, **options),
            progress=images.append,
            should_stop=lambda: any(isinstance(event, ImagesSaved) for event in images),
        )
    assert len(list((tmp_path / "views").glob("*.png"))) == 1
    with pytest.raises(ConfigError, match="another render"):
        operation(verb).run(request(photographs=names[::-1], resume=True, **options))


def test_options_without_effect_on_cameras_are_warned_of(run, octasplat, tmp_path):
    one = ("--turntable", "--frames", 1, *SIZE_WORDS)
    vain = ("--max-side", 16, "--fps", 5, "--up", "x")
    done = octasplat("render", run.output, *one, *vain, "-o", tmp_path / "one.png")
    assert done.exit_code == 0 and "(up) goes with a file" in done.stderr, done.output
    assert "(max_side) goes with views of photographs" in done.stderr and "(fps) goes with" in done.stderr
    done = octasplat("render", run.output, "--views", "held-out", "--fov", 20, "-o", tmp_path / "views")
    assert done.exit_code == 0 and "(fov_y_degrees) goes with" in done.stderr, done.output
    vain = ("--frames", 3, "--width", 32, "--height", 32)
    done = octasplat("render", run.output, "--views", "held-out", *vain, "-o", tmp_path / "a")
    assert done.exit_code == 0, done.output
    for name in ("frames", "width_px", "height_px"):
        assert f"({name}) goes with a turntable" in done.stderr
    done = octasplat("render", run.output, *one, "--fov", 20, "-o", tmp_path / "two.png")
    assert done.exit_code == 0 and "passed over" not in done.output


def test_photographs_beside_a_file_are_refused(run, octasplat, tmp_path):
    scene, results = tmp_path / "scene.ply", tmp_path / "results"  # no scene of a run, which has photographs
    shutil.copyfile(run.output / "scene.ply", scene)
    commands = (
        ("render", scene, "--camera", 0, 0, -4, "-o", results / "a.png"),
        ("info", scene),
        ("stage", "init", scene, "-o", results / "stage.toml"),
    )
    for command in commands:
        refused = octasplat(*command, "--dataset", run.scene)
        assert refused.exit_code == 1 and "no folder of a run" in refused.stderr, refused.output
    assert list(tmp_path.iterdir()) == [scene]


def test_preview_job_counts_pixels_of_one_image():
    kind = get_job_kind("render")
    stage = {"frames": 9, **SIZE, "format": "png", "stage": STAGE}
    pixels = [
        kind.resource_demands(kind.resolve({**stage, "preview": on}), [])[0].amount for on in (False, True)
    ]
    assert pixels == [9 * 32 * 24, 32 * 24]
