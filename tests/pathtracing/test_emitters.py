"""Light that has an extent: meshes that shine, balls of light, and what they bring to shadowed Gaussians."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.gaussian_layers import build_gaussian_layers
from octasplat.engine.pathtracing.path_tracer import PathTracer, PathTracerScene
from octasplat.engine.pathtracing.stage.materials import Diffuse
from octasplat.engine.pathtracing.stage.model import (
    DirectionalLight,
    Integrator,
    PointLight,
    Stage,
    StageGaussians,
    StageMesh,
)
from octasplat.engine.render.image_files import write_png
from octasplat.engine.trace.protocol import TraceSettings
from tests.support.light_scenes import camera, film_of, table_with_a_box

NUMBERS = Integrator(samples=1024, max_depth=1, anti_aliasing=False)
WHITE = (1.0, 1.0, 1.0)
FLOOR = StageMesh(shape="plane", scale=9, material=Diffuse(color_srgb=WHITE))
SPOT = camera((0.0, -0.05, -0.3), (0, 0, 0), (3, 3), 1e-3)
"""Sees the floor's middle from so low that no lamp above is in the way."""


def irradiance(stage: Stage, folder: Path = Path()) -> float:
    return float(film_of(stage, SPOT, folder).image().rgb_linear.mean() * np.pi)


@pytest.mark.parametrize("visible", [True, False])
def test_sphere_light_irradiance_matches_solid_angle(visible: bool) -> None:
    lamp = PointLight(position=(0, -2, 0), intensity=3.0, radius=0.8, visible=visible)
    stage = Stage(gaussians=(), meshes=(FLOOR,), lights=(lamp,), integrator=NUMBERS)
    # Radiance times pi times the square of radius over distance: as of a point, while none of it sets.
    assert irradiance(stage) == pytest.approx(3.0 / 4, rel=0.01)


def test_emissive_disc_irradiance_matches_form_factor(tmp_path: Path) -> None:
    # A square of half side a at height h, as four rectangles from its middle.
    a, h = 0.7, 1.0
    x = a / np.hypot(a, h)
    factor = 4 * x / np.pi * np.arctan(a / np.hypot(a, h))
    write_png(tmp_path / "half.png", np.full((2, 2, 3), 0.5, np.float32))
    for more, share in (({}, 1.0), ({"emission_texture": "half.png"}, 0.21404)):
        glow = Diffuse(color_srgb=(0, 0, 0), emission=2.0, emission_srgb=WHITE, **more)
        lamp = StageMesh(shape="plane", scale=a, position=(0, -h, 0), material=glow)
        stage = Stage(gaussians=(), meshes=(FLOOR, lamp), integrator=NUMBERS)
        assert irradiance(stage, tmp_path) == pytest.approx(2.0 * np.pi * factor * share, rel=0.01)


def test_emitter_without_area_is_refused(tmp_path: Path) -> None:
    (tmp_path / "line.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    with pytest.raises(ConfigError, match=r"meshes\[0\]: shines, but has no area"):
        compile_meshes(Stage(meshes=(StageMesh(file="line.obj", material=Diffuse(emission=1)),)), tmp_path)


def seen(stage: Stage) -> np.ndarray:
    """The linear picture of the table beside its box, from above."""
    scene = build_gaussian_layers(
        stage, table_with_a_box(), lambda path: pytest.fail(str(path)), Path(), TraceSettings(), size=1.0,
        threads=2,
    )  # fmt: skip
    tracer = PathTracer(
        PathTracerScene(compile_meshes(stage, Path(), threads=2), scene), stage.integrator, threads=2
    )
    view = camera((0.55, -2.0, -0.45), (0.55, 0, -0.45001), (4, 4), 5)
    return tracer.render(view.rays()).image().rgb_linear


def test_added_lamp_adds_light_and_trained_light_only_shadows() -> None:
    numbers = Integrator(samples=256, max_depth=1, anti_aliasing=False)
    table = StageGaussians(ambient=0.25)
    plain = seen(Stage(gaussians=(table,), integrator=numbers))
    old = DirectionalLight(direction=(0, 1, 0), irradiance=2.0)
    new = DirectionalLight(direction=(0, 1, 0), irradiance=np.pi, adds_light=True)
    lit = seen(Stage(gaussians=(table,), lights=(new,), integrator=numbers))
    # An irradiance of pi on a matt surface adds its albedo: as much as to a mesh, whatever the ambient.
    np.testing.assert_allclose(lit, plain * 2, rtol=0.02)
    both = seen(Stage(gaussians=(table,), lights=(old, new), integrator=numbers))
    assert both.mean() == pytest.approx(plain.mean() * 2, rel=0.03)
    roof = StageMesh(shape="plane", scale=9, position=(0, -5, 0), material=Diffuse())
    dark = seen(Stage(gaussians=(table,), meshes=(roof,), lights=(old, new), integrator=numbers))
    assert dark.mean() == pytest.approx(plain.mean() * 0.25, rel=0.03)
