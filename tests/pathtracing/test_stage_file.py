"""Stage files: what is refused and in which words, and the first stage that is written."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.files import read_mesh
from octasplat.engine.pathtracing.stage.materials import Diffuse, Glass, MetallicRoughness
from octasplat.engine.pathtracing.stage.model import (
    Environment,
    Integrator,
    LightModel,
    PointLight,
    RectangleLight,
    SpotLight,
    Stage,
    StageGaussians,
)
from octasplat.engine.pathtracing.stage.stage_file import parse_stage, read_stage
from octasplat.engine.pathtracing.stage.stage_template import StageLayout, StageLight, write_stage_template
from tests.support.bad_stages import BAD_STAGES, VALIDATORS_WORDS

GOLD = '[[meshes]]\nshape = "sphere"\nmaterial = {{ kind = "metal", {key} = [0.9, 0.8, 0.5] }}\n'
BALL = '[[meshes]]\nshape = "sphere"\n'


def test_stage_file_with_all_keys_is_read(tmp_path: Path) -> None:
    for name in ("a.glb", "b.png", "c.hdr", "d.ply"):
        (tmp_path / name).write_bytes(b"?")
    (tmp_path / "stage.toml").write_text(
        """
        up = [0, 0, 1]
        [[gaussians]]
        light = "relit"
        [[gaussians]]
        file = "d.ply"
        scale = 2
        [[meshes]]
        file = "a.glb"
        on = { view = "0001.jpg", pixel = [10.5, 20] }
        material = { kind = "metallic-roughness", texture = "b.png" }
        [[meshes]]
        shape = "cube"
        scale = [1, 2, 3]
        material = { kind = "glass", ior = 1.33, absorption = [1, 0, 0] }
        [[lights]]
        kind = "point"
        position = [1, 2, 3]
        intensity = 5
        [environment]
        file = "c.hdr"
        [integrator]
        samples = 4
        """
    )
    stage = read_stage(tmp_path / "stage.toml")
    assert [scene.light for scene in stage.gaussians] == ["relit", None]
    assert isinstance(stage.meshes[0].material, MetallicRoughness)
    assert stage.meshes[1].material == Glass(ior=1.33, absorption=(1, 0, 0))
    assert isinstance(stage.lights[0], PointLight) and stage.integrator.samples == 4
    assert stage.environment is not None and stage.up == (0, 0, 1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("up = [0, 1", "no TOML"),
        ("color = 3", "no key color"),
        (BALL + "color = 3", r"no key meshes\[0\]\.color"),
        (
            BALL + 'material = { kind = "mirror", roughness = 0.5 }',
            r"no key meshes\[0\]\.material\.roughness",
        ),
        (BALL + 'material = { kind = "velvet" }', r"meshes\[0\]\.material"),
        (BALL + "position = [0, nan, 0]", r"meshes\[0\]\.position\[1\].*finite"),
        (BALL + "scale = inf", r"meshes\[0\]\.scale"),
        (BALL + "scale = 0", r"meshes\[0\]\.scale"),
        (BALL + 'file = "x.ply"', "either a file or a shape"),
        (BALL + 'on = { view = "a.jpg" }', "either view and pixel, or origin and direction"),
        (BALL + 'material = { kind = "diffuse", emission = -1 }', r"meshes\[0\]\.material\.emission"),
        ('[[lights]]\nkind = "point"\nposition = [0, 0, 0]\nintensity = 1\nradius = -1', r"\.radius"),
        (
            '[[lights]]\nkind = "point"\nposition = [0, 0, 0]\nintensity = 1\n'
            "only_shadows = true\nadds_light = true",
            "only_shadows casts shadows and adds no light",
        ),
        (
            '[[gaussians]]\nlight = "relit"\n[[lights]]\nkind = "point"\nposition = [0, 0, 0]\n'
            "intensity = 1\nonly_shadows = true",
            r'lights: the shadows of lights\[0\] .* light = "shadowed" alone, and this stage has none; give',
        ),
        ('[[lights]]\nkind = "point"\nposition = [0, 0, 0]', r"lights\[0\].*intensity"),
        ('[[lights]]\nkind = "point"\nposition = [0, 0, 0]\nintensity = -1', r"lights\[0\]\.intensity"),
        ('[[lights]]\nkind = "directional"\ndirection = [0, 0, 0]\nirradiance = 1', "has no length"),
        ("up = [0, 0, 0]", "up has no length"),
        ("[integrator]\naperture = 0.1", "needs a focus_distance"),
        ("[integrator]\nsamples = 0", r"integrator\.samples"),
        ("[integrator]\nsamples = true", r"samples: must be a whole number from 1 to 65536 \(it is true\)"),
        (BALL + "scale = true", r"scale: must be one positive number, or three .* \(it is true\)"),
        (BALL + "scale = [1, 1, true]", r"scale: must be .* \(it is \[1, 1, true\]\)"),
        (
            '[[lights]]\nkind = "point"\nposition = [0, 0, 0]\nintensity = true',
            r"intensity: must be a number of 0 or more \(it is true\)",
        ),
        (
            BALL + 'material = { kind = "glass", ior = true }',
            r"ior: must be a number from 1 to 4",
        ),
        ("version = true", r"version: must be 1 \(it is true\)"),
        ("[[gaussians]]\nscale = [1, 2, 3]", "one scale"),
        ("[[lights]]\nposition = [0, 0, 0]", r"lights\[0\]: has no `kind`"),
        ('[[lights]]\nkind = "lamp"', "no kind 'lamp'; choose one of 'point', 'spot'"),
        ('[meshes]\nshape = "cube"', r"write \[\[meshes\]\] with two brackets"),
        (BALL + "scale = [1, 2]", r"meshes\[0\]\.scale: must be one positive number, or three"),
        ("up = [0, 1]", r"up: must be three numbers, such as \[0, 0, 1\] \(it is \[0, 1\]\)"),
        (BALL + 'material = { kind = "diffuse", color_srgb = "#ff00" }', r"material\.color_srgb: .*#cc8033"),
        (BALL + 'material = { kind = "diffuse", color = 1 }', r"material\.color; the nearest is color_srgb"),
        (BALL + "positions = [0, 0, 0]", "the nearest is position"),
        (BALL + "scale = .2", r"write 0\.2 for \.2"),
        (BALL + 'material = "glass"', r"\.material: is a table, such as \{ kind = .* \(it is \"glass\"\)"),
        (BALL + "on = [1, 2]", r"meshes\[0\]\.on: is a table, such as \{ view"),
        (BALL + "keys = { frame = 1 }", r"\.keys: is a list of tables, such as \[\{ frame = 0"),
        (
            "[[meshes]]\nshape = 'plane'\nmaterial = { kind = 'glass' }",
            r"meshes\[0\]: a plane encloses nothing",
        ),
        ("meshes = [7]", r"meshes\[0\]: is a table \(it is 7\)"),
        ("[[environment]]", r"environment: is one table; write \[environment\] with single brackets"),
    ],
)
def test_stage_file_error_names_key(text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        parse_stage(text, "my.toml")
    assert str(caught.value).startswith("my.toml: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            BALL + "scale = -1",
            "meshes[0].scale: must be one positive number, or three of them, such as [1, 1, 2] (it is -1).",
        ),
        ("[[gaussians]]\nscale = -1", "gaussians[0].scale: must be one positive number (it is -1)."),
        (
            "[integrator]\nsamples = 1.5",
            "integrator.samples: must be a whole number from 1 to 65536 (it is 1.5).",
        ),
        (
            '[integrator]\ntone = "aces"',
            'integrator.tone: must be one of "none", "reinhard", "filmic" (it is "aces").',
        ),
        (
            '[[lights]]\nkind = "point"\nposition = [0, 0, 0]',
            "lights[0].intensity: is missing; give a number of 0 or more.",
        ),
        (
            '[[lights]]\nkind = "point"\nintensity = 1',
            "lights[0].position: is missing; give three numbers, such as [0, 0, 1].",
        ),
        (
            '[environment]\nfile = "a.hdr"\nrotation_degrees = [0, 0, 90]',
            "environment.rotation_degrees: must be one number (it is [0, 0, 90]).",
        ),
        (BALL + "position = [0, nan, 0]", "meshes[0].position[1]: must be a finite number (it is nan)."),
        (
            '[[gaussians]]\nshadows_on_meshes = "a"',
            'gaussians[0].shadows_on_meshes: must be true or false (it is "a").',
        ),
        ('version = "1"', 'version: must be 1 (it is "1").'),
        ("lights = 3", "lights: is a list; write [[lights]] with two brackets (it is 3)."),
    ],
)
def test_stage_file_error_says_what_to_give(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_stage(text, "my.toml")
    assert str(caught.value) == f"my.toml: {sentence}"


@pytest.mark.parametrize("text", BAD_STAGES)
def test_refusals_of_stages_have_words_of_our_own(text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_stage(text, "my.toml")
    assert not VALIDATORS_WORDS.search(str(caught.value)), str(caught.value)


def test_stage_color_may_be_hexadecimal() -> None:
    stage = parse_stage(BALL + 'material = { kind = "diffuse", color_srgb = "#ff8000" }', "my.toml")
    assert stage.meshes[0].material == Diffuse(color_srgb=(1.0, 128 / 255, 0.0))


def test_stage_file_too_many_lights_is_refused() -> None:
    light = '[[lights]]\nkind = "point"\nposition = [0, 0, 0]\nintensity = 1\n'
    with pytest.raises(ConfigError, match=r"my\.toml: lights: .*at most 1000"):
        parse_stage(light * 1001, "my.toml")


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: the stage cannot be read"):
        read_stage(tmp_path / "none.toml")
    path = tmp_path / "stage.toml"
    for text, key in (
        ('[[meshes]]\nfile = "gone.obj"', r"meshes\[0\]\.file"),
        (BALL + 'material = { kind = "diffuse", texture = "gone.png" }', r"meshes\[0\]\.material\.texture"),
        ('[environment]\nfile = "gone.hdr"', r"environment\.file"),
        ('[[gaussians]]\nfile = "gone.ply"', r"gaussians\[0\]\.file"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=rf"stage\.toml: {key}: there is no file .*gone"):
            read_stage(path)


def test_starter_stage_and_its_suggestions_are_valid(tmp_path: Path) -> None:
    path = tmp_path / "stage.toml"
    write_stage_template(path, StageLayout((0, -1, 0), (0, 0.5, 0), 2.0, (0.6, 0.8, 0)))
    stage = read_stage(path)
    assert stage.meshes[0].position == (0.0, 0.26, 0.0)
    assert isinstance(stage.meshes[0].material, Glass)
    # Uncommented from the mirror on, everything is still a stage.
    text = path.read_text()
    start = text.index("# A mirror for a floor.")
    lines = [
        line.removeprefix("# ")
        if (line.startswith(("# [", "# ")) and "=" in line) or line.startswith("# [")
        else line
        for line in text[start:].splitlines()
    ]
    (tmp_path / "studio.hdr").write_bytes(b"?")
    path.write_text(text[:start] + "\n".join(lines))
    full = read_stage(path)
    assert len(full.meshes) == 2 and len(full.lights) == 4 and full.environment is not None
    assert isinstance(full.lights[1], RectangleLight)


def test_starter_stage_states_every_default(tmp_path: Path) -> None:
    path = tmp_path / "stage.toml"
    write_stage_template(path, StageLayout((0, -1, 0), (0, 0.5, 0), 2.0, (0.6, 0.8, 0)))
    text, stage = path.read_text(), read_stage(path)
    parts = (Integrator, LightModel, PointLight, SpotLight, RectangleLight, StageGaussians, Environment)
    # Places have none, files neither, and keys belong to films.
    names = {name for part in parts for name in part.model_fields} - {"keys"}
    assert not [name for name in names if not re.search(rf"\b{name}\b", text)]
    assert "A plane faces up" in text
    # What stands behind a # is what is taken without it.
    plain = re.sub(r"(?m)^# (?!material|on|\[)(\w+ = )", r"\1", text[: text.index("# A mirror for a floor")])
    tail = re.sub(r"(?m)^# (\w+ = )", r"\1", text[text.index("[integrator]") :])
    assert parse_stage(plain + tail, "all.toml") == stage.model_copy(update={"lights": ()})


def test_starter_stage_of_materials_is_lit_by_its_map_and_its_suggestions_are_valid(tmp_path: Path) -> None:
    path, layout = tmp_path / "stage.toml", StageLayout((0, -1, 0), (0, 0.5, 0), 2.0, (0.6, 0.8, 0))
    name = 'a "b" {x}/ä.exr'
    (tmp_path / name).parent.mkdir()
    (tmp_path / name).write_bytes(b"?")
    up = (0.1, 0.43589, 0.8944443)
    write_stage_template(path, layout, StageLight("relit", name, up, ("It has {materials}, " * 12,)))
    stage = read_stage(path)
    assert stage.environment == Environment(file=name, up=up, visible=False)
    assert stage.gaussians == (StageGaussians(light="relit"),) and stage.lights == ()
    notes = [line for line in path.read_text().splitlines() if "has {mat" in line]
    assert len(notes) > 1 and max(map(len, notes)) <= 110 and all(line.startswith("# ") for line in notes)
    # with the lamps that are comments it is a stage, too
    text = re.sub(r"(?m)^# (?!material|on|texture)(\[|\w+ = )", r"\1", path.read_text())
    full = parse_stage(text, "all.toml")
    assert len(full.lights) == 4 and full.environment is not None and full.environment.up == up


def test_reading_stages_needs_neither_torch_nor_numba() -> None:
    module = "octasplat.engine.pathtracing.stage.stage_file"
    code = f"import {module}, sys; assert not {{'torch', 'numba'}} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_stage_default_scene_mode() -> None:
    assert Stage().gaussians[0].light is None
    # services and workers of former versions take no null
    assert "light" not in Stage().model_dump(mode="json")["gaussians"][0]
    assert StageGaussians(light="shadowed").model_dump(mode="json")["light"] == "shadowed"


def test_example_stages_are_valid(tmp_path: Path) -> None:
    folder = Path(__file__).resolve().parents[2] / "examples" / "light"
    for path in (*folder.glob("*.toml"), folder / "vase.py"):
        shutil.copy(path, tmp_path)
    subprocess.run([sys.executable, "vase.py"], cwd=tmp_path, check=True)
    stages = [read_stage(path) for path in sorted(tmp_path.glob("*.toml"))]
    assert [stage.gaussians[0].light for stage in stages] == ["shadowed", "emissive", "relit", "shadowed"]
    vase = read_mesh(tmp_path / "vase.obj", with_materials=True)
    assert vase.materials[0].texture is not None and vase.corner_uv is not None


def test_colors_are_read_under_their_former_key() -> None:
    former, present = (parse_stage(GOLD.format(key=key), "my.toml") for key in ("colour_srgb", "color_srgb"))
    assert former == present


def test_up_of_an_environment_is_written_where_it_is_given_alone() -> None:
    """Services and workers of former versions do not know it."""
    assert "up" not in Environment(file="sky.hdr").model_dump(mode="json")
    given = Environment(file="sky.hdr", up=(0, 1, 0))
    assert Environment.model_validate(given.model_dump(mode="json")) == given
