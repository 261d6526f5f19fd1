"""Gaussians in the path tracer: layers along rays, and their shadows."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.affine import scaling, transform_gaussians, translation
from octasplat.engine.gaussians.channels import stack_channels
from octasplat.engine.gaussians.materials import MATERIAL_WIDTHS, has_materials
from octasplat.engine.gaussians.merge import merge_scenes
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.pathtracing.gaussian_boxes import bounding_boxes
from octasplat.engine.pathtracing.kernels.gaussian_layer import ADDITIVE, AMBIENT, RELIT, SHADOWED
from octasplat.engine.pathtracing.kernels.gaussian_surface import ALBEDO, FEATURE_COUNT, MATERIAL, RAY_OFFSET
from octasplat.engine.pathtracing.kernels.path_args import GaussianBoxes
from octasplat.engine.pathtracing.mesh_shapes import rotation_matrix
from octasplat.engine.pathtracing.stage.model import Stage, StageGaussians
from octasplat.engine.pathtracing.stage.stage_template import FILE_HAS_NO_LIGHT, shown_as_harmonics
from octasplat.engine.trace.facing_normals import face_viewer
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import Tracer, TraceResult, TraceSettings

BASE_FEATURE_COUNT = 4
SHADOW_BIAS_FRACTION = 0.03
SHADOW_BIAS_DEVIATIONS = 1.5
"""Where Gaussians are large, so is the roughness of the surface that they are: those beside a lit point reach
over it by about this many of their standard deviations."""
RAY_OFFSET_FRACTION = 0.5
"""Rays leave a surface of Gaussians so far above it, of their standard deviations."""


@dataclass(frozen=True)
class GaussianLayers:
    """Gaussian scenes, with features that say how they receive light.

    Attributes:
        tracer: all Gaussians, with features as in
            :mod:`octasplat.engine.pathtracing.kernels.gaussian_layer`.
        boxes: around them.
        min_transmittance: transmittance at which a ray counts as ended.
        mesh_shadow_tracer: those that cast shadows on meshes; None where none do.
        gaussian_shadow_tracer: those that cast shadows on Gaussians.
        non_shadow_tracer: those that do not; the light that they keep off is in the colors already.
        shadow_bias: Gaussians nearer than this to a lit layer keep nothing off it, world units.
        has_material_surfaces: whether some are surfaces of their materials, with the features of
            :mod:`octasplat.engine.pathtracing.kernels.gaussian_surface`.
    """

    tracer: Tracer
    boxes: GaussianBoxes
    min_transmittance: float
    mesh_shadow_tracer: Tracer | None = None
    gaussian_shadow_tracer: Tracer | None = None
    non_shadow_tracer: Tracer | None = None
    shadow_bias: float = 0.0
    has_material_surfaces: bool = False

    def trace(self, rays: RayBatch, t_max: Float32[np.ndarray, " r"]) -> TraceResult:
        """Return the Gaussians' radiance and transmittance along rays up to a distance each."""
        traced = self.tracer.trace(rays.with_t_max(t_max))
        if self.tracer.settings.flip_normal_cos > 0:
            normals = face_viewer(traced.normal_world, rays.directions_world)
            traced.normal_world = normals.normal_world.astype(np.float32)
        return traced


def build_gaussian_layers(
    stage: Stage,
    main_gaussians: FlatGaussians | None,
    read_gaussians: Callable[[Path], FlatGaussians],
    folder: Path,
    settings: TraceSettings,
    *,
    size: float,
    threads: int = 0,
    note: Callable[[str], None] = lambda _sentence: None,
) -> GaussianLayers | None:
    """Return the Gaussian scenes of a stage, placed, merged and ready to be traced; None without any.

    Args:
        stage: what to read.
        main_gaussians: the scene that is rendered, for entries that name no file.
        read_gaussians: reads a file of Gaussians.
        folder: where files are relative to.
        settings: where rays are cut off.
        size: of the scene, world units; see :func:`default_shadow_bias`.
        threads: for building and tracing; 0 takes all.
        note: called with a sentence on each entry whose materials are left out without it being asked for.

    Raises:
        ConfigError: an entry without a file, and no scene is rendered.
        SceneFileError: a file cannot be read.
    """
    parts, features, surfaces, on_meshes, on_gaussians, biases = [], [], [], [], [], []
    for number, scene in enumerate(stage.gaussians):
        if scene.file is None and main_gaussians is None:
            raise ConfigError(f"gaussians[{number}]: name a file; no scene is rendered here.")
        gaussians = main_gaussians if scene.file is None else read_gaussians(folder / scene.file)
        assert gaussians is not None
        placed = place_gaussians(gaussians, scene)
        if scene.file is not None and scene.light is None and has_materials(gaussians):
            note(f"gaussians[{number}]: {scene.file}: {shown_as_harmonics(FILE_HAS_NO_LIGHT)}")
        surface = scene.light == "relit" and has_materials(gaussians)
        parts.append(_without_color(placed) if surface else placed)
        features.append(_material_features(placed, scene) if surface else _layer_features(placed, scene))
        surfaces.append(surface)
        on_meshes.append(np.full(len(gaussians), scene.shadows_on_meshes))
        on_gaussians.append(np.full(len(gaussians), scene.shadows_on_gaussians))
        biases.append(default_shadow_bias(placed, size) if scene.shadow_bias is None else scene.shadow_bias)
    if not parts:
        return None
    # Channels say nothing of light, and two scenes may mean different things by one name.
    plain = [part.without_channels(tuple(part.channels)) for part in parts]
    merged = plain[0] if len(plain) == 1 else merge_scenes(plain)
    tracer = make_tracer(settings, threads=threads, build_quality=2)
    columns = FEATURE_COUNT if any(surfaces) else BASE_FEATURE_COUNT
    tracer.build(merged, np.ascontiguousarray(np.concatenate(features)[:, :columns]))

    def caster(chosen: Bool[np.ndarray, " n"]) -> Tracer | None:
        if chosen.all() or not chosen.any():  # all of them: the same hierarchy serves
            return tracer if chosen.any() else None
        some = make_tracer(settings, threads=threads, build_quality=2)
        some.build(merged.select(chosen))
        return some

    boxes = bounding_boxes(merged, settings.q)
    casting, casting_on_meshes = np.concatenate(on_gaussians), np.concatenate(on_meshes)
    return GaussianLayers(
        tracer=tracer,
        boxes=GaussianBoxes(
            boxes,
            boxes
            if casting_on_meshes.all()
            else bounding_boxes(merged.select(casting_on_meshes), settings.q),
        ),
        min_transmittance=settings.transmittance_min,
        mesh_shadow_tracer=caster(casting_on_meshes),
        gaussian_shadow_tracer=caster(casting),
        non_shadow_tracer=caster(~casting),
        shadow_bias=max(biases),
        has_material_surfaces=any(surfaces),
    )


def default_shadow_bias(gaussians: FlatGaussians, size: float) -> float:
    """Return how far Gaussians cast no shadow on each other: 3 % of the scene, more where they are large.

    Args:
        gaussians: as placed.
        size: of the scene, world units.
    """
    if len(gaussians) == 0:
        return SHADOW_BIAS_FRACTION * size
    deviations = np.sqrt(gaussians.scales.prod(axis=1))
    # half of the visible area belongs to Gaussians that are no larger
    area = np.cumsum((gaussians.opacities * deviations**2)[order := np.argsort(deviations)])
    typical = float(deviations[order][min(np.searchsorted(area, area[-1] / 2), len(order) - 1)])
    return max(SHADOW_BIAS_FRACTION * size, SHADOW_BIAS_DEVIATIONS * typical)


def place_gaussians(gaussians: FlatGaussians, placement: StageGaussians) -> FlatGaussians:
    """Return Gaussians scaled, rotated and moved; the same object for an identity placement."""
    assert isinstance(placement.scale, float | int)
    if placement.scale == 1.0 and not any(placement.rotation_degrees) and not any(placement.position):
        return gaussians
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(placement.rotation_degrees)
    matrix = translation(np.array(placement.position)) @ matrix @ scaling(np.full(3, placement.scale))
    return transform_gaussians(gaussians, matrix)


def _layer_features(gaussians: FlatGaussians, scene: StageGaussians) -> Float32[np.ndarray, "n f"]:
    values = np.zeros((len(gaussians), FEATURE_COUNT), np.float32)
    if scene.light in (None, "shadowed"):
        values[:, SHADOWED], values[:, ADDITIVE] = 1.0 - scene.ambient, 1.0
    elif scene.light == "relit":
        values[:, RELIT], values[:, AMBIENT] = 1.0, scene.ambient
    return values


def _material_features(gaussians: FlatGaussians, scene: StageGaussians) -> Float32[np.ndarray, "n f"]:
    values = np.zeros((len(gaussians), FEATURE_COUNT), np.float32)
    values[:, MATERIAL] = 1.0
    values[:, ALBEDO:RAY_OFFSET] = stack_channels(gaussians.channels, tuple(MATERIAL_WIDTHS))
    values[:, RAY_OFFSET] = (
        RAY_OFFSET_FRACTION * np.sqrt(gaussians.scales.prod(axis=1))
        if scene.shadow_bias is None
        else scene.shadow_bias
    )
    return values


def _without_color(gaussians: FlatGaussians) -> FlatGaussians:
    """Return the Gaussians with zero radiance of their own."""
    sh = np.zeros((len(gaussians), 1, 3), np.float32)
    sh[:, 0] = -1.0 / SH_C0  # color 1/2 + C0 sh = 0
    return replace(gaussians, sh=sh)
