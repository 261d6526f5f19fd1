"""Settings of earlier versions that became constants: their runs are read and can go on."""

import hashlib
import json

import pytest
from pydantic import ValidationError

from octasplat.engine.runs.config import ReconstructionConfig
from octasplat.engine.settings.base import dump_with_former_settings
from octasplat.engine.train.config import TrainConfig, preset, with_materials


def test_config_with_former_settings_at_their_constants_is_read() -> None:
    config = ReconstructionConfig.model_validate(
        {
            "train": {
                "background_even": 0.1,
                "misfits_after": 0.3,
                "trace": {"t_min": 0.0},
                "materials": {"hand_over": [0.0, 0.02], "secondary_share": 1.0, "first_roughness": 0.3},
            }
        }
    )
    assert config == ReconstructionConfig()


@pytest.mark.parametrize(
    ("section", "name", "value", "constant"),
    [
        ("", "background_even", 0.2, "0.1"),
        ("materials", "hand_over", [0.0, 0.5], "[0.0, 0.02]"),
        ("materials", "secondary_share", 0.5, "1"),
        ("trace", "t_min", 0.1, "0"),
    ],
)
def test_config_with_another_value_of_a_former_setting_is_refused(
    section: str, name: str, value: object, constant: str
) -> None:
    given = {section: {name: value}} if section else {name: value}
    with pytest.raises(ValidationError) as refusal:
        TrainConfig.model_validate(given)
    message = refusal.value.errors()[0]["msg"]
    assert f"{name} is no setting any more: it is always {constant}, not {value}" in message


@pytest.mark.parametrize(
    ("name", "materials", "digest"),
    [
        ("standard", False, "a34d565b9a2e82f2e9dfada8b3fcc0bf718e4f0a4afc6d9f38390e1d877aa1ed"),
        ("standard", True, "f384173e5f95ef1176ab0b03daa39c4f466a66414a83113e0f32ce603158aeac"),
    ],
)
def test_settings_digest_equals_former_version(name: str, materials: bool, digest: str) -> None:
    # of the recipe whose settings are as they were
    config = with_materials(preset(name), "near_field") if materials else preset(name)
    text = json.dumps(dump_with_former_settings(config))
    assert hashlib.sha256(text.encode()).hexdigest() == digest
