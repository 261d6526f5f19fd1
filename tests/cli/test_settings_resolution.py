"""The command, ``submit``, HTTP and Python mean the same by the same settings, or refuse them alike."""

import asyncio
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.operations.base import build_request
from octasplat.engine.operations.reconstruct import ReconstructOptions, ReconstructRequest, run_config
from octasplat.engine.runs.config import ReconstructionConfig, RunSettings, resolve_config, revise_config
from octasplat.engine.runs.settings_catalog import all_settings as catalog
from octasplat.engine.settings.nested_options import merge_options
from octasplat.engine.settings.preset_names import PRESETS
from octasplat.service.actions.validation import resolve_options
from octasplat.service.problems import ProblemError
from octasplat.workers.cli.main import cli
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.job_kinds.reconstruct_kinds import ReconstructJobConfig

Outcome = ReconstructionConfig | str
"""What settings mean, or the sentence that refuses them."""

NAMES = [entry.name for entry in catalog() if entry.name != "exports"]
TEXTS = (
    *(
        "0",
        "1",
        "2",
        "3",
        "64",
        "0.5",
        "-1",
        "1e9",
        "true",
        "false",
        "null",
        "black",
        "auto",
        "fast",
        "redisplats",
    ),
    *("NaN", "x", '"learnt"', "[1, 0, 0]", "{}", "mcmc", "area", "given", "world"),
)
CHANGED = {
    "rays_per_batch": ("64", "4096"),
    "lr.quat": ("0.02",),
    "seed": ("1", "2"),
    "test_every": ("0", "4"),
}
UNKNOWN = (
    "window_ray",
    "lr.quats",
    "train.speed",
    "densify",
    "materials",
    "rays_per_batch.x",
    "a..b",
    "",
    "train",
)


DEFAULTS = {entry.name: entry.defaults for entry in catalog()}


@st.composite
def settings_asked_for(draw: st.DrawFn) -> tuple[str, bool, list[str]]:
    """A preset, whether with materials, and up to 30 assignments; half of the time some are of no use."""
    preset, is_wild = draw(st.sampled_from(PRESETS)), draw(st.booleans())
    names = [name for name in NAMES if is_wild or (preset in DEFAULTS[name] and name != "densify.kind")]
    found = []
    for _ in range(draw(st.integers(0, 30))):
        name = draw(st.sampled_from(names))
        values = DEFAULTS[name].values() if is_wild else (DEFAULTS[name][preset],)
        texts: Sequence[str] = [json.dumps(value) for value in values]
        if is_wild and draw(st.integers(0, 12)) == 0:
            name, texts = draw(st.sampled_from((name, *UNKNOWN))), TEXTS
        elif name in CHANGED:
            texts = CHANGED[name]
        prefix = "" if name in RunSettings.model_fields else draw(st.sampled_from(("", "train.")))
        found.append(f"{prefix}{name}={draw(st.sampled_from(texts))}")
    return preset, draw(st.booleans()), found


@pytest.fixture(autouse=True)
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder that commands find, as they look for it first."""
    (tmp_path / "scene").mkdir()
    monkeypatch.chdir(tmp_path)


def by_command(preset: str, materials: bool, given: list[str], monkeypatch: pytest.MonkeyPatch) -> Outcome:
    found: list[ReconstructionConfig] = []

    def keep(request: ReconstructRequest, _printer: object, **_how: object) -> None:
        found.append(run_config(request))

    monkeypatch.setattr("octasplat.workers.cli.reconstruction.run_reconstruction", keep)
    arguments = ["reconstruct", "scene", "-o", "nowhere", "--preset", preset]
    return _told(arguments, materials, given, found)


def by_submit(preset: str, materials: bool, given: list[str], monkeypatch: pytest.MonkeyPatch) -> Outcome:
    found: list[ReconstructionConfig] = []

    def keep(_api: object, what: Any, _printer: object) -> dict[str, str]:
        sent = json.loads(json.dumps(what.options))
        found.append(_accepted(sent))
        return {"id": "1"}

    monkeypatch.setattr("octasplat.workers.cli.remote_jobs.submit", keep)
    arguments = ["submit", "scene", "--server", "http://127.0.0.1:9", "--preset", preset]
    return _told(arguments, materials, given, found)


def _told(
    arguments: list[str], materials: bool, given: list[str], found: list[ReconstructionConfig]
) -> Outcome:
    flags = ["--materials"] if materials else []
    sets = [part for assignment in given for part in ("--set", assignment)]
    done = CliRunner().invoke(cli, [*arguments, *flags, *sets])
    if done.exit_code:
        return done.stderr.removeprefix("Error: ").removesuffix("\n")
    return found[0]


def by_http(options: Mapping[str, Any]) -> Outcome:
    try:
        return _accepted(json.loads(json.dumps(options)))
    except ProblemError as refusal:
        return refusal.detail


def _accepted(options: Mapping[str, Any]) -> ReconstructionConfig:
    found = asyncio.run(resolve_options(get_job_kind("reconstruct"), options)).complete
    stored = json.loads(json.dumps(found.model_dump(mode="json")))
    return ReconstructJobConfig.model_validate(stored).run_config()


def by_python(options: dict[str, Any]) -> Outcome:
    try:
        asked = {"source": Path("scene"), "output": Path("nowhere"), **options}
        return run_config(build_request(ReconstructRequest, asked))
    except ConfigError as refusal:
        return str(refusal)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(asked=settings_asked_for())
def test_settings_resolve_equally_in_cli_job_and_api(
    monkeypatch: pytest.MonkeyPatch, asked: tuple[str, bool, list[str]]
) -> None:
    preset, materials, given_ = asked
    options = {"preset": preset, "materials": materials, "set": given_}
    expected = by_python(options)
    assert by_command(preset, materials, given_, monkeypatch) == expected
    assert by_submit(preset, materials, given_, monkeypatch) == expected
    assert by_http(options) == expected
    if isinstance(expected, ReconstructionConfig):
        nested = _nested(preset, materials, given_)
        assert by_http(nested) == expected
        assert by_python(nested) == expected


def _nested(preset: str, materials: bool, given: list[str]) -> dict[str, Any]:
    """The same settings as the page of the service sends them."""
    options: dict[str, Any] = {"preset": preset, "train": {"materials": {"learn": True}} if materials else {}}
    for assignment in given:
        name, _, text = assignment.partition("=")
        try:
            value = json.loads(text)
        except ValueError:
            value = text
        if name in RunSettings.model_fields:
            options[name] = value
            continue
        for part in reversed(name.removeprefix("train.").split(".")):
            value = {part: value}
        options["train"] = merge_options(options["train"], value)
    return {key: value for key, value in options.items() if value is not None or key == "train"}


@pytest.mark.parametrize(
    "options",
    [
        {"materials": True},
        {"train": {"materials": {"learn": True}}},
        {"set": ["materials.learn=true"]},
        {"set": ["train.materials.learn=1"]},
    ],
)
def test_materials_settings_resolve_equally_in_all_spellings(options: dict[str, Any]) -> None:
    config = by_python({"preset": "fast", **options})
    assert isinstance(config, ReconstructionConfig)
    assert config.train.materials.learn and config.train.rays_per_batch == 8192
    assert (config.train.sh_degree, config.train.shared_sort_until) == (3, 0.0)
    assert (config.train.lr.quat, config.train.iterations) == (3e-3, 1400)


@pytest.mark.parametrize("recipe", ["near_field", "ref_gaussian"])
def test_short_training_by_other_recipe_has_steps_of_its_own(recipe: str) -> None:
    """However the recipe is told, and whether at once or of a configuration that is there."""
    at_once = by_python({"preset": "fast", "materials": True, "set": [f"materials.recipe={recipe}"]})
    assert isinstance(at_once, ReconstructionConfig)
    assert (at_once.train.sh_degree, at_once.train.lr.quat, at_once.train.loss.edges) == (1, 1e-3, None)
    assert (
        by_python(
            {"preset": "fast", "train": {"materials": {"learn": True, "recipe": recipe}}},
        )
        == at_once
    )
    before = resolve_config("fast", materials=True).model_dump(mode="json")
    assert revise_config(before, train={"materials": {"recipe": recipe}}) == at_once
    given = resolve_config("fast", materials=True, assignments=["sh_degree=3"]).model_dump(mode="json")
    revised = revise_config(given, train={"materials": {"recipe": recipe}}, given=["sh_degree"])
    assert (revised.train.sh_degree, revised.train.lr.quat) == (3, 1e-3)


def test_paper_preset_with_materials_is_refused() -> None:
    refused = by_python({"preset": "redisplats", "set": ["materials.learn=true"]})
    assert refused == (
        "The preset redisplats is for scenes without materials; with materials choose fast, standard or high."
    )


@pytest.mark.parametrize(
    ("assignment", "sentence"),
    [
        ("window_ray=3", "There is no setting 'window_ray'; the nearest is ray_patch_rays."),
        ("rate.quat=3", "There is no setting 'rate.quat'; the nearest is lr.quat."),
        ("rays_per_batch=3", "rays_per_batch: Input should be greater than or equal to 64 (it is 3)."),
        ("train.lr.quat=-1", "lr.quat: Input should be greater than or equal to 0 (it is -1)."),
        ("rays", "rays: write an assignment as name=value, e.g. lr.mean=2e-4."),
        (
            "materials.learn=true",
            "refine_poses aligns photographs by what keeps its place, which reflections do not: leave it or "
            "the materials out.",
        ),
    ],
)
def test_unusable_settings_are_refused_with_reason(assignment: str, sentence: str) -> None:
    assert by_python({"set": ["refine_poses=true", assignment]}) == sentence


def test_options_of_previous_version_are_kept() -> None:
    kind = get_job_kind("reconstruct")
    before = (
        ReconstructOptions(preset="standard", set=("rays_per_batch=4096",)).config().model_dump(mode="json")
    )
    before["train"]["trace"]["t_min"] = 0.0  # a constant by now
    before["poses"] = "given"
    assert kind.options.model_validate(before).train.rays_per_batch == 4096
    revised = kind.revise(before, {"exports": ["scene.spz"]})
    assert (
        revised.exports == ("scene.spz",)
        and revised.train.rays_per_batch == 4096
        and revised.poses == "given"
    )
    paper = ReconstructOptions(preset="redisplats").config().model_dump(mode="json")
    paper["train"]["materials"]["learn"] = True  # which the last version accepted
    assert kind.revise(paper, {"exports": []}).train.materials.learn


def test_retry_with_materials_adds_their_settings() -> None:
    kind = get_job_kind("reconstruct")
    before = ReconstructOptions(preset="fast", set=("rays_per_batch=4096", "seed=7")).config()
    changed = kind.revise(before.model_dump(mode="json"), {"materials": True})
    wanted = ReconstructOptions(preset="fast", materials=True, set=("rays_per_batch=4096", "seed=7")).config()
    assert changed.run_config() == wanted
    back = kind.revise(changed.model_dump(mode="json"), {"train": {"materials": {"learn": False}}})
    assert back.run_config() == before
