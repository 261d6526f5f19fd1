"""A scene is measured on the background that it was trained on; another one is told."""

from pathlib import Path

import pytest

from octasplat.engine.core.events import Event, Warned
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.runs.config import ReconstructionConfig, read_config, resolve_config
from octasplat.engine.runs.run_dataset import open_run_dataset


@pytest.mark.parametrize(
    ("trained", "measured"), [("auto", "black"), ("black", "black"), ("white", "white"), ("random", "black")]
)
def test_default_background_is_that_of_training(trained: str, measured: str) -> None:
    config = resolve_config("fast", assignments=[f"background={trained}"])
    assert config.evaluation_background == measured


def test_evaluation_background_option_overrides_training(tmp_path: Path) -> None:
    asked = {"evaluation_background": "black"}
    config = resolve_config("fast", settings=asked, assignments=["background=white"])
    assert config.evaluation_background == "black"
    write_json(tmp_path / "config.json", {"reconstruction": config.model_dump(mode="json")})
    assert read_config(tmp_path / "config.json") == config
    assert ReconstructionConfig.model_validate(config.model_dump()) == config


def test_background_mismatch_without_alpha_warns(tmp_path: Path) -> None:
    config = SyntheticDatasetConfig(views=4, width_px=16, height_px=12, samples_per_side=1, points=60)
    write_synthetic_dataset(tmp_path / "scene", config)

    def told(**settings: str) -> list[str]:
        events: list[Event] = []
        resolved = resolve_config("fast", settings=settings, assignments=["background=white"])
        open_run_dataset(tmp_path / "scene", tmp_path / "run", resolved, 1, events.append)
        return [event.message for event in events if isinstance(event, Warned)]

    assert not any("measured on" in message for message in told())
    assert any("trained on white and measured on black" in m for m in told(evaluation_background="black"))
    mismatched = resolve_config(
        "fast", settings={"evaluation_background": "black"}, assignments=["background=white"]
    )
    assert mismatched.background_mismatch(has_alpha=True) is None
