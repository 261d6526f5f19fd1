"""The catalog of settings, its page and the command that lists and explains them."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from pydantic import BaseModel

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.poses.config import PosesConfig
from octasplat.engine.runs.config import ReconstructionConfig, resolve_config
from octasplat.engine.runs.settings_catalog import (
    Difference,
    all_settings,
    default_values,
    find_setting,
    setting_differences,
)
from octasplat.engine.runs.settings_page import settings_page
from octasplat.engine.settings.fields import Group, Unit
from octasplat.engine.settings.nearest_names import nearest_name
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.trace.protocol import TraceSettings
from octasplat.engine.train.config import (
    LearningRates,
    LossWeights,
    McmcConfig,
    RedisplatsConfig,
    TrainConfig,
)
from octasplat.workers.cli.main import cli

MODELS = (
    ReconstructionConfig,
    TrainConfig,
    LearningRates,
    LossWeights,
    McmcConfig,
    RedisplatsConfig,
    TraceSettings,
    MaterialSettings,
    PosesConfig,
)
NO_QUANTITIES = ("seed",)
ROOT = Path(__file__).resolve().parents[1]


def config_command(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["config", *arguments])


def write_run(folder: Path, *assignments: str) -> Path:
    config = resolve_config("fast", assignments=assignments)
    folder.mkdir()
    content = {"scene": "photographs", "reconstruction": config.model_dump(mode="json"), "versions": {}}
    (folder / "config.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("model", MODELS)
def test_settings_have_description_unit_and_group(model: type[BaseModel]) -> None:
    assert model.model_fields
    for name, info in model.model_fields.items():
        assert info.description and info.description.endswith("."), name
        if isinstance(info.default, BaseModel):
            continue
        assert any(isinstance(mark, Group) for mark in info.metadata), name
        numeric = any(kind in str(info.annotation) for kind in ("int", "float"))
        if numeric and name not in NO_QUANTITIES:
            assert any(isinstance(mark, Unit) for mark in info.metadata), name


def test_units_and_groups_are_in_the_schema() -> None:
    side = ReconstructionConfig.model_json_schema()["properties"]["max_side"]
    assert side["unit"] == "px" and side["group"] == "basic"


def test_catalog_entry_of_a_setting_with_a_known_answer() -> None:
    entry = find_setting("train.trace.max_hits")
    assert (entry.name, entry.type, entry.unit) == ("trace.max_hits", "whole number", "Gaussians per ray")
    assert entry.range == "at least 1, at most 4096"
    assert entry.default == 512 and not entry.exceptions


def test_catalog_has_defaults_by_preset_and_with_materials() -> None:
    exceptions = find_setting("rays_per_batch").exceptions
    assert find_setting("rays_per_batch").default == 16_384
    assert exceptions["redisplats"] == 8192 and exceptions["standard+materials"] == 8192
    assert find_setting("densify.split_scale").defaults == {"redisplats": 0.005}


def test_catalog_has_every_setting_once() -> None:
    names = [entry.name for entry in all_settings()]
    assert len(names) == len(set(names))
    assert {"seed", "materials.learn", "densify.kind", "test_every"} <= set(names)
    assert not any(name.startswith("train") for name in names)


@pytest.mark.parametrize(
    ("name", "nearest"), [("window_ray", "ray_patch_rays"), ("quats", "lr.quat"), ("rate.mean", "lr.mean")]
)
def test_unknown_setting_is_refused_and_the_nearest_one_offered(name: str, nearest: str) -> None:
    with pytest.raises(ConfigError, match=f"the nearest is {nearest}"):
        find_setting(name)
    with pytest.raises(ConfigError, match=f"the nearest is {nearest}"):
        resolve_config(assignments=[f"{name}=1"])
    assert nearest_name("zzz", [entry.name for entry in all_settings()]) is None


def test_differences_list_changed_settings() -> None:
    changed = resolve_config("fast", assignments=["lr.quat=0.5", "test_every=4"])
    assert setting_differences(default_values(changed), changed) == (
        Difference("test_every", 8, 4),
        Difference("lr.quat", 0.015, 0.5),
    )
    assert setting_differences(changed, changed) == ()


def test_differences_list_one_sided_settings() -> None:
    found = setting_differences(resolve_config("standard"), resolve_config("redisplats"))
    assert Difference("densify.split_scale", None, 0.005) in found
    assert Difference("densify.growth", 0.2, None) in found


def test_page_of_settings_is_up_to_date() -> None:
    assert (ROOT / "docs" / "settings.md").read_text(encoding="utf-8") == settings_page()


def test_config_list_shows_the_basic_settings_and_all_on_request() -> None:
    basic = json.loads(config_command("list", "--json").stdout)
    assert {entry["group"] for entry in basic} == {"basic"}
    everything = json.loads(config_command("list", "--all", "--json").stdout)
    assert len(everything) == len(all_settings()) > len(basic)
    assert "error_power" in config_command("list", "--group", "experimental").stdout


def test_config_explain_prints_setting() -> None:
    text = config_command("explain", "lr.decay").stdout
    assert "Unit: share" in text and "Default: 0.3" in text and "With redisplats: 0.1" in text
    refused = config_command("explain", "lr.decai")
    assert refused.exit_code == 1 and "the nearest is lr.decay." in refused.stderr


def test_config_diff_prints_changed_settings(tmp_path: Path) -> None:
    first = write_run(tmp_path / "first", "iterations=300")
    second = write_run(tmp_path / "second", "iterations=300", "loss.l1=0.5")
    assert config_command("diff", str(first)).stdout == "iterations: 2500 -> 300\n"
    between = config_command("diff", str(first), str(second), "--json").stdout
    assert json.loads(between) == [{"name": "loss.l1", "before": 0.8, "after": 0.5}]
    assert "No setting differs" in config_command("diff", str(first), str(first)).stdout


@pytest.mark.parametrize("recipe", ["split_sum", "near_field", "ref_gaussian"])
def test_settings_that_come_with_a_recipe_do_not_count_as_changed(recipe: str) -> None:
    config = resolve_config("fast", train={"materials": {"learn": True, "recipe": recipe}, "iterations": 9})
    changed = {item.name for item in setting_differences(default_values(config), config)}
    assert changed - {"materials.recipe"} == {"iterations"}
    assert ("materials.recipe" in changed) == (recipe != "split_sum")
