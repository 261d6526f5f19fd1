"""Gaussians beside a mirror in Mitsuba 3: the same picture, but for how ellipsoids and octagons differ."""

import os
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.gaussians.octagon import CHI2_3_99
from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.gaussian_layers import build_gaussian_layers
from octasplat.engine.pathtracing.path_tracer import PathTracer, PathTracerScene
from octasplat.engine.pathtracing.stage.materials import Mirror
from octasplat.engine.pathtracing.stage.model import Integrator, Stage, StageGaussians, StageMesh
from octasplat.engine.trace.protocol import TraceSettings
from tests.support.light_scenes import camera, psnr

pytest.importorskip("mitsuba")
pytestmark = [
    pytest.mark.heavy,
    # Only Mitsuba's LLVM variants have the integrator; some versions of LLVM (15 is one) end the process.
    pytest.mark.skipif("DRJIT_LIBLLVM_PATH" not in os.environ, reason="name an LLVM of 19 or so for Mitsuba"),
]

# Both end a ray where less than a hundredth of it is left, and cut Gaussians off at the same ellipse.
SETTINGS = TraceSettings(q=CHI2_3_99, transmittance_min=0.01, alpha_max=0.9999)


def cloud(count: int) -> FlatGaussians:
    """Colored Gaussians of all opacities within 3 units, their colors dependent on the direction."""
    rng = np.random.default_rng(3)
    sh = rng.normal(0, 0.08, (count, 4, 3))
    sh[:, 0] = (rng.random((count, 3)) - 0.5) / SH_C0
    return FlatGaussians(
        rng.normal(0, 1.0, (count, 3)).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.uniform(-2, -1, (count, 2)).astype(np.float32),
        rng.uniform(-2, 3, count).astype(np.float32),
        sh.astype(np.float32),
    )


def test_gaussians_beside_a_mirror() -> None:
    from tests.support.mitsuba_gaussians import GaussiansBesideMirror

    some = cloud(600)
    mirror = StageMesh(
        shape="plane", rotation_degrees=(90, 55, 0), position=(5, 0, 2), scale=3, material=Mirror()
    )
    numbers = Integrator(samples=1, max_depth=4, roulette_depth=64, anti_aliasing=False)
    stage = Stage(gaussians=(StageGaussians(light="emissive"),), meshes=(mirror,), integrator=numbers)
    image = camera((-3.0, -0.5, -7.0), (1.4, 0, 0), (160, 120), 50).rays()
    layers = build_gaussian_layers(stage, some, _nothing, Path(), SETTINGS, size=1.0)
    meshes = compile_meshes(stage, Path())
    ours = PathTracer(PathTracerScene(meshes, layers), numbers).render(image).image().rgb_srgb
    mirrored = GaussiansBesideMirror(some, meshes.surfaces.corners_world, SETTINGS)
    theirs = mirrored.trace(image.origin_world, image.rays.directions_world).reshape(ours.shape)
    theirs = np.clip(theirs, 0, 1)
    bare = PathTracerScene(compile_meshes(Stage(gaussians=(), integrator=numbers), Path()), layers)
    without = PathTracer(bare, numbers).render(image).image().rgb_srgb
    in_mirror = np.abs(ours - without).max(axis=2) > 0.05
    assert in_mirror.mean() > 0.05
    found = psnr(ours, theirs), psnr(ours[in_mirror], theirs[in_mirror])
    print(f"{found[0]:.1f} dB, in the mirror {found[1]:.1f} dB")  # noqa: T201
    assert min(found) > 40


def _nothing(path: Path) -> FlatGaussians:
    raise AssertionError(path)
