"""What preset, settings, nested values and assignments mean together, each with a known answer."""

import json
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.runs.config import (
    ReconstructionConfig,
    read_config,
    resolve_config,
    revise_config,
)
from octasplat.engine.settings.nested_options import merge_options
from octasplat.engine.settings.refusals import InvalidSettingsError
from octasplat.engine.train.config import TrainConfig, preset, with_materials


def refusal(*assignments: str, **given: Any) -> str:
    """Return the message with which settings are refused."""
    with pytest.raises(InvalidSettingsError) as caught:
        resolve_config(assignments=assignments, **given)
    return str(caught.value)


def as_json(config: ReconstructionConfig) -> dict[str, Any]:
    return config.model_dump(mode="json")


def test_settings_of_none_keep_their_defaults() -> None:
    assert resolve_config(settings={"test_every": None, "max_side": None}) == resolve_config()
    assert resolve_config(settings={"test_every": 3}).test_every == 3


def test_preset_brings_its_settings() -> None:
    assert resolve_config("fast").train == preset("fast")
    assert resolve_config("fast").preset == "fast"
    assert resolve_config("fast", materials=True).train == with_materials(preset("fast"))
    assert "redisplats" in refusal(preset_name="redisplats", materials=True)
    assert "fast, standard or high" in refusal(preset_name="redisplats", materials=True)
    assert "preset" in refusal(preset_name="slow")


def test_later_settings_win() -> None:
    config = resolve_config(
        settings={"test_every": 3, "max_side": 100},
        train={"iterations": 10, "lr": {"quat": 0.5, "opacity": 0.25}},
        assignments=["test_every=4", "lr.quat=0.125", "train.iterations=20", "iterations=30"],
    )
    assert (config.test_every, config.max_side) == (4, 100)
    assert (config.train.lr.quat, config.train.lr.opacity) == (0.125, 0.25)
    assert config.train.iterations == 30
    assert resolve_config("fast", assignments=["preset=high"]).train == preset("high")


def test_assignments_are_read_as_json_or_as_text() -> None:
    config = resolve_config(assignments=[" lr.quat = 2e-2 ", "background=white", 'held_out=["a=b.png"]'])
    assert config.train.lr.quat == 0.02
    assert config.train.background == "white"
    assert config.held_out == ("a=b.png",)
    for wrong in ("lr.quat", "=5", "lr.quat:5"):
        assert refusal(wrong).startswith(f"{wrong}: write an assignment as name=value")
        with pytest.raises(InvalidSettingsError) as caught:
            resolve_config(assignments=[wrong])
        assert [(refused.path, refused.code) for refused in caught.value.refusals] == [
            (("set",), "assignment")
        ]


def test_unknown_settings_are_refused_with_all_their_names() -> None:
    with pytest.raises(InvalidSettingsError) as caught:
        resolve_config(train={"lr": {"quatt": 1, "more": {"deep": 2}}, "nothing": {}})
    assert [refused.path for refused in caught.value.refusals] == [
        ("train", "lr", "quatt"),
        ("train", "lr", "more", "deep"),
        ("train", "nothing"),
    ]
    assert "train" in refusal("train=5")


def test_former_settings_at_their_constants_are_no_unknown_settings() -> None:
    assert resolve_config("fast", train={"trace": {"t_min": 0}}) == resolve_config("fast")
    assert "t_min is no setting any more" in refusal("trace.t_min=1")


def test_preset_without_materials_is_refused_at_the_preset() -> None:
    with pytest.raises(InvalidSettingsError) as caught:
        resolve_config("redisplats", materials=True)
    assert [(refused.path, refused.code) for refused in caught.value.refusals] == [(("preset",), "materials")]


def test_materials_are_switched_on_by_flag_settings_or_assignment() -> None:
    expected = resolve_config("fast", materials=True)
    assert expected.train.materials.learn
    assert resolve_config("fast", train={"materials": {"learn": "yes"}}) == expected
    assert resolve_config("fast", assignments=["materials.learn=true"]) == expected
    assert resolve_config("fast", materials=True, assignments=["materials.learn=false"]).train == preset(
        "fast"
    )
    assert "materials.learn" in refusal("materials.learn=perhaps")
    others = resolve_config("fast", train={"materials": {"ray_bias": 0.5}})
    assert not others.train.materials.learn
    assert others.train.rays_per_batch == preset("fast").rays_per_batch


def test_evaluation_background_follows_a_white_training() -> None:
    def background(**values: Any) -> str:
        return ReconstructionConfig.model_validate(values).evaluation_background

    assert background() == "black"
    assert (
        background(train={"background": "white"})
        == background(train=TrainConfig(background="white"))
        == "white"
    )
    assert background(train={"background": "random"}) == "black"
    assert background(train={"background": "white"}, evaluation_background="black") == "black"
    assert background(train={"background": "white"}, evaluation_background=None) == "white"
    known = resolve_config(assignments=["background=white"])
    assert ReconstructionConfig.model_validate(known) == known


def test_evaluation_background_follows_a_revised_training() -> None:
    white: dict[str, Any] = {"train": {"background": "white"}}
    assert revise_config(as_json(resolve_config("fast")), **white) == resolve_config("fast", **white)
    back = revise_config(as_json(resolve_config("fast", **white)), assignments=["background=black"])
    assert back.evaluation_background == "black"
    other = resolve_config("fast", settings={"evaluation_background": "white"})
    assert revise_config(as_json(other), assignments=["background=random"]).evaluation_background == "white"
    asked = resolve_config("fast", settings={"evaluation_background": "black"})
    kept = revise_config(as_json(asked), **white, given=["evaluation_background"])
    assert kept.evaluation_background == "black"


@pytest.mark.parametrize(
    ("trained", "evaluated", "has_alpha", "differs"),
    [
        ("white", "black", False, True), ("black", "white", False, True), ("auto", "white", False, True),
        ("auto", "black", False, False), ("white", "white", False, False), ("black", "black", False, False),
        ("random", "black", False, False), ("white", "black", True, False),
    ],
)  # fmt: skip
def test_another_background_in_the_evaluation_is_told(
    trained: str, evaluated: str, has_alpha: bool, differs: bool
) -> None:
    assignments = [f"background={trained}", f"evaluation_background={evaluated}"]
    told = resolve_config(assignments=assignments).background_mismatch(has_alpha)
    assert (told is not None) is differs
    if told is not None:
        assert f"measured on {evaluated}" in told
        assert f"trained on {'black' if trained == 'auto' else trained} " in told


def test_missing_poses_are_found_where_there_is_no_model() -> None:
    missing = resolve_config(settings={"poses": "missing"})
    assert missing.with_poses_decided(True) == missing.model_copy(update={"poses": "given"})
    assert missing.with_poses_decided(False) == missing.model_copy(update={"poses": "auto"})
    for poses in ("given", "auto"):
        config = resolve_config(settings={"poses": poses})
        assert config.with_poses_decided(True) == config.with_poses_decided(False) == config


def test_revised_configuration_keeps_what_is_not_changed() -> None:
    before = resolve_config("fast", settings={"max_side": 100}, assignments=["lr.quat=0.5", "iterations=7"])
    after = revise_config(as_json(before), settings={"test_every": 3}, train={"lr": {"opacity": 0.25}})
    assert (after.preset, after.max_side, after.test_every) == ("fast", 100, 3)
    assert (after.train.lr.quat, after.train.lr.opacity, after.train.iterations) == (0.5, 0.25, 7)
    assert revise_config(as_json(before)) == before
    assert revise_config(as_json(before), settings={"max_side": None}).max_side is None


@pytest.mark.parametrize(("name", "materials"), [("high", True), ("high", False), ("standard", True)])
def test_preset_without_settings_of_its_own_is_told(name: str, materials: bool) -> None:
    notice = resolve_config(name, materials=materials).preset_notice()
    assert (notice is not None) == (name == "high" and materials)
    if notice is not None:
        alike = [resolve_config(preset, materials=True).train for preset in ("high", "standard")]
        assert alike[0] == alike[1] and "rays_per_pixel" in notice


def test_revised_preset_brings_its_own_training() -> None:
    before = resolve_config("fast", settings={"max_side": 100}, assignments=["lr.quat=0.5"])
    after = revise_config(as_json(before), settings={"preset": "high"}, assignments=["iterations=9"])
    assert after.train == preset("high").model_copy(update={"iterations": 9})
    assert (after.preset, after.max_side) == ("high", 100)


def test_revised_materials_bring_their_settings_but_keep_changed_ones() -> None:
    before = resolve_config("fast", assignments=["lr.quat=0.5", "iterations=7"])
    after = revise_config(as_json(before), materials=True)
    assert after == resolve_config("fast", materials=True, assignments=["lr.quat=0.5", "iterations=7"])
    assert revise_config(as_json(after), materials=False) == before
    assert revise_config(as_json(after), materials=True) == after
    densified = resolve_config("fast", assignments=["densify.dead_opacity=0.125"])
    assert revise_config(as_json(densified), materials=True) == resolve_config(
        "fast", materials=True, assignments=["densify.dead_opacity=0.125"]
    )
    changed = resolve_config("fast", materials=True, train={"materials": {"ray_bias": 0.5}})
    off = revise_config(as_json(changed), assignments=["materials.learn=false"])
    assert (off.train.materials.learn, off.train.materials.ray_bias) == (False, 0.5)
    assert off.train.lr == preset("fast").lr


def test_configuration_file_comes_back(tmp_path: Path) -> None:
    config = resolve_config("fast", settings={"held_out": ("a.png",)}, assignments=["iterations=7"])
    path = tmp_path / "config.json"
    path.write_text(json.dumps({"reconstruction": as_json(config)}), encoding="utf-8")
    assert read_config(path) == config


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (None, "cannot be read"),
        ("{", "cannot be read"),
        ("{}", "cannot be read"),
        ("[]", "cannot be read"),
        ('{"reconstruction": {"test_every": -1}}', "is not a configuration of this version"),
        ('{"reconstruction": {"unheard": 1}}', "is not a configuration of this version"),
    ],
)
def test_unusable_configuration_file_is_refused(tmp_path: Path, content: str | None, sentence: str) -> None:
    path = tmp_path / "config.json"
    if content is not None:
        path.write_text(content, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        read_config(path)
    assert str(caught.value).startswith(f"{path} {sentence}")


def test_configuration_that_is_no_mapping_is_refused() -> None:
    with pytest.raises(ValidationError) as caught:
        ReconstructionConfig.model_validate([1])
    assert caught.value.errors()[0]["input"] == [1]


def test_section_of_another_kind_begins_anew() -> None:
    base = {"densify": {"kind": "a", "x": 1}, "lr": {"x": 1, "y": 2}, "z": 3}
    assert merge_options(base, {"densify": {"kind": "b"}})["densify"] == {"kind": "b"}
    assert merge_options(base, {"densify": {"y": 2}})["densify"] == {"kind": "a", "x": 1, "y": 2}
    assert merge_options(base, {"lr": {"y": 4}, "z": {"w": 1}}) == {
        "densify": {"kind": "a", "x": 1}, "lr": {"x": 1, "y": 4}, "z": {"w": 1},
    }  # fmt: skip
    assert merge_options(base, {"lr": 5})["lr"] == 5
    assert base["lr"] == {"x": 1, "y": 2}


@pytest.mark.parametrize("section", [{"train": None}, {"train": 5}, None, [1]])
def test_configuration_without_sections_is_refused_by_name(tmp_path: Path, section: object) -> None:
    path = tmp_path / "config.json"
    path.write_text(json.dumps({"reconstruction": section}), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"config\.json"):
        read_config(path)
