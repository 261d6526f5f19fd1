"""Things and lamps that move in a film: each image is that of a stage in which they stand where keys say."""

import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from octasplat.engine.core.errors import OctasplatError
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.pathtracing.mesh_shapes import transform_points, up_axis_rotation
from octasplat.engine.pathtracing.stage.model import DirectionalLight, Stage
from octasplat.engine.pathtracing.stage.stage_file import read_stage
from octasplat.engine.pathtracing.stage_motion import stage_at
from octasplat.engine.pathtracing.stage_placement import Ray, place_resting_meshes
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceSettings
from octasplat.workers.cli.main import cli
from tests.support.light_scenes import table_with_a_box

STAGE = """
[[meshes]]
shape = "cube"
scale = 0.1
on = {{ origin = [0.6, -2, 0.5], direction = [0, 1, 0] }}
{mesh}
[[lights]]
kind = "spot"
position = [-1, -2, 0]
direction = [0, 1, 0]
intensity = 9
adds_light = true
{light}
[integrator]
samples = 2
"""
MESH_KEYS = """
[[meshes.keys]]
frame = 0
position = [0, 0, 0]
turn_degrees = 0
[[meshes.keys]]
frame = 2
position = [0, -0.5, 0.25]
turn_degrees = 90
"""
LIGHT_KEYS = "keys = [{ frame = 1, direction = [0, 3, 0] }, { frame = 2, direction = [1, 1, 0] }]"
PLACES = (
    ("position = [0, 0, 0]", "", "[0, 1, 0]"),
    ("position = [0, -0.25, 0.125]", "turn_degrees = 45", "[0, 1, 0]"),
    ("position = [0, -0.5, 0.25]", "turn_degrees = 90", "[1, 1, 0]"),
)
"""Of the mesh and the lamp in the three images."""


def octasplat(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def test_each_image_shows_things_where_keys_say(tmp_path: Path) -> None:
    scene = tmp_path / "scene.ply"
    write_gaussian_ply(table_with_a_box(), scene)
    small = ("--turntable", "--frames", 3, "--width", 40, "--height", 30, "--threads", 2)

    def rendered(name: str, text: str) -> list[bytes]:
        stage, output = tmp_path / f"{name}.toml", tmp_path / name
        stage.write_text(text)
        done = octasplat("render", scene, "--stage", stage, "-o", output, *small)
        assert done.exit_code == 0, done.output
        return [path.read_bytes() for path in sorted(output.glob("*.png"))]

    moving = rendered("moving", STAGE.format(mesh=MESH_KEYS, light=LIGHT_KEYS))
    assert len(moving) == 3
    for number, (position, turn, direction) in enumerate(PLACES):
        text = STAGE.format(mesh=f"{position}\n{turn}", light="")
        still = rendered(
            f"still{number}", text.replace("direction = [0, 1, 0]\nint", f"direction = {direction}\nint")
        )
        assert moving[number] == still[number]


def test_values_rest_before_and_after_their_keys() -> None:
    keys = [
        {"frame": 2, "position": (0, 0, 0)},
        {"frame": 6, "position": (4, 0, 0)},
        {"frame": 9, "turn_degrees": 30},
    ]
    stage = Stage.model_validate({"meshes": [{"shape": "cube", "turn_degrees": 7, "keys": keys}]})
    for frame, x in ((0, 0.0), (2, 0.0), (3, 1.0), (6, 4.0), (100, 4.0)):
        [mesh] = stage_at(stage, frame).meshes
        assert mesh.position == (x, 0.0, 0.0) and mesh.turn_degrees == 30.0 and not mesh.keys


@pytest.mark.parametrize("tilt", [(0.0, 0.0, 0.0), (0.0, 0.0, 20.0)])
def test_what_turns_where_it_stands_does_not_sway(tilt: tuple[float, ...], tmp_path: Path) -> None:
    # an L, whose box has another middle at each turn
    corners = [(0, 0, 0), (1, 0, 0), (1, 0, 0.2), (0.2, 0, 0.2), (0.2, 0, 1), (0, 0, 1), (0, -0.2, 0)]
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
    (tmp_path / "l.obj").write_text(text + "f 1 2 3\nf 1 3 4\nf 1 4 5\nf 1 5 6\nf 1 7 2\n")
    tracer = make_tracer(TraceSettings(), threads=1)
    tracer.build(table_with_a_box())
    keys = [{"frame": 0, "turn_degrees": 0}, {"frame": 8, "turn_degrees": 360}]
    on = {"origin": (0.5, -2, 0.5), "direction": (0, 1, 0)}
    stage = Stage.model_validate(
        {"meshes": [{"file": "l.obj", "scale": 0.3, "rotation_degrees": tilt, "on": on, "keys": keys}]}
    )
    middles, heights = [], []
    for frame in range(9):
        [mesh] = place_resting_meshes(stage_at(stage, frame), tracer, _no_photographs, tmp_path).meshes
        turn = up_axis_rotation("world", mesh.turn_degrees, np.array([0.0, -1.0, 0.0]))
        placed = transform_points(np.array(corners, np.float64), mesh, turn)
        middle = transform_points(np.array([[0.5, -0.1, 0.5]]), mesh, turn)[0]
        middles.append(middle[[0, 2]])
        heights.append(placed[:, 1].max())
    if not any(tilt):
        np.testing.assert_allclose(middles, 0.5, atol=1e-9)
    assert np.ptp(middles, axis=0).max() < 0.02
    # it stands on the table all the time
    np.testing.assert_allclose(heights, heights[0], atol=1e-9)


def _no_photographs(name: str, _pixel: tuple[float, float]) -> Ray:
    raise AssertionError(name)


@pytest.mark.parametrize("degrees", [0.0, 10.0, 90.0, 170.0])
def test_directions_turn_evenly_between_keys(degrees: float) -> None:
    keys = [
        {"frame": frame, "direction": (5 * math.cos(angle), 0, 5 * math.sin(angle))}
        for frame, angle in ((0, 0.0), (4, math.radians(degrees)))
    ]
    lamp = {"kind": "directional", "irradiance": 1, "direction": (1, 0, 0), "keys": keys}
    stage = Stage.model_validate({"lights": [lamp]})
    for frame in range(5):
        [light] = stage_at(stage, frame).lights
        assert isinstance(light, DirectionalLight)
        x, y, z = light.direction
        assert math.degrees(math.atan2(z, x)) == pytest.approx(degrees * frame / 4, abs=1e-6) and y == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[[meshes]]\nshape = 'cube'\nkeys = [{ frame = 1 }]", "the key moves nothing"),
        (
            "[[meshes]]\nshape = 'cube'\n"
            "keys = [{ frame = 1, turn_degrees = 0 }, { frame = 1, turn_degrees = 1 }]",
            "must rise from key to key",
        ),
        (
            "[[lights]]\nkind = 'directional'\nirradiance = 1\ndirection = [0, 1, 0]\n"
            "keys = [{ frame = 0, position = [0, 0, 0] }]",
            "keys give `position`, which this kind does not have",
        ),
        (
            "[[lights]]\nkind = 'directional'\nirradiance = 1\ndirection = [0, 1, 0]\n"
            "keys = [{ frame = 0, direction = [0, 1, 0] }, { frame = 5, direction = [0, -2, 0] }]",
            "turns half round between two keys",
        ),
    ],
)  # fmt: skip
def test_impossible_keys_are_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "stage.toml").write_text(text)
    with pytest.raises(OctasplatError, match=words):
        read_stage(tmp_path / "stage.toml")
