"""Forms from the schemas of the options."""

import json
from itertools import chain

import pytest

from octasplat.engine.settings.preset_names import PRESETS
from octasplat.engine.train.config import TrainConfig
from octasplat.service.web.form_fields import FormField
from octasplat.service.web.forms import OptionsForm, options_form
from octasplat.workers.worker.job_kinds import JobKind, get_job_kind, job_kinds


def fields_of(form: OptionsForm) -> dict[str, FormField]:
    folded = chain(*(section.fields for section in form.more), form.experimental)
    return {f.path: f for f in chain(form.first, folded)}


def leaves(values: dict, prefix: str = "") -> set[str]:
    found = set()
    for name, value in values.items():
        found |= leaves(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}"}
    return found


def test_settings_have_form_fields() -> None:
    kind = get_job_kind("reconstruct")
    form = options_form(kind)
    for preset in PRESETS:
        options = kind.resolve({"preset": preset}).model_dump(mode="json")
        del options["begins_with_source"]  # set by source_id, which the form sends beside the options
        assert leaves(options) <= set(fields_of(form))
    assert [f.path for f in form.first][:3] == ["preset", "poses", "max_side"]


def test_defaults_follow_the_preset() -> None:
    fields = fields_of(options_form(get_job_kind("reconstruct")))
    kind = get_job_kind("reconstruct")
    shown = json.loads(fields["train.iterations"].defaults)
    assert shown == {
        name: str(kind.resolve({"preset": name}).model_dump()["train"]["iterations"]) for name in PRESETS
    }
    assert json.loads(fields["train.densify.kind"].defaults)["redisplats"] == "redisplats"
    assert fields["test_every"].defaults == "" and fields["test_every"].default == "8"


def test_limits_choices_and_words() -> None:
    fields = fields_of(options_form(get_job_kind("reconstruct")))
    assert fields["test_every"].low == 0 and fields["test_every"].control == "whole"
    assert (
        fields["train.ssim_patch_fraction"].high == 1
        and fields["train.ssim_patch_fraction"].control == "number"
    )
    assert [choice.value for choice in fields["poses"].choices] == ["given", "auto", "missing"]
    assert fields["held_out"].control == "list"
    assert "hold out" in fields["held_out"].help.lower()
    assert fields["train.rays_per_batch"].help == TrainConfig.model_fields["rays_per_batch"].description
    assert fields["train.densify.growth"].help.startswith("Only for mcmc")
    assert not fields["train.densify.start"].help.startswith("Only for")


def test_files_are_chosen_from_the_formats() -> None:
    export = fields_of(options_form(get_job_kind("export")))
    names = [choice.value for choice in export["files"].choices]
    assert {"viewer.glb", "surface.glb", "octagons.ply", "scene.spz", "scene.splat"} <= set(names)
    assert export["files"].required
    for name in names:  # the kind takes all that is offered
        get_job_kind("export").resolve({"files": [name]})


OURS = [kind for kind in job_kinds() if kind.program.startswith("octasplat.")]
"""Not those that other tests register."""


@pytest.mark.parametrize("kind", OURS, ids=lambda kind: kind.name)
def test_job_kinds_have_forms_with_explained_fields(kind: JobKind) -> None:
    form = options_form(kind)
    names = [f.path for f in chain(form.first, *(s.fields for s in form.more), form.experimental)]
    assert names and len(names) == len(set(names))
    assert [f.path for f in fields_of(form).values() if not f.help] == []


def test_texts_of_pairs_are_json() -> None:
    transform = fields_of(options_form(get_job_kind("transform")))
    assert transform["rotate"].control == "json" and transform["translate"].control == "numbers"
    assert transform["up"].control == "list" and transform["matrix"].control == "upload"


def test_basic_fields_are_open_others_folded() -> None:
    form = options_form(get_job_kind("reconstruct"))
    assert {"train.iterations", "train.background", "materials"} <= {f.path for f in form.first}
    assert {f.group for f in form.first} == {"basic"}
    assert {f.group for section in form.more for f in section.fields} == {"advanced"}
    assert "train.plane_sweep_unseen" in {f.path for f in form.experimental}


def test_form_fields_have_units() -> None:
    fields = fields_of(options_form(get_job_kind("reconstruct")))
    assert fields["max_side"].unit == "px" and fields["train.early_stopping_db"].unit == "dB"


def test_values_of_several_types_are_chosen_where_all_are_known() -> None:
    exposure = fields_of(options_form(get_job_kind("reconstruct")))["train.exposure"]
    assert exposure.control == "choice"
    assert [choice.value for choice in exposure.choices] == ["true", "false", "auto"]


def test_boxes_are_numbers_and_files_are_sent() -> None:
    fields = fields_of(options_form(get_job_kind("material")))
    assert fields["box"].control == "numbers"
    assert fields["mesh"].control == "upload" and fields["masks"].control == "uploads"
