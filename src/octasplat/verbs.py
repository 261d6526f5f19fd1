"""The verbs of octasplat on files: a function for each, with the options of its command.

Written by tests/api/write_verbs.py from the requests of :mod:`octasplat.engine.operations`.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypedDict

from pydantic import BaseModel

from octasplat.engine.events import Listener
from octasplat.engine.operations.base import never
from octasplat.operating import run_operation
from octasplat.places import PathLike

if TYPE_CHECKING:
    from octasplat.engine.operations.crop import CropResult
    from octasplat.engine.operations.evaluate import EvaluateResult
    from octasplat.engine.operations.material import MaterialResult
    from octasplat.engine.operations.relight import RelightResult
    from octasplat.engine.operations.render import RenderResult
    from octasplat.engine.operations.stage_init import StageInitResult
    from octasplat.engine.operations.surface import SurfaceResult


class RenderArguments(TypedDict, total=False):
    """What :func:`render` takes by name."""

    mode: Literal["turntable", "views", "path", "camera"] | None
    views: Literal["held-out", "train", "all"] | None
    photographs: Sequence[str] | None
    camera_path: BaseModel | Mapping[str, Any] | str | None
    camera: Sequence[float] | None
    look_at: Sequence[float] | None
    distance: float | None
    elevation_degrees: float | None
    frames: int | None
    seconds: float | None
    fps: float | None
    width_px: int | None
    height_px: int | None
    fov_y_degrees: float | None
    up: Literal["x", "-x", "y", "-y", "z", "-z"] | None
    max_side: int | None
    format: Literal["mp4", "png", "exr"] | None
    dataset: PathLike | None
    path_file: PathLike | None
    resume: bool
    or_anew: bool
    frames_folder: PathLike | None
    background: Literal["black", "white", "transparent"] | None
    stage: BaseModel | Mapping[str, Any] | str | None
    preview: bool
    layers: bool
    denoise: bool
    stage_file: PathLike | None
    stage_folder: PathLike | None
    progress: Listener | None
    should_stop: Callable[[], bool]
    threads: int


def evaluate(
    source: PathLike,
    *,
    all_views: bool = False,
    scales: Sequence[int] | str | None = None,
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
    depth: Literal["median", "expected"] | None = None,
    depth_side: int | None = None,
    min_alpha: float | None = None,
    min_weight: float | None = None,
    unseen: Literal["open", "solid"] | None = None,
    backdrop: bool = False,
    settle: bool = False,
    keep_components: int | None = None,
    min_component: float | None = None,
    fill_holes: Literal["all"] | float | None = None,
    fit: bool = True,
    texture_side: int | None = None,
    max_memory_gb: float | None = None,
    room: bool = False,
    max_triangles: Sequence[str] | str | int | Sequence[str | int] | None = None,
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
            Default: median.
        depth_side: Longer side of the depth maps. Default: 640.
        min_alpha: Pixels that the scene covers less than this have no depth. Default: 0.5.
        min_weight: Least evidence for a voxel; a view that looks straight onto the surface gives 1.
            Default: 0.5.
        unseen: Space near the surface that no view saw: open leaves holes there, solid closes the mesh.
            Default: open.
        backdrop: A sphere around everything that shows what the scene shows in the gaps of the mesh.
        settle: Move vertices along their normals to where the pictures agree, before colours.
        keep_components: Keep so many connected parts only, largest first. [default: by min_component]
        min_component: Remove parts of less than this share of the largest part's area. Default: 0.01.
        fill_holes: Close holes with rims shorter than so many voxels; or 'all'. Default: 0.0.
        fit: Of all colours, take those with which the mesh looks as like the pictures as it can.
        texture_side: Colours in a square texture of this side instead of in the vertices; .glb and
            .obj.
        max_memory_gb: Refuse a volume that takes more memory than this. Default: 4.0.
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
    masks: Sequence[PathLike] | None = None,
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


def render(
    source: PathLike,
    output: PathLike,
    *,
    mode: Literal["turntable", "views", "path", "camera"] | None = None,
    views: Literal["held-out", "train", "all"] | None = None,
    photographs: Sequence[str] | None = None,
    camera_path: BaseModel | Mapping[str, Any] | str | None = None,
    camera: Sequence[float] | None = None,
    look_at: Sequence[float] | None = None,
    distance: float | None = None,
    elevation_degrees: float | None = None,
    frames: int | None = None,
    seconds: float | None = None,
    fps: float | None = None,
    width_px: int | None = None,
    height_px: int | None = None,
    fov_y_degrees: float | None = None,
    up: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None,
    max_side: int | None = None,
    format: Literal["mp4", "png", "exr"] | None = None,
    dataset: PathLike | None = None,
    path_file: PathLike | None = None,
    resume: bool = False,
    or_anew: bool = False,
    frames_folder: PathLike | None = None,
    background: Literal["black", "white", "transparent"] | None = None,
    stage: BaseModel | Mapping[str, Any] | str | None = None,
    preview: bool = False,
    layers: bool = False,
    denoise: bool = False,
    stage_file: PathLike | None = None,
    stage_folder: PathLike | None = None,
    progress: Listener | None = None,
    should_stop: Callable[[], bool] = never,
    threads: int = 0,
) -> "RenderResult":
    """Render new views of a scene as images or a video.

    Args:
        source: The scene to render: the folder of a run, or a file of any format.
        output: A folder, a pattern such as frames/%04d.png (or .exr), or a video such as turn.mp4.
        mode: The cameras: one turn round the scene, the views of the photographs, a camera path, or a
            single camera.
        views: Render the views of the photographs: those held out, those trained on, or all. Only of a
            run. Default: held-out.
        photographs: Render the views of the photographs with these names. Only of a run.
        camera_path: The cameras of a path, as docs/cameras.md describes its file: an object, or the
            text of the file.
        camera: Render one image with a camera at this position, which looks at the middle of the scene
            or at another point that is given.
        look_at: Turntable, single camera: the point that is looked at. [default: the middle of the
            scene]
        distance: Turntable: distance of the camera from the point that is looked at, in scene units.
            [default: as photographed, or what fits]
        elevation_degrees: Turntable: elevation of the camera above the point that is looked at, in
            degrees. [default: as photographed, or 20]
        frames: Turntable: number of images of one turn. Default: 120.
        seconds: Turntable: duration of one turn in seconds, instead of a number of images.
        fps: Images per second of a video. [default: that of the camera path, or 30]
        width_px: Turntable, single camera: width of the images in pixels. Default: 640.
        height_px: Turntable, single camera: height of the images in pixels. Default: 480.
        fov_y_degrees: Turntable, single camera: field of view from the top of the image to its bottom,
            in degrees. [default: that of the photographs, or 50]
        up: The axis of the world that points up. [default: that of the run, of a file -y]
        max_side: Views of the photographs: longer side of the images in pixels. [default: that of the
            run]
        format: A video (mp4), or images: PNG, or EXR with linear values.
        dataset: Take the cameras of the photographs in this folder. [default: those that the run keeps]
        path_file: Render the cameras of a JSON file; docs/cameras.md tells its format.
        resume: Go on with a render that was stopped, if there is one.
        or_anew: Begin anew where the images that are there are of another render.
        frames_folder: Where a video keeps its frames until it is whole. [default: beside it]
        background: Behind the scene; transparent gives images alpha. [default: that of the run's
            evaluation, or black]
        stage: Meshes, lights and materials that the scene is rendered with, as docs/light.md describes:
            an object, or the text of a stage file. The files that it names are those of the job's
            files_id.
        preview: Stage: render the first image only, to one file, finer and finer.
        layers: Stage: write EXR files with background, shadow and things, for a compositor.
        denoise: Stage: remove the noise of the light from the images; needs the extra denoise.
        stage_file: Render with the meshes, lights and materials of a stage, which docs/light.md
            describes.
        stage_folder: Where the names of the stage's files are relative to. [default: the folder of the
            stage file]
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``Cancelled``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> osp.render("run", "views/", views="all").images
    9
    >>> place = {"camera": (0, 0, -4), "look_at": (0, 0, 0)}
    >>> osp.render("scene.ply", "one.png", **place, width_px=64, height_px=48).images
    1
    """
    return run_operation(
        "render",
        {
            "mode": mode,
            "views": views,
            "photographs": photographs,
            "camera_path": camera_path,
            "camera": camera,
            "look_at": look_at,
            "distance": distance,
            "elevation_degrees": elevation_degrees,
            "frames": frames,
            "seconds": seconds,
            "fps": fps,
            "width_px": width_px,
            "height_px": height_px,
            "fov_y_degrees": fov_y_degrees,
            "up": up,
            "max_side": max_side,
            "format": format,
            "source": source,
            "output": output,
            "dataset": dataset,
            "path_file": path_file,
            "resume": resume,
            "or_anew": or_anew,
            "frames_folder": frames_folder,
            "background": background,
            "stage": stage,
            "preview": preview,
            "layers": layers,
            "denoise": denoise,
            "stage_file": stage_file,
            "stage_folder": stage_folder,
        },
        progress,
        should_stop,
        threads,
    )


def relight(
    source: PathLike,
    output: PathLike,
    *,
    mode: Literal["turntable", "views", "path", "camera"] | None = None,
    views: Literal["held-out", "train", "all"] | None = None,
    photographs: Sequence[str] | None = None,
    camera_path: BaseModel | Mapping[str, Any] | str | None = None,
    camera: Sequence[float] | None = None,
    look_at: Sequence[float] | None = None,
    distance: float | None = None,
    elevation_degrees: float | None = None,
    frames: int | None = None,
    seconds: float | None = None,
    fps: float | None = None,
    width_px: int | None = None,
    height_px: int | None = None,
    fov_y_degrees: float | None = None,
    up: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None,
    max_side: int | None = None,
    format: Literal["mp4", "png", "exr"] | None = None,
    dataset: PathLike | None = None,
    path_file: PathLike | None = None,
    resume: bool = False,
    or_anew: bool = False,
    frames_folder: PathLike | None = None,
    environments: Sequence[PathLike],
    by: Literal["split-sum", "path"] | None = None,
    samples: int | None = None,
    depth: int | None = None,
    rotation_degrees: float | None = None,
    clamp: float | None = None,
    spin: bool = False,
    background: Literal["black", "white", "transparent", "environment"] | None = None,
    on: PathLike | None = None,
    progress: Listener | None = None,
    should_stop: Callable[[], bool] = never,
    threads: int = 0,
) -> "RelightResult":
    """Show a scene with materials in other light.

    Args:
        source: The scene to render: the folder of a run, or a file of any format.
        output: A folder, a pattern such as frames/%04d.png (or .exr), or a video such as turn.mp4.
        mode: The cameras: one turn round the scene, the views of the photographs, a camera path, or a
            single camera.
        views: Render the views of the photographs: those held out, those trained on, or all. Only of a
            run. Default: held-out.
        photographs: Render the views of the photographs with these names. Only of a run.
        camera_path: The cameras of a path, as docs/cameras.md describes its file: an object, or the
            text of the file.
        camera: Render one image with a camera at this position, which looks at the middle of the scene
            or at another point that is given.
        look_at: Turntable, single camera: the point that is looked at. [default: the middle of the
            scene]
        distance: Turntable: distance of the camera from the point that is looked at, in scene units.
            [default: as photographed, or what fits]
        elevation_degrees: Turntable: elevation of the camera above the point that is looked at, in
            degrees. [default: as photographed, or 20]
        frames: Turntable: number of images of one turn. Default: 120.
        seconds: Turntable: duration of one turn in seconds, instead of a number of images.
        fps: Images per second of a video. [default: that of the camera path, or 30]
        width_px: Turntable, single camera: width of the images in pixels. Default: 640.
        height_px: Turntable, single camera: height of the images in pixels. Default: 480.
        fov_y_degrees: Turntable, single camera: field of view from the top of the image to its bottom,
            in degrees. [default: that of the photographs, or 50]
        up: The axis of the world that points up. [default: that of the run, of a file -y]
        max_side: Views of the photographs: longer side of the images in pixels. [default: that of the
            run]
        format: A video (mp4), or images: PNG, or EXR with linear values.
        dataset: Take the cameras of the photographs in this folder. [default: those that the run keeps]
        path_file: Render the cameras of a JSON file; docs/cameras.md tells its format.
        resume: Go on with a render that was stopped, if there is one.
        or_anew: Begin anew where the images that are there are of another render.
        frames_folder: Where a video keeps its frames until it is whole. [default: beside it]
        environments: Equirectangular HDR or EXR image of the light; several are done one after another.
        by: Method: split-sum is fast, as in training, with traced visibility; path is right, by paths
            of light. Default: split-sum.
        samples: Rays or paths per pixel. [default: 4 rays of split-sum, 64 paths]
        depth: Most surfaces that a path of light meets. Default: 6.
        rotation_degrees: Turn the light about the vertical by this angle in degrees. Default: 0.0.
        clamp: Cut the light of the environments off at this radiance: fewer bright specks by paths, and
            weaker lamps.
        spin: Turn the light once round from the first image to the last.
        background: Behind the scene; transparent gives images alpha. [default: that of the run's
            evaluation, or black]
        on: Render the views of the photographs of another folder (images/ and sparse/0).
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``Cancelled``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> osp.relight(
    ...     "shiny.ply", "relit/", environments=["studio.hdr"], frames=2, width_px=32, height_px=24
    ... ).images
    2
    """
    return run_operation(
        "relight",
        {
            "mode": mode,
            "views": views,
            "photographs": photographs,
            "camera_path": camera_path,
            "camera": camera,
            "look_at": look_at,
            "distance": distance,
            "elevation_degrees": elevation_degrees,
            "frames": frames,
            "seconds": seconds,
            "fps": fps,
            "width_px": width_px,
            "height_px": height_px,
            "fov_y_degrees": fov_y_degrees,
            "up": up,
            "max_side": max_side,
            "format": format,
            "source": source,
            "output": output,
            "dataset": dataset,
            "path_file": path_file,
            "resume": resume,
            "or_anew": or_anew,
            "frames_folder": frames_folder,
            "environments": environments,
            "by": by,
            "samples": samples,
            "depth": depth,
            "rotation_degrees": rotation_degrees,
            "clamp": clamp,
            "spin": spin,
            "background": background,
            "on": on,
        },
        progress,
        should_stop,
        threads,
    )


def stage_init(
    source: PathLike,
    output: PathLike,
    *,
    up: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None,
    dataset: PathLike | None = None,
    progress: Listener | None = None,
    should_stop: Callable[[], bool] = never,
    threads: int = 0,
) -> "StageInitResult":
    """Write a commented stage that fits a scene.

    Args:
        source: The scene: the folder of a run, or a file of any format.
        output: The TOML file to write.
        up: The axis of a file that points up; a run knows its own. [default: -y]
        dataset: Take the cameras of the photographs in this folder. [default: those that the run keeps]
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``Cancelled``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> osp.stage_init("scene.ply", "stage.toml").files[0].name
    'stage.toml'
    """
    return run_operation(
        "stage-init",
        {"up": up, "source": source, "output": output, "dataset": dataset},
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
