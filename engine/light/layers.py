"""The Gaussians of a stage as the path tracer sees them: layers on rays, and what they keep off."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from octasplat.engine.edit.affine import scaling, transform, translation
from octasplat.engine.edit.selection import merge
from octasplat.engine.errors import ConfigError
from octasplat.engine.gaussians.channels import stacked
from octasplat.engine.gaussians.materials import MATERIAL_WIDTHS, has_materials
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.light.kernels_layer import AMBIENT, RELIT, SHADOWED
from octasplat.engine.light.kernels_material_layer import ALBEDO, COLUMNS, LIFT, MATERIAL
from octasplat.engine.light.meshes import rotation_matrix
from octasplat.engine.light.stage import Stage, StageGaussians
from octasplat.engine.rays import RayBatch
from octasplat.engine.trace.facing import faced
from octasplat.engine.trace.make import make_tracer
from octasplat.engine.trace.protocol import Tracer, TraceResult, TraceSettings

FEATURES = 3
BIAS_OF_SIZE = 0.03
LIFT_OF_SCALE = 0.5
"""Rays leave a surface of Gaussians so far above it, of their standard deviations."""


@dataclass(frozen=True)
class GaussianLayers:
    """Gaussians, with features that say how they take light.

    Attributes:
        tracer: all Gaussians, with the features of :mod:`octasplat.engine.light.kernels_layer`.
        spent_below: transmittance at which a ray counts as ended.
        on_meshes: those that cast shadows on meshes; None where none do.
        on_gaussians: those that cast shadows on Gaussians.
        not_on_gaussians: those that do not; the light that they keep off is in the colours already.
        shadow_bias: Gaussians nearer than this to a lit layer keep nothing off it, world units.
        with_materials: whether some are surfaces of their materials, with the features of
            :mod:`octasplat.engine.light.kernels_material_layer`.
    """

    tracer: Tracer
    spent_below: float
    on_meshes: Tracer | None = None
    on_gaussians: Tracer | None = None
    not_on_gaussians: Tracer | None = None
    shadow_bias: float = 0.0
    with_materials: bool = False

    def trace(self, rays: RayBatch, t_max: Float32[np.ndarray, " r"]) -> TraceResult:
        """What lies on rays up to a distance each."""
        seen = self.tracer.trace(rays.up_to(t_max))
        if self.tracer.settings.flip_normal_cos > 0:
            normals = faced(seen.normal_world, rays.directions_world)
            seen.normal_world = normals.normal_world.astype(np.float32)
        return seen


def stage_layers(
    stage: Stage,
    main: FlatGaussians | None,
    read: Callable[[Path], FlatGaussians],
    folder: Path,
    settings: TraceSettings,
    *,
    size: float,
    threads: int = 0,
) -> GaussianLayers | None:
    """The Gaussian scenes of a stage, placed, joined and ready to be traced; None where it has none.

    Args:
        stage: what to read.
        main: the scene that is rendered, for entries that name no file.
        read: reads a file of Gaussians.
        folder: where files are relative to.
        settings: where rays are cut off.
        size: of the scene, world units; the bias of shadows is 3 % of it unless the stage says else.
        threads: for building and tracing; 0 takes all.

    Raises:
        ConfigError: an entry without a file, and no scene is rendered.
        SceneFileError: a file cannot be read.
    """
    parts, features, surfaces, on_meshes, on_gaussians, biases = [], [], [], [], [], []
    for number, scene in enumerate(stage.gaussians):
        if scene.file is None and main is None:
            raise ConfigError(f"gaussians[{number}]: name a file; no scene is rendered here.")
        gaussians = main if scene.file is None else read(folder / scene.file)
        assert gaussians is not None
        placed = moved(gaussians, scene)
        surface = scene.light == "relit" and has_materials(gaussians)
        parts.append(_black(placed) if surface else placed)
        features.append(_material_features(placed, scene) if surface else _features(placed, scene))
        surfaces.append(surface)
        on_meshes.append(np.full(len(gaussians), scene.shadows_on_meshes))
        on_gaussians.append(np.full(len(gaussians), scene.shadows_on_gaussians))
        biases.append(BIAS_OF_SIZE * size if scene.shadow_bias is None else scene.shadow_bias)
    if not parts:
        return None
    # Channels say nothing of light, and two scenes may mean different things by one name.
    whole = merge([part.without_channels(tuple(part.channels)) for part in parts])
    tracer = make_tracer(settings, threads=threads, build_quality=2)
    columns = COLUMNS if any(surfaces) else FEATURES
    tracer.build(whole, np.ascontiguousarray(np.concatenate(features)[:, :columns]))

    def caster(chosen: Bool[np.ndarray, " n"]) -> Tracer | None:
        if chosen.all() or not chosen.any():
            return tracer if chosen.any() else None
        some = make_tracer(settings, threads=threads, build_quality=2)
        some.build(whole.select(chosen))
        return some

    casting = np.concatenate(on_gaussians)
    return GaussianLayers(
        tracer,
        settings.transmittance_min,
        caster(np.concatenate(on_meshes)),
        caster(casting),
        caster(~casting),
        max(biases),
        any(surfaces),
    )


def moved(gaussians: FlatGaussians, place: StageGaussians) -> FlatGaussians:
    """Gaussians scaled, turned and moved; the very same ones where nothing is to be done."""
    assert isinstance(place.scale, float | int)
    if place.scale == 1.0 and not any(place.rotation_degrees) and not any(place.position):
        return gaussians
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(place.rotation_degrees)
    matrix = translation(np.array(place.position)) @ matrix @ scaling(np.full(3, place.scale))
    return transform(gaussians, matrix)


def _features(gaussians: FlatGaussians, scene: StageGaussians) -> Float32[np.ndarray, "n f"]:
    values = np.zeros((len(gaussians), COLUMNS), np.float32)
    if scene.light == "shadowed":
        values[:, SHADOWED] = 1.0 - scene.ambient
    elif scene.light == "relit":
        values[:, RELIT], values[:, AMBIENT] = 1.0, scene.ambient
    return values


def _material_features(gaussians: FlatGaussians, scene: StageGaussians) -> Float32[np.ndarray, "n f"]:
    values = np.zeros((len(gaussians), COLUMNS), np.float32)
    values[:, MATERIAL] = 1.0
    values[:, ALBEDO:LIFT] = stacked(gaussians.channels, tuple(MATERIAL_WIDTHS))
    values[:, LIFT] = (
        LIFT_OF_SCALE * np.sqrt(gaussians.scales.prod(axis=1))
        if scene.shadow_bias is None
        else scene.shadow_bias
    )
    return values


def _black(gaussians: FlatGaussians) -> FlatGaussians:
    """The same Gaussians without a colour of their own."""
    sh = np.zeros((len(gaussians), 1, 3), np.float32)
    sh[:, 0] = -1.0 / SH_C0
    return replace(gaussians, sh=sh)
