"""Estimates beside what runs have taken (``docs/notes/scenes.md``, ``docs/notes/materials.md``)."""

from pathlib import Path

import pytest

from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.cost_model import (
    Estimate,
    estimate_reconstruction,
    estimate_relight,
    estimate_render,
)
from octasplat.engine.operations.relight import RelightOptions
from octasplat.engine.operations.render import RenderOptions
from octasplat.engine.pathtracing.stage.model import Integrator, Stage
from octasplat.engine.runs.config import resolve_config


def estimated(preset: str, sizes: ImageSizes, *, materials: bool = False) -> Estimate:
    config = resolve_config(preset, materials=materials)
    return estimate_reconstruction(config, [sizes], 1)


@pytest.mark.parametrize(
    ("preset", "sizes", "materials", "took_cpu_seconds"),
    [
        ("fast", ImageSizes(269, 480, 50), False, 109),
        ("standard", ImageSizes(269, 480, 50), False, 599),
        ("fast", ImageSizes(960, 716, 48), False, 137),
        ("standard", ImageSizes(960, 716, 48), False, 1413),
        ("standard", ImageSizes(800, 533, 126), False, 1999),
        ("standard", ImageSizes(400, 400, 100), True, 2343),
    ],
)
def test_estimated_time_is_within_factor_two(
    preset: str, sizes: ImageSizes, materials: bool, took_cpu_seconds: float
) -> None:
    found = estimated(preset, sizes, materials=materials).cpu_seconds
    assert took_cpu_seconds / 2 < found < took_cpu_seconds * 2


def test_materials_take_more_memory_and_time() -> None:
    plain, shiny = (
        estimated("standard", ImageSizes(400, 400, 100), materials=materials) for materials in (False, True)
    )
    # private memory: 1.74 GB were measured without residual colors, which take 0.11 GB more
    assert shiny.memory_bytes == pytest.approx(1.85e9, rel=0.05)
    assert shiny.memory_bytes > plain.memory_bytes
    assert shiny.cpu_seconds > 2 * plain.cpu_seconds


def test_estimate_counts_memory_of_search_for_poses() -> None:
    sizes = [ImageSizes(4000, 3000, 1432)]
    given, found = (
        estimate_reconstruction(
            resolve_config("fast").model_copy(update={"max_side": 2000, "poses": poses}), sizes, 2
        ).memory_bytes
        for poses in ("given", "auto")
    )
    assert given < 2e9 and 3.8e9 / 1.2 < found < 3.8e9 * 1.2


@pytest.mark.parametrize(
    ("integrator", "measured_bytes"),
    # private memory, times four, of a scene of 200 Gaussians at 1920 x 1080
    [(None, 1.3e9), ({}, 1.9e9), ({"layers": True}, 4.8e9), ({"denoise": True}, 9.9e9)],
)
def test_estimated_memory_of_pictures_goes_by_their_size(
    integrator: dict[str, bool] | None, measured_bytes: float
) -> None:
    stage = None if integrator is None else Stage(integrator=Integrator(**integrator))
    small, large = (
        estimate_render(
            RenderOptions(width_px=side, height_px=side * 9 // 16, stage=stage, format="exr"), [], 1
        ).memory_bytes
        for side in (320, 3840)
    )
    assert small < 0.5e9 and measured_bytes / 2 < large < 2 * measured_bytes


def test_estimated_memory_of_relit_views_is_that_of_the_largest() -> None:
    sizes = [ImageSizes(3840, 2160, 1), ImageSizes(320, 240, 500)]
    options = RelightOptions(mode="views", format="png", environments=(Path("sky.hdr"),))
    full = estimate_relight(options, sizes, 1).memory_bytes
    less = estimate_relight(options.model_copy(update={"max_side": 640}), sizes, 1).memory_bytes
    assert less < 0.6e9 and 2.5e9 < full < 4e9


@pytest.mark.parametrize("minutes", [None, 10])
def test_fit_of_residual_colors_is_a_stage_of_its_own(minutes: float | None) -> None:
    sizes = [ImageSizes(400, 400, 100)]
    config = resolve_config("fast", materials=True).model_copy(update={"minutes": minutes})
    stages = estimate_reconstruction(config, sizes, 1).stage_seconds
    assert stages["residual"] / stages["train"] == pytest.approx(0.17 * 1.6, rel=0.02)
    if minutes is not None:
        assert stages["residual"] + stages["train"] == pytest.approx(600, rel=0.05)
    plain = resolve_config("fast").model_copy(update={"minutes": minutes})
    assert "residual" not in estimate_reconstruction(plain, sizes, 1).stage_seconds
