"""Names that settings and options had in the last version: they are read, mean the same, and are told."""

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from pydantic import BaseModel

import octasplat as osp
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.operations.reconstruct import ReconstructOptions, ReconstructRequest, run_config
from octasplat.engine.operations.registry import operations
from octasplat.engine.runs.config import ReconstructionConfig, read_config, resolve_config
from octasplat.engine.runs.setting_names import former_setting_names
from octasplat.engine.runs.settings_catalog import find_setting
from octasplat.engine.settings.base import dump_with_former_settings
from octasplat.engine.settings.renamed_settings import (
    FormerNames,
    RenamedSettingWarning,
    collect_notices,
    former_names,
)
from octasplat.engine.train.config import McmcConfig, RedisplatsConfig, TrainConfig
from octasplat.service.actions.validation import resolve_options
from octasplat.workers.cli.main import cli
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.job_kinds.reconstruct_kinds import ReconstructJobConfig

FORMER = {
    "preset": "paper",
    "evaluate_background": "white",
    "train": {
        "rays": 512,
        "one_order": 0.25,
        "rates": {"quat": 0.02, "calm_after": 9, "colour": 0.5},
        "loss": {"blocked": 0.5},
        "trace": {"turned_beyond": 0.25},
        "materials": {"recipe": "seed", "parted": 3},
        "densify": {"kind": "mcmc", "idle_weight": 0.5},
    },
}
NEW = {
    "preset": "redisplats",
    "evaluation_background": "white",
    "train": {
        "rays_per_batch": 512,
        "shared_sort_until": 0.25,
        "lr": {"quat": 0.02, "scale_after": 9, "color": 0.5},
        "loss": {"free_space": 0.5},
        "trace": {"flip_normal_cos": 0.25},
        "materials": {"recipe": "ref_gaussian", "depth_split": 3},
        "densify": {"kind": "mcmc", "relocate_low_weight_below": 0.5},
    },
}
FORMER_SETS = (
    "rays=512", "train.one_order=0.25", "rates.quat=0.02", "rates.calm_after=9", "lr.colour=0.5",
    "loss.blocked=0.5", "trace.turned_beyond=0.25", "materials.recipe=seed", "materials.parted=3",
    'densify={"kind": "mcmc", "idle_weight": 0.5}',
)  # fmt: skip
EXPECTED = ReconstructOptions.model_validate(NEW).config()


def _resolved(options: dict[str, Any]) -> ReconstructionConfig:
    """Return the settings of the run that a job with such options makes."""
    complete = asyncio.run(resolve_options(get_job_kind("reconstruct"), options)).complete
    assert isinstance(complete, ReconstructJobConfig)
    return complete.run_config()


def test_former_python_names_are_read_with_notice() -> None:
    with collect_notices() as notices:
        request = ReconstructRequest.model_validate({"source": "scene", "output": "nowhere", **FORMER})
        assert run_config(request) == EXPECTED
    told = " ".join(notices)
    assert "preset=paper is called preset=redisplats now" in told
    assert "train.rays is called" not in told and "more have new names" in told
    with pytest.warns(RenamedSettingWarning, match=r"rates\.quat is called lr\.quat now"):
        assert resolve_config(assignments=["rates.quat=0.5"]) == resolve_config(assignments=["lr.quat=0.5"])


def test_former_option_of_a_python_verb_is_read_and_told() -> None:
    refused = "a.png: an environment is an HDR or EXR image"
    with collect_notices() as notices, pytest.raises(ConfigError, match=refused):
        osp.relight("run", "out", environments=["a.png"], by="path")  # type: ignore[call-arg]
    assert notices == ["by is called integrator now; former names are read in this version only."]


def test_former_command_options_are_read_with_notice(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    monkeypatch.chdir(tmp_path)
    found: list[ReconstructionConfig] = []

    def keep(request: ReconstructRequest, _printer: object, **_how: object) -> None:
        found.append(run_config(request))

    monkeypatch.setattr("octasplat.workers.cli.reconstruction.run_reconstruction", keep)
    sets = [part for text in FORMER_SETS for part in ("--set", text)]
    arguments = ["reconstruct", "scene", "-o", "nowhere", "--preset", "paper", "--background", "white", *sets]
    with collect_notices() as notices:
        done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0, done.stderr
    assert found == [EXPECTED]
    told = " ".join(notices)
    for former, new in (
        ("--background", "--evaluation-background"),
        ("preset=paper", "preset=redisplats"),
        ("rates.calm_after", "lr.scale_after"),
        ("materials.recipe=seed", "materials.recipe=ref_gaussian"),
        ("densify.idle_weight", "densify.relocate_low_weight_below"),
    ):
        assert f"{former} is called {new} now" in told


def test_former_submitted_options_are_read_with_notice(monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[Any] = []

    def keep(_api: object, what: Any, _printer: object) -> dict[str, str]:
        options = json.loads(json.dumps(what.options))
        found.append(_resolved(options))
        return {"id": "1"}

    monkeypatch.setattr("octasplat.workers.cli.remote_jobs.submit", keep)
    sets = [part for text in FORMER_SETS[1:] for part in ("--set", text)]
    arguments = ["submit", "scene", "--server", "http://127.0.0.1:9", "--preset", "paper"]
    with collect_notices() as notices:
        done = CliRunner().invoke(cli, [*arguments, "--background", "white", "--rays", "512", *sets])
    assert done.exit_code == 0, done.stderr
    assert found == [EXPECTED]
    assert any("--rays is called --rays-per-batch now" in notice for notice in notices)


def test_former_names_in_the_options_of_a_job_mean_the_same() -> None:
    kind = get_job_kind("reconstruct")
    with collect_notices() as notices:
        assert _resolved(FORMER) == EXPECTED
    assert notices
    stored = EXPECTED.model_dump(mode="json")
    stored |= {"evaluate_background": stored.pop("evaluation_background"), "preset": "paper"}
    stored["train"] = dump_with_former_settings(EXPECTED.train)
    with pytest.warns(RenamedSettingWarning):
        assert kind.options.model_validate(stored).run_config() == EXPECTED
    with pytest.warns(RenamedSettingWarning):
        assert kind.revise(stored, {"train": {"rates": {"quat": 0.5}}}).train.lr.quat == 0.5


def test_former_names_of_a_derived_job_are_read_and_the_later_one_counts() -> None:
    kind, before = get_job_kind("relight"), {"environments": ["a.hdr"], "by": "path", "depth": 3}
    with collect_notices() as notices:
        options = kind.resolve(before)
        assert kind.revise(before, {"max_bounces": 4}).max_bounces == 4
    assert (options.integrator, options.max_bounces) == ("path", 3)
    assert "by is called integrator now, depth is called max_bounces now; former" in notices[0]
    with collect_notices():
        assert get_job_kind("surface").resolve({"texture_side": 256, "settle": True}).refine_vertices
        assert (
            get_job_kind("export").resolve({"files": ["a.glb"], "texture_size": 64}).falloff_texture_size
            == 64
        )


@pytest.mark.parametrize(
    ("name", "former", "new"),
    [
        ("reconstruct", {"assignments": ["lr.quat=0.5"]}, {"set": ["lr.quat=0.5"]}),
        ("surface", {"bounds": [0, 0, 0, 1, 2, 3]}, {"box": [0, 0, 0, 1, 2, 3]}),
        ("material", {"scale": {"roughness": 0.5}}, {"multiply": {"roughness": 0.5}}),
        ("import", {"file": "a.spz"}, {"source": "a.spz"}),
    ],
)
def test_job_that_was_queued_by_the_last_version_is_run_by_this_one(
    name: str, former: dict[str, Any], new: dict[str, Any]
) -> None:
    kind = get_job_kind(name)
    with collect_notices() as notices:
        assert kind.resolve(kind.as_requested(former)) == kind.resolve(new)
        assert kind.as_requested(former) == kind.as_requested(new)
    assert notices and all("is called" in notice for notice in notices)


def test_configuration_of_a_run_of_the_last_version_is_read_with_one_notice(tmp_path: Path) -> None:
    content = EXPECTED.model_dump(mode="json")
    content |= {"evaluate_background": content.pop("evaluation_background"), "preset": "paper"}
    content["train"] = dump_with_former_settings(EXPECTED.train)
    (tmp_path / "config.json").write_text(json.dumps({"reconstruction": content}), encoding="utf-8")
    with collect_notices() as notices:
        assert read_config(tmp_path / "config.json") == EXPECTED
    assert len(notices) == 1
    assert notices[0].startswith(f"{tmp_path / 'config.json'}: preset=paper is called preset=redisplats now")
    assert "more have new names; former names are read in this version only." in notices[0]


@pytest.mark.parametrize(
    ("command", "flags"),
    [
        ("reconstruct", {"--frames-per-second": "--fps"}),
        ("estimate", {"--frames-per-second": "--fps"}),
        ("material", {"--scale": "--multiply"}),
        ("relight", {"--rotate": "--rotation"}),
        ("surface", {"--components": "--keep-components"}),
        ("relight", {"--by": "--integrator", "--depth": "--max-bounces", "--on": "--other-dataset"}),
        ("surface", {"--texture": "--texture-size", "--depth": "--depth-mode", "--scene": "--dataset"}),
        ("evaluate", {"--background": "--evaluation-background", "--on": "--other-dataset"}),
        ("export", {"--texture": "--falloff-texture-size", "--colour": "--color"}),
        ("clean", {"--near": "--camera-clearance", "--neighbours": "--neighbors"}),
        ("demo", {"--scene-only": "--dataset-only"}),
        ("render", {"--scene": "--dataset"}),
        ("derive", {"--on": "--other-dataset"}),
    ],
)
def test_former_flags_are_taken_and_only_new_ones_are_in_the_help(
    command: str, flags: dict[str, str]
) -> None:
    shown = CliRunner().invoke(cli, [command, "--help"]).stdout.split()
    chosen = cli.get_command(None, command)  # type: ignore[arg-type]
    assert chosen is not None
    taken = {flag: parameter for parameter in chosen.params for flag in parameter.opts}
    for former, new in flags.items():
        assert new in shown and former not in shown
        assert getattr(taken[former], "hidden", False) and not getattr(taken[new], "hidden", True)


def test_former_flag_beside_its_new_one_is_refused(tmp_path: Path) -> None:
    rays = ["--rays", "512", "--rays-per-batch", "1024"]
    both = ["--on", str(tmp_path), "--other-dataset", str(tmp_path)]
    for arguments, sentence in (
        (["reconstruct", str(tmp_path), "-o", str(tmp_path / "out"), *rays], "--rays is the former name of"),
        (["evaluate", str(tmp_path), *both], "--on is the former name of --other-dataset"),
        (["derive", "evaluate", "last", *both], "--on is the former name of --other-dataset"),
    ):
        done = CliRunner().invoke(cli, arguments)
        assert done.exit_code == 2 and sentence in done.stderr, done.stderr


def _models(model: type[BaseModel]) -> list[type[BaseModel]]:
    inner = (type(getattr(model(), name)) for name in model.model_fields)
    return [model, *(part for kind in inner if issubclass(kind, BaseModel) for part in _models(kind))]


@pytest.mark.parametrize(
    "model",
    [
        *_models(TrainConfig),
        McmcConfig,
        RedisplatsConfig,
        *(operation.request for operation in operations()),
        *(operation.options for operation in operations()),
    ],
)
def test_former_names_map_to_fields(model: type[BaseModel]) -> None:
    names: FormerNames = former_names(model)
    assert not set(names.fields) & set(model.model_fields)
    known = set(model.model_fields)
    others = {"relocate_low_weight_below", "relocate_low_weight_fraction", "relocate_low_weight_rounds"}
    others |= {"other_dataset", "dataset", "fps"}  # of the request alone
    assert set(names.fields.values()) | set(names.flags.values()) <= known | others


def test_unknown_name_near_a_former_one_is_answered_with_the_new_name() -> None:
    for given, offered in (
        ("window_ray", "ray_patch_rays"),
        ("rate.quat", "lr.quat"),
        ("sh_ever", "sh_degree_interval"),
    ):
        with pytest.raises(ConfigError, match=f"no setting '{given}'; the nearest is {offered}"):
            resolve_config(assignments=[f"{given}=1"])


def test_former_setting_names_lead_to_settings() -> None:
    assert former_setting_names()["rates.calm_after"] == "lr.scale_after"
    assert all(find_setting(new).name == new for new in former_setting_names().values())
