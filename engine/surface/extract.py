"""Extraction of one colored triangle mesh from Gaussians and cameras."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.spatial import cKDTree

from octasplat.engine.core.color import to_bytes
from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.core.progress import counted_phase, stop_when_asked
from octasplat.engine.geometry.triangle_mesh import EdgeReport, TriangleMesh, edge_report
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.surface.backdrop import with_backdrop
from octasplat.engine.surface.bake_colors import COLOR_TARGET, BakeTarget, bake
from octasplat.engine.surface.bake_materials import MATERIAL_TARGET, with_materials
from octasplat.engine.surface.color_fit import Palette, Picture, TexturePalette, VertexPalette, fit_colors
from octasplat.engine.surface.depth_maps import render_depth_maps
from octasplat.engine.surface.holes import fill_holes
from octasplat.engine.surface.marching_cubes import marching_cubes
from octasplat.engine.surface.mesh_cleanup import decimate, keep_largest_components
from octasplat.engine.surface.options import ExtractionOptions
from octasplat.engine.surface.region import Region, choose_region, focus_point
from octasplat.engine.surface.texture import unwrap
from octasplat.engine.surface.tsdf_volume import BYTES_PER_BLOCK, TsdfVolume, fill_unseen, fuse_depth_maps
from octasplat.engine.surface.vertex_refinement import refine_vertices
from octasplat.engine.trace.protocol import Tracer

Points = Float32[np.ndarray, "n 3"]
TOLERANCE_VOXELS = 2.0
"""Surface this near to a point does not hide it when colors are baked."""


@dataclass(frozen=True)
class ExtractedSurface:
    """A mesh and how it came about.

    Attributes:
        mesh: the colored mesh, in the world frame.
        region: the grid it was found in.
        volume_bytes: memory of the fused volume.
        triangles_found: triangles before small parts were removed and holes were closed.
        holes_closed: number of holes closed.
        edges: how the triangles hang together, before a texture cuts them apart.
    """

    mesh: TriangleMesh
    region: Region
    volume_bytes: int
    triangles_found: int
    holes_closed: int
    edges: EdgeReport


def extract_levels(
    tracer: Tracer,
    cameras: Sequence[PinholeCamera],
    options: ExtractionOptions,
    levels: Sequence[int | None] = (None,),
    *,
    scratch: Path,
    light_frame: Float64[np.ndarray, "3 3"] | None = None,
    photographs: Sequence[Picture] | None = (),
    listener: EventListener = ignore_events,
    should_stop: Callable[[], bool] = lambda: False,
) -> tuple[ExtractedSurface, ...]:
    """Return one surface in several levels of detail, fused once, then decimated and colored for each.

    Each level is the same as when it is extracted alone.

    Args:
        tracer: with the scene built.
        cameras: where depth and colors are rendered from.
        options: all settings.
        levels: at most so many triangles; None keeps all.
        scratch: folder for a temporary file of 12 bytes for every pixel of the depth maps.
        light_frame: rows are the light's right, up and forward axes, world frame. Materials are baked, which
            the tracer must have as its first features
            (:func:`octasplat.engine.surface.bake_materials.material_features`), and a texture is needed; None
            bakes colors.
        photographs: what colors are fitted to; without any, what the scene shows from ``cameras``. None
            takes the latter alone, at the size of the depth maps, which is fast.
        listener: receives the events of the stages ``depth``, ``fusing``, ``meshing``, ``settling`` and
            ``decimating`` (if requested), ``unwrapping`` (with a texture), ``coloring`` and ``fitting`` (of
            colors).
        should_stop: asked now and then.

    Raises:
        ConfigError: the region cannot be found, is empty or takes too much memory.
        CancelledError: stopped as asked.
    """
    report = stop_when_asked(listener, should_stop, "Stopped; no surface was written.")
    if not options.unbounded and options.box is None:
        focus_point(cameras)  # complain before the long work
    volume, region, renders = _fuse_scene(tracer, cameras, options, scratch, report)
    photographs = renders if photographs is None else photographs
    volume_bytes = len(volume.blocks) * BYTES_PER_BLOCK
    with counted_phase("meshing", report, 3) as progress:
        mesh = marching_cubes(volume, options.min_weight)
        del volume  # large, and not needed any more
        found = len(mesh.faces)
        progress(1, 3)
        mesh = _keep_components(mesh, options)
        progress(2, 3)
        mesh, closed = _close_holes(mesh, options, region)
        progress(3, 3)
    if options.refine_vertices:  # while triangles are small enough to show what the pictures do
        with counted_phase("settling", report, 0) as progress:
            mesh = refine_vertices(mesh, photographs or renders, progress)
    meshes = _decimate_levels(mesh, options, levels, report)
    del mesh
    result = []
    centre = np.mean([camera.centre_world for camera in cameras], axis=0)
    for mesh in meshes:
        edges = edge_report(mesh.faces)  # before the backdrop and a texture's seams
        if options.backdrop:
            mesh = with_backdrop(mesh, centre)
        mesh = _bake_colors(
            tracer=tracer,
            cameras=cameras,
            renders=renders,
            photographs=photographs,
            options=options,
            mesh=mesh,
            region=region,
            light_frame=light_frame,
            report=report,
        )
        result.append(ExtractedSurface(mesh, region, volume_bytes, found, closed, edges))
    return tuple(result)


def _fuse_scene(
    tracer: Tracer,
    cameras: Sequence[PinholeCamera],
    options: ExtractionOptions,
    scratch: Path,
    report: EventListener,
) -> tuple[TsdfVolume, Region, tuple[Picture, ...]]:
    """Return the fused depth maps, the region that they fill, and what the cameras see."""
    with counted_phase("depth", report, len(cameras)) as progress:
        maps, renders = render_depth_maps(tracer, cameras, options, scratch, progress)
    region = choose_region(maps, options)
    with counted_phase("fusing", report, 2 * len(cameras)) as progress:
        volume = fuse_depth_maps(maps, region, options, progress)
    del maps  # the maps' memory, before colors
    if options.unseen == "solid":
        fill_unseen(volume, options.min_weight)
    return volume, region, renders


def _close_holes(mesh: TriangleMesh, options: ExtractionOptions, region: Region) -> tuple[TriangleMesh, int]:
    max_rim = None if options.fill_holes == "all" else options.fill_holes * region.voxel_world
    return fill_holes(mesh, max_rim) if max_rim is None or max_rim > 0 else (mesh, 0)


def _bake_colors(
    tracer: Tracer,
    cameras: Sequence[PinholeCamera],
    renders: Sequence[Picture],
    photographs: Sequence[Picture],
    options: ExtractionOptions,
    mesh: TriangleMesh,
    region: Region,
    light_frame: Float64[np.ndarray, "3 3"] | None,
    report: EventListener,
) -> TriangleMesh:
    """Return the mesh with colors at its vertices, or with textures."""
    tolerance = TOLERANCE_VOXELS * region.voxel_world

    def look_at(
        points: Points, normals: Points, look: BakeTarget
    ) -> tuple[np.ndarray, Bool[np.ndarray, " n"]]:
        with counted_phase("coloring", report, 0) as progress:
            baked, is_visible = bake(
                points_world=points,
                normals_world=normals,
                mesh=mesh,
                cameras=cameras,
                tracer=tracer,
                look=look,
                tolerance=tolerance,
                progress=progress,
            )
            return _fill_unseen(points, baked, is_visible), is_visible

    def colors(palette: Palette, points: Points, normals: Points) -> Points:
        if not (options.fit and photographs):
            rgb, _ = look_at(points, normals, COLOR_TARGET)
        else:  # they show all detail that there is
            rgb = np.full((len(points), 3), 0.5, np.float32)
        if not options.fit:
            return rgb
        with counted_phase("fitting", report, 0) as progress:
            return _fill_unseen(points, *fit_colors(palette, rgb, photographs or renders, progress))

    if options.texture_size is None:
        assert light_frame is None, "materials need a texture"
        rgb = colors(VertexPalette(mesh), mesh.vertices_world, mesh.vertex_normals())
        return replace(mesh, rgb_srgb=rgb)
    with counted_phase("unwrapping", report, 0):
        layout = unwrap(mesh, options.texture_size)
    points, normals = layout.points_world, layout.normals_world
    if light_frame is not None:
        return with_materials(layout, *look_at(points, normals, MATERIAL_TARGET), light_frame)
    rgb = colors(TexturePalette(layout), points, normals)
    return replace(layout.mesh, texture_srgb=to_bytes(layout.image(rgb)))


def _decimate_levels(
    mesh: TriangleMesh, options: ExtractionOptions, levels: Sequence[int | None], report: EventListener
) -> list[TriangleMesh]:
    """Return the mesh for each level, with at most its number of triangles."""
    if all(level is None for level in levels):
        return [mesh] * len(levels)
    meshes = []
    with counted_phase("decimating", report, len(levels)) as progress:
        for done, level in enumerate(levels, 1):
            # Thin parts may come apart.
            meshes.append(mesh if level is None else _keep_components(decimate(mesh, level), options))
            progress(done, len(levels))
    return meshes


def _keep_components(mesh: TriangleMesh, options: ExtractionOptions) -> TriangleMesh:
    return keep_largest_components(mesh, keep=options.keep_components, min_share=options.min_component)


def _fill_unseen(
    points: Float32[np.ndarray, "n 3"], baked: Float32[np.ndarray, "n c"], is_visible: Bool[np.ndarray, " n"]
) -> Float32[np.ndarray, "n c"]:
    """Return baked values; points that no camera sees take those of the nearest seen point."""
    if is_visible.all() or not is_visible.any():
        return baked
    _, nearest = cKDTree(points[is_visible]).query(points[~is_visible])
    filled = baked.copy()
    filled[~is_visible] = baked[is_visible][nearest]
    return filled
