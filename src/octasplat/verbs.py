"""The verbs of octasplat on files: a function for each, with the options of its command.

Written by tests/api/write_verbs.py from the requests of :mod:`octasplat.engine.operations`.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel

from octasplat.engine.events import Listener
from octasplat.engine.operations.base import never
from octasplat.operating import run_operation
from octasplat.places import PathLike

if TYPE_CHECKING:
    from octasplat.engine.operations.crop import CropResult
    from octasplat.engine.operations.evaluate import EvaluateResult
    from octasplat.engine.operations.material import MaterialResult
    from octasplat.engine.operations.surface import SurfaceResult


def evaluate(
    source: PathLike,
    *,
    all_views: bool = False,
    scales: Sequence[int] | str = (),
    background: Literal["black", "white"] | None = None,
    dataset: PathLike | None = None,
    on: PathLike | None = None,
    progress: Listener | None = None,
    should_stop: Callable[[], bool] = never,
    threads: int = 0,
) -> "EvaluateResult":
    """Measure a finished run again.

    Args:
        source: The folder of a finished run.
        all_views: Measure all photographs, not only those that were held out, into on/<name of their
            folder>; so it is with photographs of another dataset, which a job names as 'dataset_id'.
        scales: Measure smaller sizes instead, such as 2,4,8: renders at 1/2, 1/4 and 1/8 of the size
            against photographs made as small, with 1, 4 and 16 rays per pixel; into scales.json.
        background: Colour behind the scene and behind what masks leave out. [default: the run's]
        dataset: Where the run's photographs are now, if they were moved or the run was downloaded.
        on: Measure all photographs of another folder instead (images/ and sparse/0 in the same world as
            the run's); the results go to OUT/on/<its name>.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``Cancelled``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> found = osp.evaluate("run")
    >>> found.psnr > 10, len(found.views)
    (True, 2)
    """
    return run_operation(
        "evaluate",
        {
            "all_views": all_views,
            "scales": scales,
            "background": background,
            "source": source,
            "dataset": dataset,
            "on": on,
        },
        progress,
        should_stop,
        threads,
    )


def surface(
    source: PathLike,
    output: PathLike,
    *,
    unbounded: bool = False,
    bounds: Sequence[float] | str | None = None,
    voxel: float | None = None,
    resolution: int | None = None,
    truncation: float | None = None,
    depth_trunc: float | None = None,
    depth: Literal["median", "expected"] = "median",
    depth_side: int = 640,
    min_alpha: float = 0.5,
    min_weight: float = 0.5,
    unseen: Literal["open", "solid"] = "open",
    backdrop: bool = False,
    settle: bool = False,
    keep_components: int | None = None,
    min_component: float = 0.01,
    fill_holes: Literal["all"] | float = 0.0,
    fit: bool = True,
    texture_side: int | None = None,
    max_memory_gb: float = 4.0,
    room: bool = False,
    max_triangles: Sequence[str] | str | int | Sequence[str | int] | None = (),
    materials: bool = False,
    up: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None,
    dataset: PathLike | None = None,
    progress: Listener | None = None,
    should_stop: Callable[[], bool] = never,
    threads: int = 0,
) -> "SurfaceResult":
    """One coloured triangle mesh of a scene.

    Args:
        source: The scene to mesh: the folder of a run, or a file of any format.
        output: A .glb, .ply or .obj file.
        unbounded: Reach to the horizon, with ever coarser voxels, instead of meshing a box.
        bounds: The box to mesh, in scene units; octasplat info tells where the scene lies. [default:
            what is seen of the space that the cameras surround]
        voxel: Side of a voxel, in scene units, at the centre where unbounded. [default: as resolution
            says]
        resolution: Voxels along the longest side of the box. [default: 512, or fewer where a voxel
            would be smaller than one and a half pixels of the depth maps]
        truncation: Half width of the band around the surface in which distances are kept. [default: 3%
            of the cameras' distance, about what trained depths are off by, and at least 4]
        depth_trunc: Ignore depths beyond this, in scene units. [default: none]
        depth: Which depth is fused: the median, where half of the light is gone, or the expected one.
        depth_side: Longer side of the depth maps.
        min_alpha: Pixels that the scene covers less than this have no depth.
        min_weight: Least evidence for a voxel; a view that looks straight onto the surface gives 1.
        unseen: Space near the surface that no view saw: open leaves holes there, solid closes the mesh.
        backdrop: A sphere around everything that shows what the scene shows in the gaps of the mesh.
        settle: Move vertices along their normals to where the pictures agree, before colours.
        keep_components: Keep so many connected parts only, largest first. [default: by min_component]
        min_component: Remove parts of less than this share of the largest part's area.
        fill_holes: Close holes with rims shorter than so many voxels; or 'all'.
        fit: Of all colours, take those with which the mesh looks as like the pictures as it can.
        texture_side: Colours in a square texture of this side instead of in the vertices; .glb and
            .obj.
        max_memory_gb: Refuse a volume that takes more memory than this.
        room: What pictures of a room need, where nothing else is said: unbounded, unseen solid,
            backdrop, settle and finer voxels.
        max_triangles: Decimate to so many triangles, such as 60000 or 60k; 5k,50k,500k writes a file
            each, NAME_5k.glb. [default: all]
        materials: Base colour, metallic, roughness and normals in textures, to be lit; .glb. Takes
            60,000 triangles and a texture of 1,024 pixels where nothing else is said.
        up: With materials: the axis that points up. [default: the run's, of a file -y]
        dataset: Take the cameras of the photographs in this folder, and of a run the colours. [default:
            the cameras that a run keeps; else none]
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``Cancelled``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> osp.surface("run", "surface.glb", max_triangles=500).files[0].name
    'surface.glb'
    """
    return run_operation(
        "surface",
        {
            "unbounded": unbounded,
            "bounds": bounds,
            "voxel": voxel,
            "resolution": resolution,
            "truncation": truncation,
            "depth_trunc": depth_trunc,
            "depth": depth,
            "depth_side": depth_side,
            "min_alpha": min_alpha,
            "min_weight": min_weight,
            "unseen": unseen,
            "backdrop": backdrop,
            "settle": settle,
            "keep_components": keep_components,
            "min_component": min_component,
            "fill_holes": fill_holes,
            "fit": fit,
            "texture_side": texture_side,
            "max_memory_gb": max_memory_gb,
            "room": room,
            "max_triangles": max_triangles,
            "materials": materials,
            "up": up,
            "source": source,
            "output": output,
            "dataset": dataset,
        },
        progress,
        should_stop,
        threads,
    )


def material(
    source: PathLike,
    output: PathLike,
    *,
    set: BaseModel | Mapping[str, Any] | str | None = None,
    scale: BaseModel | Mapping[str, Any] | str | None = None,
    where: str | None = None,
    box: Sequence[float] | None = None,
    sphere: Sequence[float] | None = None,
    inverse: bool = False,
    mesh: PathLike | None = None,
    masks: Sequence[PathLike] = (),
    progress: Listener | None = None,
    should_stop: Callable[[], bool] = never,
    threads: int = 0,
) -> "MaterialResult":
    """Change the materials of a scene.

    Args:
        source: The scene to read: a file of any format, or the folder of a run.
        output: A folder for all of the run with its new scene, or a file for the scene alone.
        set: Values to set: albedo=R,G,B (linear, 0 to 1), albedo=#rrggbb (display), metallic=0..1 or
            roughness=0..1.
        scale: Factors to multiply albedo, metallic or roughness by; the result is at most 1.
        where: Comparisons joined by and, or, not that hold for them, of x, y, z, opacity and channels
            such as metallic, roughness and albedo.r: 'metallic > 0.5 and z < 0'.
        box: Two corners of a box that their centres lie in, smallest coordinates first.
        sphere: Centre and radius of a sphere that their centres lie in.
        inverse: Take the other Gaussians instead.
        mesh: Those whose octagons are in this mesh: IN's mesh.ply after the rest was deleted in an
            editor.
        masks: Those that show where this image is white; it has the name of one of the run's
            photographs. Several say together what is meant.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``Cancelled``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> osp.material("shiny.ply", "dull.ply", where="metallic > 0.5", set={"roughness": 0.9}).changed
    600
    """
    return run_operation(
        "material",
        {
            "source": source,
            "output": output,
            "set": set,
            "scale": scale,
            "where": where,
            "box": box,
            "sphere": sphere,
            "inverse": inverse,
            "mesh": mesh,
            "masks": masks,
        },
        progress,
        should_stop,
        threads,
    )


def crop(
    source: PathLike,
    output: PathLike,
    *,
    where: str | None = None,
    box: Sequence[float] | None = None,
    sphere: Sequence[float] | None = None,
    inverse: bool = False,
    progress: Listener | None = None,
    should_stop: Callable[[], bool] = never,
    threads: int = 0,
) -> "CropResult":
    """Keep part of a scene.

    Args:
        source: The scene to read: a file of any format, or the folder of a run.
        output: The scene to write; the suffix says in which format.
        where: Comparisons joined by and, or, not that hold for them, of x, y, z, opacity and channels
            such as metallic, roughness and albedo.r: 'metallic > 0.5 and z < 0'.
        box: Two corners of a box that their centres lie in, smallest coordinates first.
        sphere: Centre and radius of a sphere that their centres lie in.
        inverse: Take the other Gaussians instead.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``Cancelled``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> cropped = osp.crop("scene.ply", "half.ply", where="z < 0")
    >>> cropped.kept, cropped.count
    (600, 1200)
    """
    return run_operation(
        "crop",
        {
            "source": source,
            "output": output,
            "where": where,
            "box": box,
            "sphere": sphere,
            "inverse": inverse,
        },
        progress,
        should_stop,
        threads,
    )
