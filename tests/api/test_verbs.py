"""The functions of verbs are those that their requests say."""

import inspect
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from write_verbs import PYTHON_NAMES, VERBS, source

import octasplat as osp
import octasplat.verbs
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.events import Event, PhaseProgress, Warned
from octasplat.engine.operations.base import build_request
from octasplat.engine.operations.registry import operation, operation_names
from octasplat.engine.settings.fields import Spelling, Unit
from octasplat.operation_calls import explicit_values


def test_verbs_are_written_from_the_requests() -> None:
    assert VERBS.read_text(encoding="utf-8") == source(), "run python tests/api/write_verbs.py"


@pytest.mark.parametrize("name", operation_names())
def test_operations_have_package_functions(name: str) -> None:
    function = getattr(osp, PYTHON_NAMES.get(name, name))
    if name != "render":  # which also takes a scene and a camera
        assert function is getattr(octasplat.verbs, PYTHON_NAMES.get(name, name))
    parameters = inspect.signature(getattr(octasplat.verbs, PYTHON_NAMES.get(name, name))).parameters
    fields = operation(name).request.model_fields
    assert set(fields) <= set(parameters) <= {*fields, "progress", "should_stop", "threads", "on_step"}


def test_refused_values_have_the_sentence_of_the_request(scene_file: Path, tmp_path: Path) -> None:
    values = {"source": scene_file, "output": tmp_path / "a.ply", "where": "color > 3 and"}
    with pytest.raises(ConfigError) as expected:
        build_request(operation("crop").request, values)
    with pytest.raises(ConfigError) as found:
        osp.crop(scene_file, tmp_path / "a.ply", where="color > 3 and")
    assert str(found.value) == str(expected.value)


def test_arrays_and_strings_are_taken_where_numbers_and_paths_are(scene_file: Path, tmp_path: Path) -> None:
    box = np.array([-2.0, -2, -2, 2, 2, 0])
    assert osp.crop(str(scene_file), str(tmp_path / "half.ply"), box=box).kept == 600


def test_misspelt_option_is_refused_with_nearest_name(scene_file: Path, tmp_path: Path) -> None:
    wrong = {"spere": (0, 0, 0, 1)}
    with pytest.raises(osp.ConfigError, match="crop has no option 'spere'; the nearest is sphere") as found:
        osp.crop(scene_file, tmp_path / "a.ply", **wrong)
    assert isinstance(found.value, TypeError)
    scene = osp.load(scene_file)
    with pytest.raises(osp.ConfigError, match="the nearest is background"):
        osp.render(scene, scene.camera(), **{"backgroud": "white"})


def test_option_can_disable_preset_feature() -> None:
    request = operation("surface").request
    values = {"source": "run", "output": "a.glb", "room": True, "refine_vertices": False, "backdrop": None}
    found = build_request(request, explicit_values(request, values))
    assert (found.refine_vertices, found.backdrop, found.unbounded) == (False, True, True)
    parameter = inspect.signature(osp.surface).parameters["refine_vertices"]
    assert parameter.default is None


@pytest.mark.parametrize("verb", ["import_", "export", "surface", "crop"])
def test_output_over_input_scene_is_refused(verb: str, scene_file: Path, finished_run: Path) -> None:
    options = {"where": "opacity > 0.5"} if verb == "crop" else {}
    for scene, output in ((scene_file, scene_file), (finished_run, finished_run / "scene.ply")):
        before = output.read_bytes()
        with pytest.raises(osp.ConfigError, match="would overwrite what the command reads"):
            getattr(osp, verb)(scene, [output] if verb == "export" else output, **options)
        assert output.read_bytes() == before


@pytest.mark.parametrize(
    ("verb", "options"),
    [
        ("crop", {"where": "opacity > 0.5"}),
        ("clean", {}),
        ("simplify", {"count": 300}),
        ("transform", {"scale": 2.0}),
        ("material", {"set": {"roughness": 0.3}}),
        ("import_", {}),
        ("export", {}),
        ("edit", {"meshes": ["mesh.ply"]}),
        ("deform", {"proxy": "cage.obj", "deformed": ["bent.obj"]}),
    ],
)
def test_stopped_operation_writes_no_output(verb: str, options: dict[str, Any], in_folder: Path) -> None:
    osp.export("scene.ply", ["mesh.ply"], format="mesh-ply")
    source = "shiny.ply" if verb == "material" else "scene.ply"
    with pytest.raises(osp.CancelledError):
        output = ["other.ply"] if verb == "export" else "other.ply"
        getattr(osp, verb)(source, output, should_stop=lambda: True, **options)
    assert not Path("other.ply").exists()


def test_render_sequence_reports_progress_and_stops_between_images(in_folder: Path) -> None:
    events: list[Event] = []
    bent = ["bent.obj", "cage.obj", "bent.obj"]
    with pytest.raises(osp.CancelledError):
        osp.deform(
            "scene.ply", "%d.ply", proxy="cage.obj", deformed=bent, progress=events.append,
            should_stop=lambda: len(events) == 2,
        )  # fmt: skip
    assert events == [PhaseProgress("edit", 1, 3), PhaseProgress("edit", 2, 3)]
    assert Path("1.ply").exists() and not Path("2.ply").exists()


def test_meshes_of_one_stem_have_scenes_of_their_own(in_folder: Path) -> None:
    for folder in ("a", "b"):
        Path(folder).mkdir()
        osp.export("scene.ply", [f"{folder}/mesh.ply"], format="mesh-ply")
    shutil.copy("a/mesh.ply", "other.ply")
    meshes = ["a/mesh.ply", "other.ply", "b/mesh.ply"]
    files = osp.edit("scene.ply", "scenes", meshes=meshes).files
    assert [path.name for path in files] == ["mesh_0000.ply", "other.ply", "mesh_0002.ply"]
    assert all(path.exists() for path in files)


def test_reports_overwrite_no_input(in_folder: Path) -> None:
    osp.export("scene.ply", ["mesh.ply"], format="mesh-ply")
    before = Path("scene.ply").read_bytes(), Path("mesh.ply").read_bytes()
    for report in ("mesh.ply", "scene.ply", "edited.ply"):
        with pytest.raises(osp.ConfigError, match="would overwrite"):
            osp.edit("scene.ply", "edited.ply", meshes=["mesh.ply"], report=report)
    with pytest.raises(osp.ConfigError, match="would overwrite"):
        osp.info("scene.ply", output="scene.ply")
    assert before == (Path("scene.ply").read_bytes(), Path("mesh.ply").read_bytes())


def test_completed_export_is_not_reported_as_stopped(in_folder: Path) -> None:
    asked = iter((False, True))
    osp.export("scene.ply", ["other.ply"], should_stop=lambda: next(asked))
    assert Path("other.ply").exists()


def test_export_accepts_a_single_path(in_folder: Path) -> None:
    assert osp.export("scene.ply", "one.glb").files == (Path("one.glb"),)
    assert osp.export("scene.ply", Path("two.spz")).files == (Path("two.spz"),)
    assert Path("one.glb").exists() and Path("two.spz").exists()


def test_split_sum_reports_sample_count(in_folder: Path) -> None:
    told: list[Event] = []
    one = {"mode": "turntable", "frames": 1, "width_px": 16, "height_px": 16, "progress": told.append}
    osp.relight("shiny.ply", "a.png", environments=["studio.hdr"], samples=5, **one)
    assert any(isinstance(event, Warned) and "Of 5 samples" in event.message for event in told)
    told.clear()
    osp.relight("shiny.ply", "b.png", environments=["studio.hdr"], samples=9, **one)
    assert not any(isinstance(event, Warned) for event in told)


def test_value_alone_stands_for_the_only_one(scene_file: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.ply"
    shutil.copy(scene_file, other)
    assert osp.merge(scene_file, tmp_path / "both.ply", other).counts == (1200, 1200)
    assert osp.merge(scene_file, tmp_path / "both.ply", str(other)).counts == (1200, 1200)
    turned = osp.transform(scene_file, tmp_path / "turned.ply", rotate=("x", 90))
    np.testing.assert_allclose(turned.matrix[1], (0, 0, -1, 0), atol=1e-12)
    given = explicit_values(
        operation("reconstruct").request, {"held_out": "view_003.png", "exports": "a.spz"}
    )
    assert given == {"held_out": ("view_003.png",), "exports": "a.spz"}


def test_values_of_another_kind_are_refused_in_plain_words(scene_file: Path, tmp_path: Path) -> None:
    scene, target = osp.load(scene_file), tmp_path / "a.ply"
    with pytest.raises(
        osp.ConfigError, match=r"^source: must be the path of a file or folder, not a Scene; wr"
    ):
        osp.crop(scene, target, sphere=(0, 0, 0, 1))  # type: ignore[arg-type]
    with pytest.raises(osp.ConfigError, match=r"^matrix: must be a 4 x 4 or 3 x 4 matrix of numbers, or"):
        osp.transform(scene_file, target, matrix=scene)  # type: ignore[arg-type]
    with pytest.raises(osp.ConfigError, match=r"^up: must be a list, not a str"):
        osp.transform(scene_file, target, up="z")  # type: ignore[arg-type]
    with pytest.raises(osp.ConfigError, match=r"^threads: must be 0"):
        osp.crop(scene_file, target, sphere=(0, 0, 0, 1), threads=-1)
    with pytest.raises(TypeError, match="save takes a scene"):
        osp.save(scene_file, target)  # type: ignore[arg-type]


def test_matrix_of_numbers_moves_as_that_of_a_file_does(scene_file: Path, tmp_path: Path) -> None:
    matrix = np.array([[0.0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]])
    np.savetxt(tmp_path / "matrix.txt", matrix)
    by_file = osp.transform(scene_file, tmp_path / "file.ply", matrix=tmp_path / "matrix.txt")
    expected = (tmp_path / "file.ply").read_bytes()
    for number, given in enumerate(
        (matrix, matrix.astype(np.float32), matrix[:3], matrix.tolist(), tuple(matrix[:3]))
    ):
        target = tmp_path / f"{number}.ply"
        assert osp.transform(scene_file, target, matrix=given).matrix == by_file.matrix
        assert target.read_bytes() == expected


@pytest.mark.parametrize(
    ("matrix", "sentence"),
    [
        (np.eye(3), r"must be a 4 x 4 or 3 x 4 matrix, .* what is given is 3 x 3\.$"),
        (np.zeros((2, 4, 4)), r"what is given is 2 x 4 x 4\.$"),
        (np.arange(16), r"what is given is 16\.$"),
        ([[1, 0, 0, 0], [0, 1, 0]], "must be a 4 x 4 or 3 x 4 matrix of numbers"),
        ([["a"] * 4] * 4, "must be a 4 x 4 or 3 x 4 matrix of numbers"),
        (3.0, "what is given is a single number"),
        (np.full((4, 4), np.nan), "must have finite numbers only"),
        (np.full((3, 4), np.inf), "must have finite numbers only"),
        (np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [5, 0, 0, 1]]), "the last row 0 0 0 1"),
        (np.diag([1.0, 1, 0, 1]), "flattens space"),
    ],
)
def test_what_is_no_affine_matrix_is_refused_in_one_sentence(
    matrix: Any, sentence: str, scene_file: Path, tmp_path: Path
) -> None:
    with pytest.raises(osp.ConfigError, match=sentence) as refused:
        osp.transform(scene_file, tmp_path / "a.ply", matrix=matrix)
    assert "\n" not in str(refused.value) and not (tmp_path / "a.ply").exists()


def test_sheared_run_says_what_is_lost(in_folder: Path) -> None:
    """A matrix that is no similarity is taken, by numbers as by a file."""
    sheared, told = np.eye(4), []
    sheared[0, 1] = 0.5
    osp.transform("run", "sheared", matrix=sheared, progress=told.append)
    assert any(isinstance(event, Warned) and "mirrored, sheared or" in event.message for event in told)
    osp.transform("run", "moved", matrix=np.diag([2.0, 2, 2, 1]))
    with pytest.raises(
        osp.OctasplatError, match=r"moved was moved, and its photographs .* stand where they st"
    ):
        osp.evaluate("moved")
    record = json.loads(Path("sheared/edits.json").read_text())[-1]
    assert record["matrix"] == sheared.tolist()[:4]


def test_merge_takes_a_list_of_all_scenes(in_folder: Path) -> None:
    osp.crop("scene.ply", "half.ply", where="z < 0")
    assert osp.merge(["scene.ply", "half.ply"], "two.ply").counts == (1200, 600)
    assert osp.merge("scene.ply", "same.ply", ["half.ply"]).counts == (1200, 600)
    assert Path("two.ply").read_bytes() == Path("same.ply").read_bytes()
    three = osp.merge((Path("scene.ply"), osp.Run("run")), "three.ply", "half.ply")
    assert three.counts[0] == 1200 and three.counts[2] == 600
    for few in ([], ["scene.ply"]):
        with pytest.raises(osp.ConfigError, match="Name at least two scenes"):
            osp.merge(few, "none.ply")
    with pytest.raises(osp.ConfigError, match="write the scene to a file first"):
        osp.merge([osp.load("scene.ply"), osp.load("half.ply")], "none.ply")  # type: ignore[list-item]
    with pytest.raises(osp.ConfigError, match="would overwrite"):
        osp.merge(["scene.ply", "half.ply"], "half.ply")


def test_settings_by_name_are_those_of_texts() -> None:
    request = operation("reconstruct").request
    quat = np.float32(0.25)
    texts = ["lr.quat=0.25", "test_every=4", "exposure=true", "background=white"]
    by_name = {"lr.quat": quat, "test_every": np.int64(4), "exposure": True, "background": "white"}
    configs = [
        build_request(
            request, explicit_values(request, {"source": "photos", "output": "out", "set": given})
        ).config()
        for given in (texts, tuple(texts), by_name)
    ]
    trains = [{"lr.quat": 0.25, "lr": {"mean": 0.5}}, {"lr": {"quat": 0.25, "mean": 0.5}}]
    by_dots, by_sections = (
        build_request(request, {"source": "photos", "output": "out", "train": train}) for train in trains
    )
    assert by_dots.config() == by_sections.config() and by_dots.requested() == by_sections.requested()
    assert configs[0] == configs[1] == configs[2]
    assert configs[0].train.lr.quat == 0.25 and configs[0].test_every == 4
    alone = explicit_values(request, {"source": "photos", "output": "out", "set": "lr.quat=0.25"})
    assert build_request(request, alone).config().train.lr.quat == 0.25


def test_one_name_has_one_meaning_and_one_unit_in_all_verbs() -> None:
    """Names of options, of Python and of the fields of jobs are the same; so are their units."""
    units: dict[str, set[str]] = {}
    flags: dict[str, set[str]] = {}
    for name in operation_names():
        for field, info in operation(name).request.model_fields.items():
            unit = next((mark.symbol for mark in info.metadata if isinstance(mark, Unit)), "")
            units.setdefault(field, set()).add(unit)
            spellings = [mark for mark in info.metadata if isinstance(mark, Spelling)]
            if any(spelling.hidden for spelling in spellings):
                continue
            own = [flag for spelling in spellings for flag in spelling.flags]
            for flag in own or ["--" + field.replace("_", "-")]:
                flags.setdefault(flag, set()).add(field)
    assert {field: found for field, found in units.items() if len(found) > 1} == {}
    # the mesh that chooses Gaussians, and the edited ones
    assert {flag: found for flag, found in flags.items() if len(found) > 1} == {"--mesh": {"mesh", "meshes"}}
    angles = {field for field, found in units.items() if found == {"degrees"}}
    assert all(field.endswith("_degrees") for field in angles - {"rotate"})  # whose values name the axis, too


def test_cameras_of_a_scene_have_the_names_of_all_others(scene_file: Path) -> None:
    scene, shared = osp.load(scene_file), {"width_px", "height_px", "fov_y_degrees"}
    for function in (scene.camera, scene.turntable, osp.Camera.looking_at, octasplat.verbs.render):
        assert shared <= set(inspect.signature(function).parameters)
    camera = scene.camera(width_px=96, height_px=48, fov_y_degrees=60)
    assert (camera.width_px, camera.height_px) == (96, 48)
    assert np.degrees(2 * np.arctan(24 / camera.fy_px)) == pytest.approx(60)


def test_too_few_and_too_many_values_are_told_in_plain_words(scene_file: Path, tmp_path: Path) -> None:
    target = tmp_path / "a.ply"
    with pytest.raises(
        osp.ConfigError, match=r"^box\.5: is missing; the 5 values that are given are too few\."
    ):
        osp.crop(scene_file, target, box=(0, 0, 0, 1, 1))
    with pytest.raises(osp.ConfigError, match=r"^sphere: must have at most 4 values, not 5\."):
        osp.crop(scene_file, target, sphere=(0, 0, 0, 1, 1))
    with pytest.raises(osp.ConfigError, match=r"^files: must have at least 1 value, not 0\."):
        osp.export(scene_file, [])


def test_name_without_its_unit_is_refused_with_the_whole_name(scene_file: Path, tmp_path: Path) -> None:
    with pytest.raises(osp.ConfigError, match="render has no option 'fov'; the nearest is fov_y_degrees"):
        osp.render(scene_file, tmp_path / "a.png", **{"fov": 40})


def test_one_size_alone_is_measured(in_folder: Path) -> None:
    assert set(osp.evaluate("run", scales=2).scales) == {"1/2"}


def test_video_and_number_of_frames_mean_a_turntable_of_a_run(in_folder: Path) -> None:
    size = {"width_px": 32, "height_px": 16}
    assert osp.render("run", "turn.mp4", frames=2, **size).images == 2
    assert osp.render("run", "turn", frames=3, **size).images == 3
    assert osp.render("run", "one.png", look_at=(0, 0, 0), frames=1, **size).images == 1
    assert osp.render("run", "views").images == 2
    with pytest.raises(osp.ConfigError, match="a video a turntable or a path of cameras"):
        osp.render("run", "turn.mp4", views="held-out")
