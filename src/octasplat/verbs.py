"""The verbs of octasplat on files: a function for each, with the options of its command.

Written by tests/api/write_verbs.py from the requests of :mod:`octasplat.engine.operations`.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypedDict

from pydantic import BaseModel

from octasplat.array_types import Matrix, Numbers
from octasplat.engine.core.events import EventListener
from octasplat.engine.operations.base import never_stop
from octasplat.operation_calls import names_checked, run_operation
from octasplat.paths import PathLike
from octasplat.runs import OnStep, Run, reconstruct_run

if TYPE_CHECKING:
    from octasplat.engine.operations.clean import CleanResult
    from octasplat.engine.operations.crop import CropResult
    from octasplat.engine.operations.deform import DeformResult
    from octasplat.engine.operations.edit import EditResult
    from octasplat.engine.operations.estimate import EstimateResult
    from octasplat.engine.operations.evaluate import EvaluateResult
    from octasplat.engine.operations.export import ExportResult
    from octasplat.engine.operations.import_ import ImportResult
    from octasplat.engine.operations.info import InfoResult
    from octasplat.engine.operations.material import MaterialResult
    from octasplat.engine.operations.merge import MergeResult
    from octasplat.engine.operations.plan import PlanResult
    from octasplat.engine.operations.relight import RelightResult
    from octasplat.engine.operations.render import RenderResult
    from octasplat.engine.operations.simplify import SimplifyResult
    from octasplat.engine.operations.stage_init import StageInitResult
    from octasplat.engine.operations.surface import SurfaceResult
    from octasplat.engine.operations.transform import TransformResult


class RenderArguments(TypedDict, total=False):
    """What :func:`render` takes by name."""

    overwrite: bool
    mode: Literal["turntable", "views", "path", "camera"] | None
    views: Literal["held-out", "train", "all"] | None
    photographs: Sequence[str] | None
    camera_path: BaseModel | Mapping[str, Any] | str | None
    camera: Numbers | None
    look_at: Numbers | None
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
    shading: Literal["materials", "harmonics"] | None
    preview: bool
    layers: bool
    denoise: bool
    stage_file: PathLike | None
    stage_folder: PathLike | None
    progress: EventListener | None
    should_stop: Callable[[], bool]
    threads: int


@names_checked
def reconstruct(
    source: PathLike,
    output: PathLike,
    *,
    blocks: int | Literal["auto"] | None = None,
    memory: str | None = None,
    preset: Literal["fast", "standard", "high", "redisplats"] | None = None,
    max_side: int | None = None,
    test_every: int | None = None,
    held_out: Sequence[str] | None = None,
    split: Literal["given", "every"] | None = None,
    burst_length: int | None = None,
    poses: Literal["given", "auto", "missing"] | None = None,
    model: str | None = None,
    masks: Literal["ignore", "alpha"] | None = None,
    depth_unit: float | None = None,
    evaluation_background: Literal["black", "white"] | None = None,
    georeference: Literal["auto", "gps", "off"] | None = None,
    control_points: str | None = None,
    known_length: str | None = None,
    region: Numbers | None = None,
    minutes: float | None = None,
    exports: Sequence[str] | None = None,
    materials: bool = False,
    for_surface: bool = False,
    iterations: int | None = None,
    rays_per_batch: int | None = None,
    max_gaussians: int | None = None,
    sh_degree: int | None = None,
    seed: int | None = None,
    train: Mapping[str, Any] | None = None,
    set: Sequence[str] | Mapping[str, Any] | str | None = None,
    fps: float | None = None,
    start_from: PathLike | None = None,
    resume: bool = False,
    on_step: OnStep | None = None,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "Run":
    """Photographs to a scene, its meshes, and measurements.

    Args:
        source: The folder of the photographs, or a video.
        output: Folder for the results.
        blocks: Train the scene in so many blocks, one after the other or, as a job of a service, on all
            workers at once; auto takes the fewest that the number of photographs and the memory ask
            for, which is 1 for most scenes.
        memory: With blocks: about the most memory that the training of one takes, such as 8G; blocks
            have no more Gaussians than that holds.
        preset: Where the settings of the training come from. fast: a first look, the fastest and less
            sharp than standard; standard: the usual choice, sharp enough for most uses; high: for a
            final result: a little sharper than standard where photographs are many and sharp, slower
            and with more Gaussians; redisplats: the settings that the paper REdiSplats published, to
            compare with it, for a scene of your own, standard is better. Default: standard.
        max_side: Longest side to which photographs are shrunk; by default they keep their size. Set it
            for a quick try, or where memory is short.
        test_every: Every N-th view by name is held out to be measured; 0 holds out none, so that all
            are trained on. Default: 8.
        held_out: Names of the views to hold out instead of every N-th.
        split: Which views are held out where the scene says so itself (transforms_test.json): given
            follows it, every takes every N-th view all the same. Default: given.
        burst_length: So many views that follow each other by name, as frames of a video or shots of a
            burst, count as one where views are held out, so that none is measured by its neighbour.
            Photographs that are there twice always do. Default: 1.
        poses: Where the poses of the cameras come from: given takes the COLMAP model of the dataset
            (photographs far from where matches put them are moved, see repair_poses); auto finds the
            poses, by COLMAP's features, matching and mapping; missing does so only where the dataset
            holds no model. Default: missing.
        model: Which of several models of the dataset gives the poses: its folder or its number, e.g.
            sparse/1, or transforms.json; by default the COLMAP model of most photographs. Of models
            that a search for poses finds: poses/1, or with the run that has found it, OUT/poses/1.
        masks: What masks mean: ignore leaves masked pixels out of the loss, alpha takes the mask as the
            alpha, for objects that are cut out. Default: ignore.
        depth_unit: World units for one unit of the values of depth maps (depths/); by default the
            sparse points decide, or metres where there are too few (0.001 for integers).
        evaluation_background: What lies behind renders and photographs with alpha when they are
            compared; by default that of the training: white where background is white, else black.
        georeference: What says where the scene lies, how large it is, and what is up: auto takes
            control points, else the GPS positions in the photographs where they agree with the scene;
            gps refuses the photographs where these do not; off looks for nothing, so that no file says
            where the photographs were taken. Default: auto.
        control_points: A file of ground control points in the folder of the photographs: gcp_list.txt
            as OpenDroneMap has it, or a CSV with name,x,y,z,photograph,px,py; by default gcp_list.txt
            or control_points.csv where there is one.
        known_length: Two points and the metres between them, which decide the scale; a point is a
            control point, a photograph, the number of a sparse point, or x,y,z.
        region: Two corners of a box to train in detail, smallest coordinates first, in the coordinates
            of the COLMAP model; what lies around stays coarse. By default all of the scene is trained
            alike.
        minutes: Time in which the training is to end, which decides its iterations and Gaussians by the
            pace of the machine that begins it; by default the other settings do.
        exports: Files to write besides scene.ply; their names say the format. Default: ('viewer.glb',
            'surface.glb', 'octagons.ply', 'octagons.obj', 'octagons.glb').
        materials: Learn materials and the environment of shiny things; environment.hdr lies beside the
            scene then.
        for_surface: Hold normals and depths together, so that a surface made of the scene is smoother.
        iterations: Iterations of the training; 0 asks the photographs' pixels.
        rays_per_batch: Rays of one iteration.
        max_gaussians: Most Gaussians; 0, the default, asks the photographs' pixels.
        sh_degree: Degree of the spherical harmonics of the colors, 0 to 3.
        seed: Seed of everything random. [default: 0]
        train: Settings of the training that are to be otherwise than the preset's, by names or in
            sections.
        set: Any other setting, e.g. lr.quat=0.02 or test_every=4, values as JSON; octasplat config list
            shows them.
        fps: Of a video: so many frames of each second are taken, the sharpest ones. Default: 2.0.
        start_from: Begin with the Gaussians of that run, finished or stopped, or of a file of
            Gaussians, instead of the sparse points; poses that the run found are taken, too.
        resume: Go on with the run in the output folder, if there is one; without other options its own
            settings are taken.
        on_step: called with the state of the training every few iterations; returning False stops it
            after a checkpoint, and the run that is returned is unfinished. With ``resume=True`` another
            call goes on.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> def stop_early(step):
    ...     return step.iteration < 20
    >>> small = {"preset": "fast", "iterations": 60, "max_gaussians": 300, "exports": ["mesh.ply"]}
    >>> run = osp.reconstruct("photos", "out", **small, on_step=stop_early)
    >>> run.is_finished
    False
    >>> run = osp.reconstruct("photos", "out", resume=True)
    >>> run.is_finished, run.training["iterations"]
    (True, 60)
    """
    return reconstruct_run(
        {
            "blocks": blocks,
            "memory": memory,
            "preset": preset,
            "max_side": max_side,
            "test_every": test_every,
            "held_out": held_out,
            "split": split,
            "burst_length": burst_length,
            "poses": poses,
            "model": model,
            "masks": masks,
            "depth_unit": depth_unit,
            "evaluation_background": evaluation_background,
            "georeference": georeference,
            "control_points": control_points,
            "known_length": known_length,
            "region": region,
            "minutes": minutes,
            "exports": exports,
            "materials": materials,
            "for_surface": for_surface,
            "iterations": iterations,
            "rays_per_batch": rays_per_batch,
            "max_gaussians": max_gaussians,
            "sh_degree": sh_degree,
            "seed": seed,
            "train": train,
            "set": set,
            "source": source,
            "output": output,
            "fps": fps,
            "start_from": start_from,
            "resume": resume,
        },
        on_step,
        progress,
        should_stop,
        threads,
    )


@names_checked
def estimate(
    source: PathLike,
    *,
    preset: Literal["fast", "standard", "high", "redisplats"] | None = None,
    max_side: int | None = None,
    test_every: int | None = None,
    held_out: Sequence[str] | None = None,
    split: Literal["given", "every"] | None = None,
    burst_length: int | None = None,
    poses: Literal["given", "auto", "missing"] | None = None,
    model: str | None = None,
    masks: Literal["ignore", "alpha"] | None = None,
    depth_unit: float | None = None,
    evaluation_background: Literal["black", "white"] | None = None,
    georeference: Literal["auto", "gps", "off"] | None = None,
    control_points: str | None = None,
    known_length: str | None = None,
    region: Numbers | None = None,
    minutes: float | None = None,
    exports: Sequence[str] | None = None,
    materials: bool = False,
    for_surface: bool = False,
    iterations: int | None = None,
    rays_per_batch: int | None = None,
    max_gaussians: int | None = None,
    sh_degree: int | None = None,
    seed: int | None = None,
    train: Mapping[str, Any] | None = None,
    set: Sequence[str] | Mapping[str, Any] | str | None = None,
    cores: int | None = None,
    fps: float | None = None,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "EstimateResult":
    """Estimate what a reconstruction takes, before it is begun.

    Args:
        source: The folder of the photographs, or a video, of which no frames are written.
        preset: Where the settings of the training come from. fast: a first look, the fastest and less
            sharp than standard; standard: the usual choice, sharp enough for most uses; high: for a
            final result: a little sharper than standard where photographs are many and sharp, slower
            and with more Gaussians; redisplats: the settings that the paper REdiSplats published, to
            compare with it, for a scene of your own, standard is better. Default: standard.
        max_side: Longest side to which photographs are shrunk; by default they keep their size. Set it
            for a quick try, or where memory is short.
        test_every: Every N-th view by name is held out to be measured; 0 holds out none, so that all
            are trained on. Default: 8.
        held_out: Names of the views to hold out instead of every N-th.
        split: Which views are held out where the scene says so itself (transforms_test.json): given
            follows it, every takes every N-th view all the same. Default: given.
        burst_length: So many views that follow each other by name, as frames of a video or shots of a
            burst, count as one where views are held out, so that none is measured by its neighbour.
            Photographs that are there twice always do. Default: 1.
        poses: Where the poses of the cameras come from: given takes the COLMAP model of the dataset
            (photographs far from where matches put them are moved, see repair_poses); auto finds the
            poses, by COLMAP's features, matching and mapping; missing does so only where the dataset
            holds no model. Default: missing.
        model: Which of several models of the dataset gives the poses: its folder or its number, e.g.
            sparse/1, or transforms.json; by default the COLMAP model of most photographs. Of models
            that a search for poses finds: poses/1, or with the run that has found it, OUT/poses/1.
        masks: What masks mean: ignore leaves masked pixels out of the loss, alpha takes the mask as the
            alpha, for objects that are cut out. Default: ignore.
        depth_unit: World units for one unit of the values of depth maps (depths/); by default the
            sparse points decide, or metres where there are too few (0.001 for integers).
        evaluation_background: What lies behind renders and photographs with alpha when they are
            compared; by default that of the training: white where background is white, else black.
        georeference: What says where the scene lies, how large it is, and what is up: auto takes
            control points, else the GPS positions in the photographs where they agree with the scene;
            gps refuses the photographs where these do not; off looks for nothing, so that no file says
            where the photographs were taken. Default: auto.
        control_points: A file of ground control points in the folder of the photographs: gcp_list.txt
            as OpenDroneMap has it, or a CSV with name,x,y,z,photograph,px,py; by default gcp_list.txt
            or control_points.csv where there is one.
        known_length: Two points and the metres between them, which decide the scale; a point is a
            control point, a photograph, the number of a sparse point, or x,y,z.
        region: Two corners of a box to train in detail, smallest coordinates first, in the coordinates
            of the COLMAP model; what lies around stays coarse. By default all of the scene is trained
            alike.
        minutes: Time in which the training is to end, which decides its iterations and Gaussians by the
            pace of the machine that begins it; by default the other settings do.
        exports: Files to write besides scene.ply; their names say the format. Default: ('viewer.glb',
            'surface.glb', 'octagons.ply', 'octagons.obj', 'octagons.glb').
        materials: Learn materials and the environment of shiny things; environment.hdr lies beside the
            scene then.
        for_surface: Hold normals and depths together, so that a surface made of the scene is smoother.
        iterations: Iterations of the training; 0 asks the photographs' pixels.
        rays_per_batch: Rays of one iteration.
        max_gaussians: Most Gaussians; 0, the default, asks the photographs' pixels.
        sh_degree: Degree of the spherical harmonics of the colors, 0 to 3.
        seed: Seed of everything random. [default: 0]
        train: Settings of the training that are to be otherwise than the preset's, by names or in
            sections.
        set: Any other setting, e.g. lr.quat=0.02 or test_every=4, values as JSON; octasplat config list
            shows them.
        cores: Cores of the machine to reckon with; 0 takes those of this one. Default: 0.
        fps: Of a video: so many frames of each second would be taken. Default: 2.0.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> found = osp.estimate("photos", preset="fast", cores=8)
    >>> found.cores, found.seconds > 0
    (8, True)
    """
    return run_operation(
        "estimate",
        {
            "preset": preset,
            "max_side": max_side,
            "test_every": test_every,
            "held_out": held_out,
            "split": split,
            "burst_length": burst_length,
            "poses": poses,
            "model": model,
            "masks": masks,
            "depth_unit": depth_unit,
            "evaluation_background": evaluation_background,
            "georeference": georeference,
            "control_points": control_points,
            "known_length": known_length,
            "region": region,
            "minutes": minutes,
            "exports": exports,
            "materials": materials,
            "for_surface": for_surface,
            "iterations": iterations,
            "rays_per_batch": rays_per_batch,
            "max_gaussians": max_gaussians,
            "sh_degree": sh_degree,
            "seed": seed,
            "train": train,
            "set": set,
            "cores": cores,
            "source": source,
            "fps": fps,
        },
        progress,
        should_stop,
        threads,
    )


@names_checked
def plan(
    source: PathLike,
    *,
    overwrite: bool = False,
    blocks: int | Literal["auto"] | None = None,
    memory: str | None = None,
    preset: Literal["fast", "standard", "high", "redisplats"] | None = None,
    max_side: int | None = None,
    test_every: int | None = None,
    held_out: Sequence[str] | None = None,
    split: Literal["given", "every"] | None = None,
    burst_length: int | None = None,
    poses: Literal["given", "auto", "missing"] | None = None,
    model: str | None = None,
    masks: Literal["ignore", "alpha"] | None = None,
    depth_unit: float | None = None,
    evaluation_background: Literal["black", "white"] | None = None,
    georeference: Literal["auto", "gps", "off"] | None = None,
    control_points: str | None = None,
    known_length: str | None = None,
    region: Numbers | None = None,
    minutes: float | None = None,
    exports: Sequence[str] | None = None,
    materials: bool = False,
    for_surface: bool = False,
    iterations: int | None = None,
    rays_per_batch: int | None = None,
    max_gaussians: int | None = None,
    sh_degree: int | None = None,
    seed: int | None = None,
    train: Mapping[str, Any] | None = None,
    set: Sequence[str] | Mapping[str, Any] | str | None = None,
    cores: int | None = None,
    picture: PathLike | None = None,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "PlanResult":
    """Plan the blocks of a large capture: how many, their time and memory.

    Args:
        source: The folder of the photographs and their model.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
        blocks: Train the scene in so many blocks, one after the other or, as a job of a service, on all
            workers at once; auto takes the fewest that the number of photographs and the memory ask
            for, which is 1 for most scenes.
        memory: With blocks: about the most memory that the training of one takes, such as 8G; blocks
            have no more Gaussians than that holds.
        preset: Where the settings of the training come from. fast: a first look, the fastest and less
            sharp than standard; standard: the usual choice, sharp enough for most uses; high: for a
            final result: a little sharper than standard where photographs are many and sharp, slower
            and with more Gaussians; redisplats: the settings that the paper REdiSplats published, to
            compare with it, for a scene of your own, standard is better. Default: standard.
        max_side: Longest side to which photographs are shrunk; by default they keep their size. Set it
            for a quick try, or where memory is short.
        test_every: Every N-th view by name is held out to be measured; 0 holds out none, so that all
            are trained on. Default: 8.
        held_out: Names of the views to hold out instead of every N-th.
        split: Which views are held out where the scene says so itself (transforms_test.json): given
            follows it, every takes every N-th view all the same. Default: given.
        burst_length: So many views that follow each other by name, as frames of a video or shots of a
            burst, count as one where views are held out, so that none is measured by its neighbour.
            Photographs that are there twice always do. Default: 1.
        poses: Where the poses of the cameras come from: given takes the COLMAP model of the dataset
            (photographs far from where matches put them are moved, see repair_poses); auto finds the
            poses, by COLMAP's features, matching and mapping; missing does so only where the dataset
            holds no model. Default: missing.
        model: Which of several models of the dataset gives the poses: its folder or its number, e.g.
            sparse/1, or transforms.json; by default the COLMAP model of most photographs. Of models
            that a search for poses finds: poses/1, or with the run that has found it, OUT/poses/1.
        masks: What masks mean: ignore leaves masked pixels out of the loss, alpha takes the mask as the
            alpha, for objects that are cut out. Default: ignore.
        depth_unit: World units for one unit of the values of depth maps (depths/); by default the
            sparse points decide, or metres where there are too few (0.001 for integers).
        evaluation_background: What lies behind renders and photographs with alpha when they are
            compared; by default that of the training: white where background is white, else black.
        georeference: What says where the scene lies, how large it is, and what is up: auto takes
            control points, else the GPS positions in the photographs where they agree with the scene;
            gps refuses the photographs where these do not; off looks for nothing, so that no file says
            where the photographs were taken. Default: auto.
        control_points: A file of ground control points in the folder of the photographs: gcp_list.txt
            as OpenDroneMap has it, or a CSV with name,x,y,z,photograph,px,py; by default gcp_list.txt
            or control_points.csv where there is one.
        known_length: Two points and the metres between them, which decide the scale; a point is a
            control point, a photograph, the number of a sparse point, or x,y,z.
        region: Two corners of a box to train in detail, smallest coordinates first, in the coordinates
            of the COLMAP model; what lies around stays coarse. By default all of the scene is trained
            alike.
        minutes: Time in which the training is to end, which decides its iterations and Gaussians by the
            pace of the machine that begins it; by default the other settings do.
        exports: Files to write besides scene.ply; their names say the format. Default: ('viewer.glb',
            'surface.glb', 'octagons.ply', 'octagons.obj', 'octagons.glb').
        materials: Learn materials and the environment of shiny things; environment.hdr lies beside the
            scene then.
        for_surface: Hold normals and depths together, so that a surface made of the scene is smoother.
        iterations: Iterations of the training; 0 asks the photographs' pixels.
        rays_per_batch: Rays of one iteration.
        max_gaussians: Most Gaussians; 0, the default, asks the photographs' pixels.
        sh_degree: Degree of the spherical harmonics of the colors, 0 to 3.
        seed: Seed of everything random. [default: 0]
        train: Settings of the training that are to be otherwise than the preset's, by names or in
            sections.
        set: Any other setting, e.g. lr.quat=0.02 or test_every=4, values as JSON; octasplat config list
            shows them.
        cores: Cores of the machine to reckon with; 0 takes those of this one. Default: 0.
        picture: Write a map of the points from above, a color a block, and of the cameras, in black.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> found = osp.plan("photos", blocks=2)
    >>> len(found.blocks), found.seconds > 0
    (2, True)
    """
    return run_operation(
        "plan",
        {
            "overwrite": overwrite,
            "blocks": blocks,
            "memory": memory,
            "preset": preset,
            "max_side": max_side,
            "test_every": test_every,
            "held_out": held_out,
            "split": split,
            "burst_length": burst_length,
            "poses": poses,
            "model": model,
            "masks": masks,
            "depth_unit": depth_unit,
            "evaluation_background": evaluation_background,
            "georeference": georeference,
            "control_points": control_points,
            "known_length": known_length,
            "region": region,
            "minutes": minutes,
            "exports": exports,
            "materials": materials,
            "for_surface": for_surface,
            "iterations": iterations,
            "rays_per_batch": rays_per_batch,
            "max_gaussians": max_gaussians,
            "sh_degree": sh_degree,
            "seed": seed,
            "train": train,
            "set": set,
            "cores": cores,
            "source": source,
            "picture": picture,
        },
        progress,
        should_stop,
        threads,
    )


@names_checked
def evaluate(
    source: PathLike,
    *,
    all_views: bool = False,
    scales: Sequence[int] | str | None = None,
    evaluation_background: Literal["black", "white"] | None = None,
    dataset: PathLike | None = None,
    other_dataset: PathLike | None = None,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "EvaluateResult":
    """Measure a finished run again.

    Args:
        source: The folder of a finished run.
        all_views: Measure all photographs, not only those that were held out, into on/<name of their
            folder>; so it is with photographs of another dataset, which a job names as 'dataset_id'.
        scales: Measure smaller sizes instead, such as 2,4,8: renders at 1/2, 1/4 and 1/8 of the size
            against photographs made as small, with 1, 4 and 16 rays per pixel; into scales.json.
        evaluation_background: Color behind the scene and behind what masks leave out. [default: the
            run's]
        dataset: Where the run's photographs are now, if they were moved or the run was downloaded.
        other_dataset: Measure all photographs of another folder instead (images/ and sparse/0 in the
            same world as the run's); the results go to OUT/on/<its name>.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
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
            "evaluation_background": evaluation_background,
            "source": source,
            "dataset": dataset,
            "other_dataset": other_dataset,
        },
        progress,
        should_stop,
        threads,
    )


@names_checked
def info(
    source: PathLike,
    output: PathLike | None = None,
    *,
    overwrite: bool = False,
    up: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None,
    dataset: PathLike | None = None,
    rays: bool = False,
    picture: PathLike | None = None,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "InfoResult":
    """Describe what is in a scene: counts, bounds, sizes, cost.

    Args:
        source: The scene to look at: the folder of a run, or a file of any format.
        output: Write everything as JSON, too.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
        up: The axis of a file that points up. [default: -y]
        dataset: Take the cameras of the photographs in this folder. [default: those the run keeps]
        rays: Trace a small picture, too, which tells how many Gaussians a ray meets; the first time
            this compiles the tracer. --picture does so as well.
        picture: Write a small picture of the scene, too.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> osp.info("scene.ply").scene.count
    1200
    """
    return run_operation(
        "info",
        {
            "overwrite": overwrite,
            "up": up,
            "source": source,
            "dataset": dataset,
            "rays": rays,
            "picture": picture,
            "output": output,
        },
        progress,
        should_stop,
        threads,
    )


@names_checked
def surface(
    source: PathLike,
    output: PathLike,
    *,
    overwrite: bool = False,
    unbounded: bool | None = None,
    box: Numbers | None = None,
    voxel: float | None = None,
    resolution: int | None = None,
    truncation: float | None = None,
    depth_trunc: float | None = None,
    depth_mode: Literal["median", "expected"] | None = None,
    depth_side: int | None = None,
    min_alpha: float | None = None,
    min_weight: float | None = None,
    unseen: Literal["open", "solid"] | None = None,
    backdrop: bool | None = None,
    refine_vertices: bool | None = None,
    keep_components: int | None = None,
    min_component: float | None = None,
    fill_holes: Literal["all"] | float | None = None,
    fit: bool = True,
    texture_size: int | None = None,
    max_memory_gb: float | None = None,
    room: bool = False,
    max_triangles: Sequence[str] | str | int | Sequence[str | int] | None = None,
    materials: bool = False,
    up: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None,
    dataset: PathLike | None = None,
    photographs: PathLike | None = None,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "SurfaceResult":
    """One colored triangle mesh of a scene.

    Args:
        source: The scene to mesh: the folder of a run, or a file of any format.
        output: A .glb, .ply, .obj or .usdz file.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
        unbounded: Reach to the horizon, with ever coarser voxels, instead of meshing a box.
        box: Two corners of the box to mesh, smallest coordinates first; octasplat info tells where the
            scene lies. [default: what is seen of the space that the cameras surround]
        voxel: Side of a voxel, in scene units, at the centre where unbounded. [default: as resolution
            says]
        resolution: Voxels along the longest side of the box. [default: 512, or fewer where a voxel
            would be smaller than one and a half pixels of the depth maps]
        truncation: Half width of the band around the surface in which distances are kept. [default: 3%
            of the cameras' distance, about what trained depths are off by, and at least 4]
        depth_trunc: Ignore depths beyond this, in scene units. [default: none]
        depth_mode: Which depth is fused: the median, where half of the light is gone, or the expected
            one. Default: median.
        depth_side: Longer side of the depth maps. Default: 640.
        min_alpha: Pixels that the scene covers less than this have no depth. Default: 0.5.
        min_weight: Least evidence for a voxel; a view that looks straight onto the surface gives 1.
            Default: 0.5.
        unseen: Space near the surface that no view saw: open leaves holes there, solid closes the mesh.
            Default: open.
        backdrop: A sphere around everything that shows what the scene shows in the gaps of the mesh.
        refine_vertices: Move vertices along their normals to where the pictures agree, before colors.
        keep_components: Keep so many connected parts only, largest first. [default: by min_component]
        min_component: Remove parts of less than this share of the largest part's area. Default: 0.01.
        fill_holes: Close holes whose rim is no longer than so many voxels; or 'all'. Default: 0.0.
        fit: Of all colors, take those with which the mesh looks as like the pictures as it can.
        texture_size: Colors in a square texture of this side instead of in the vertices; .glb, .obj and
            .usdz.
        max_memory_gb: Refuse a volume that takes more memory than this. Default: 4.0.
        room: What pictures of a room need, where nothing else is said: unbounded (not with a box),
            unseen solid, backdrop, refine_vertices, and finer voxels than a box has.
        max_triangles: Decimate to so many triangles, such as 60000 or 60k; 5k,50k,500k writes a file
            each, NAME_5k.glb. [default: all]
        materials: Base color, metallic, roughness and normals in textures, to be lit; .glb or .usdz.
            Takes 60,000 triangles and a texture of 1,024 pixels where nothing else is said.
        up: With materials: the axis that points up. [default: the run's, of a file -y]
        dataset: Take the cameras of the photographs in this folder, and of a run the colors. [default:
            the cameras that a run keeps; else none]
        photographs: A copy of the photographs that the run was made from, for colors alone; left out if
            it has other poses.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
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
            "overwrite": overwrite,
            "unbounded": unbounded,
            "box": box,
            "voxel": voxel,
            "resolution": resolution,
            "truncation": truncation,
            "depth_trunc": depth_trunc,
            "depth_mode": depth_mode,
            "depth_side": depth_side,
            "min_alpha": min_alpha,
            "min_weight": min_weight,
            "unseen": unseen,
            "backdrop": backdrop,
            "refine_vertices": refine_vertices,
            "keep_components": keep_components,
            "min_component": min_component,
            "fill_holes": fill_holes,
            "fit": fit,
            "texture_size": texture_size,
            "max_memory_gb": max_memory_gb,
            "room": room,
            "max_triangles": max_triangles,
            "materials": materials,
            "up": up,
            "source": source,
            "output": output,
            "dataset": dataset,
            "photographs": photographs,
        },
        progress,
        should_stop,
        threads,
    )


@names_checked
def material(
    source: PathLike,
    output: PathLike,
    *,
    overwrite: bool = False,
    set: BaseModel | Mapping[str, Any] | str | None = None,
    multiply: BaseModel | Mapping[str, Any] | str | None = None,
    where: str | None = None,
    box: Numbers | None = None,
    sphere: Numbers | None = None,
    inverse: bool = False,
    mesh: PathLike | None = None,
    masks: Sequence[PathLike] | PathLike | None = None,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "MaterialResult":
    """Change the materials of a scene.

    Args:
        source: The scene to read: a file of any format, or the folder of a run.
        output: A folder for all of the run with its new scene, or a file for the scene alone.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
        set: Values to set: albedo=R,G,B (linear, 0 to 1), albedo=#rrggbb (display), metallic=0..1 or
            roughness=0..1.
        multiply: Factors to multiply albedo, metallic or roughness by; the result is at most 1.
        where: Comparisons joined by and, or, not that hold for them, of x, y, z, opacity and channels
            such as metallic, roughness and albedo.r: 'metallic > 0.5 and z < 0'.
        box: Two corners of a box that their centres lie in, smallest coordinates first.
        sphere: Centre and radius of a sphere that their centres lie in.
        inverse: Take the other Gaussians instead.
        mesh: Those whose octagons are in this mesh: IN's octagons.ply after the rest was deleted in an
            editor.
        masks: Those that show where this image is white; it has the name of one of the run's
            photographs. Several say together what is meant.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
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
            "overwrite": overwrite,
            "source": source,
            "output": output,
            "set": set,
            "multiply": multiply,
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


@names_checked
def render(
    source: PathLike,
    output: PathLike,
    *,
    overwrite: bool = False,
    mode: Literal["turntable", "views", "path", "camera"] | None = None,
    views: Literal["held-out", "train", "all"] | None = None,
    photographs: Sequence[str] | None = None,
    camera_path: BaseModel | Mapping[str, Any] | str | None = None,
    camera: Numbers | None = None,
    look_at: Numbers | None = None,
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
    shading: Literal["materials", "harmonics"] | None = None,
    preview: bool = False,
    layers: bool = False,
    denoise: bool = False,
    stage_file: PathLike | None = None,
    stage_folder: PathLike | None = None,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "RenderResult":
    """Render new views of a scene as images or a video.

    Args:
        source: The scene to render: the folder of a run, or a file of any format.
        output: A folder, a pattern such as frames/%04d.png (or .exr), or a video such as turn.mp4.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
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
        up: The axis of a file that points up; the photographs of a run say so themselves. [default: -y]
        max_side: Views of the photographs: longer side of the images in pixels. [default: that of the
            run]
        format: A video (mp4), or images: PNG, or EXR with linear values.
        dataset: Take the cameras of the photographs in this folder. [default: those that the run keeps]
        path_file: Render the cameras of a JSON file; docs/cameras.md tells its format.
        resume: Go on with a render that was stopped, if there is one.
        or_anew: Begin anew where the images that are there are of another render.
        frames_folder: Where a video keeps its frames until it is whole. [default: beside it]
        background: Behind the scene; transparent gives images alpha. [default: what the run has learnt,
            or that of its evaluation; of a file black]
        stage: Meshes, lights and materials that the scene is rendered with, as docs/light.md describes:
            an object, or the text of a stage file. The files that it names are those of the job's
            files_id.
        shading: Colors of the Gaussians: their materials in the light that the run has learnt, or their
            harmonics, which are faster and show no sharp reflections. [default: materials, of a run
            that has them]
        preview: Stage: render the first image only, to one file, finer and finer.
        layers: Stage: write EXR files with background, shadow and things, for a compositor.
        denoise: Stage: remove the noise of the light from the images; needs the extra denoise.
        stage_file: Render with the meshes, lights and materials of a stage, which docs/light.md
            describes.
        stage_folder: Where the names of the stage's files are relative to. [default: the folder of the
            stage file]
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
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
            "overwrite": overwrite,
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
            "shading": shading,
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


@names_checked
def relight(
    source: PathLike,
    output: PathLike,
    *,
    environments: Sequence[PathLike] | PathLike,
    overwrite: bool = False,
    mode: Literal["turntable", "views", "path", "camera"] | None = None,
    views: Literal["held-out", "train", "all"] | None = None,
    photographs: Sequence[str] | None = None,
    camera_path: BaseModel | Mapping[str, Any] | str | None = None,
    camera: Numbers | None = None,
    look_at: Numbers | None = None,
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
    integrator: Literal["split-sum", "path"] | None = None,
    samples: int | None = None,
    max_bounces: int | None = None,
    rotation_degrees: float | None = None,
    clamp: float | None = None,
    spin: bool = False,
    background: Literal["black", "white", "transparent", "environment"] | None = None,
    other_dataset: PathLike | None = None,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "RelightResult":
    """Show a scene with materials in other light.

    Args:
        source: The scene to render: the folder of a run, or a file of any format.
        output: A folder, a pattern such as frames/%04d.png (or .exr), or a video such as turn.mp4.
        environments: Equirectangular HDR or EXR image of the light; several are done one after another.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
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
        up: The axis of the world that points up, for the light and in a file for the cameras. [default:
            that of the run, of a file -y]
        max_side: Views of the photographs: longer side of the images in pixels. [default: that of the
            run]
        format: A video (mp4), or images: PNG, or EXR with linear values.
        dataset: Take the cameras of the photographs in this folder. [default: those that the run keeps]
        path_file: Render the cameras of a JSON file; docs/cameras.md tells its format.
        resume: Go on with a render that was stopped, if there is one.
        or_anew: Begin anew where the images that are there are of another render.
        frames_folder: Where a video keeps its frames until it is whole. [default: beside it]
        integrator: Method: split-sum is fast, as in training, with traced visibility; path is right, by
            paths of light. Default: split-sum.
        samples: Rays or paths per pixel. [default: 4 rays of split-sum, 64 paths]
        max_bounces: Path: most surfaces that a path of light meets. Default: 6.
        rotation_degrees: Turn the light about the vertical by this angle in degrees. Default: 0.0.
        clamp: Cut the light of the environments off at this radiance: fewer bright specks by paths, and
            weaker lamps.
        spin: Turn the light once round from the first image to the last.
        background: Behind the scene; transparent gives images alpha. [default: that of the run's
            evaluation, or black]
        other_dataset: Render the views of the photographs of another folder (images/ and sparse/0).
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
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
            "overwrite": overwrite,
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
            "integrator": integrator,
            "samples": samples,
            "max_bounces": max_bounces,
            "rotation_degrees": rotation_degrees,
            "clamp": clamp,
            "spin": spin,
            "background": background,
            "other_dataset": other_dataset,
        },
        progress,
        should_stop,
        threads,
    )


@names_checked
def stage_init(
    source: PathLike,
    output: PathLike,
    *,
    overwrite: bool = False,
    up: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None,
    dataset: PathLike | None = None,
    copy_light: bool = False,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "StageInitResult":
    """Write a commented stage that fits a scene.

    Args:
        source: The scene: the folder of a run, or a file of any format.
        output: The TOML file to write.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
        up: The axis of a file that points up; a run knows its own. [default: -y]
        dataset: Take the cameras of the photographs in this folder. [default: those that the run keeps]
        copy_light: Put the map of light that the stage names beside it, so that both can be moved.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> osp.stage_init("scene.ply", "stage.toml").files[0].name
    'stage.toml'
    """
    return run_operation(
        "stage-init",
        {
            "overwrite": overwrite,
            "up": up,
            "source": source,
            "output": output,
            "dataset": dataset,
            "copy_light": copy_light,
        },
        progress,
        should_stop,
        threads,
    )


@names_checked
def export(
    source: PathLike,
    files: Sequence[PathLike] | PathLike,
    *,
    overwrite: bool = False,
    min_opacity: float | None = None,
    sh_pad_degree: int | None = None,
    spz_version: Literal[3, 4] | None = None,
    opaque: bool = False,
    chunks: int | None = None,
    falloff_texture_size: int | None = None,
    ids: bool = True,
    q: float | None = None,
    color: Literal["cameras", "constant"] | Numbers | str | None = None,
    for_viewers: bool = False,
    extent: Literal["photographed", "all"] | None = None,
    materials: bool = False,
    up: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None,
    format: str | None = None,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "ExportResult":
    """Gaussians to meshes and other formats.

    Args:
        source: The scene to read: a file of any format, or the folder of a run.
        files: Files to write; their names say the formats.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
        min_opacity: Leave fainter Gaussians out. Default: 0.0.
        sh_pad_degree: Gaussian PLY: pad the spherical harmonics with zeros up to this degree.
        spz_version: SPZ: 3 (gzip), which every viewer reads, or 4 (Zstandard). Default: 3.
        opaque: GLB: cut alpha at a threshold instead of blending, for programs that cannot sort.
        chunks: GLB: most spatial chunks, which programs sort by distance; rounded down to a power of
            two. Default: 64.
        falloff_texture_size: GLB, OBJ: side of the texture that holds the fall-off. Default: 128.
        ids: GLB: write the numbers by which edits find back to their Gaussians.
        q: Meshes: squared radius of the octagons in standard deviations. [default: that of the run, of
            a file 9.21]
        color: Formats with one color for each Gaussian: the one that loses least seen from the
            photographs' places of a run, or from all around a file; the harmonics' constant part; or
            the one seen along a direction. [default: cameras for a run, constant for a file]
        for_viewers: GLB: for programs that sort chunks at best, as viewer.glb is: solid middles
            beneath, and in a run whose photographs were taken from one side, the order that is right
            from most of them. Carries no numbers for edits.
        extent: GLB for viewers: how much of a run is written, what lies in the space that the cameras
            surround, which viewers then frame, or all of it, with what is far behind. Default:
            photographed.
        materials: GLB: base color, metallic and roughness instead of colors that have their light in
            them.
        up: With materials: the axis that points up. [default: the run's, of a file -y]
        format: The format, if OUT's name does not say it.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> [path.name for path in osp.export("run", ["scene.glb", "scene.splat"]).files]
    ['scene.glb', 'scene.splat']
    """
    return run_operation(
        "export",
        {
            "overwrite": overwrite,
            "source": source,
            "min_opacity": min_opacity,
            "sh_pad_degree": sh_pad_degree,
            "spz_version": spz_version,
            "opaque": opaque,
            "chunks": chunks,
            "falloff_texture_size": falloff_texture_size,
            "ids": ids,
            "q": q,
            "color": color,
            "for_viewers": for_viewers,
            "extent": extent,
            "materials": materials,
            "up": up,
            "files": files,
            "format": format,
        },
        progress,
        should_stop,
        threads,
    )


@names_checked
def import_(
    source: PathLike,
    output: PathLike,
    *,
    overwrite: bool = False,
    format: str | None = None,
    drop_invalid: bool = False,
    sh_degree: int | None = None,
    channels: Literal["own", "all"] | Sequence[str] | str | None = None,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "ImportResult":
    """Splats of any format to a scene of flat Gaussians.

    Args:
        source: The scene to read, a file of any known format.
        output: The scene to write.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
        format: The format, if the file does not show it.
        drop_invalid: Leave out Gaussians with values that are not finite numbers.
        sh_degree: Keep the spherical harmonics up to this degree only.
        channels: Further numbers of each Gaussian to keep, as albedo,metallic; all for whatever is
            there; own for those that octasplat wrote. Default: own.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> splats = osp.save(osp.load("scene.ply"), "foreign.splat")
    >>> osp.import_(splats, "imported.ply").files[0].name
    'imported.ply'
    """
    return run_operation(
        "import",
        {
            "overwrite": overwrite,
            "source": source,
            "format": format,
            "drop_invalid": drop_invalid,
            "sh_degree": sh_degree,
            "channels": channels,
            "output": output,
        },
        progress,
        should_stop,
        threads,
    )


@names_checked
def edit(
    source: PathLike,
    output: PathLike,
    *,
    meshes: Sequence[PathLike] | PathLike,
    overwrite: bool = False,
    report: PathLike | None = None,
    method: Literal["least-squares", "three-point"] | None = None,
    damaged: Literal["repair", "drop"] | None = None,
    axes: Literal["auto"] | Literal["x0", "x90", "x180", "x270"] | None = None,
    q: float | None = None,
    min_opacity: float | None = None,
    max_residual: float | None = None,
    whole_octagons: bool = False,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "EditResult":
    """Turn a mesh edited elsewhere back into Gaussians.

    Args:
        source: The scene to read: a file of any format, or the folder of a run.
        output: The scene to write; the suffix says in which format. Of a run, a name without suffix
            writes a folder that is a run again, with what of it stays valid. For a sequence a pattern
            such as out/%04d.ply, or a folder.
        meshes: The edited mesh (.ply, .obj or .glb); several, or here a quoted pattern such as
            'frames/*.ply', are a sequence.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
        report: Write all counts there.
        method: How a frame follows from the corners of its octagon: least-squares over all of them, or
            three-point, the rule of the paper from corners 0, 2 and 6, which drops shear. Default:
            least-squares.
        damaged: What becomes of octagons that lost corners, flipped or crumpled: repair fits them to
            the corners left, turns them back or moves them as their neighbours were; drop leaves them
            out. Default: repair.
        axes: Turn of the mesh about x, in degrees, that brings it back to the scene's axes. Default:
            auto.
        q: What the mesh was exported with, should it not say.
        min_opacity: Least opacity that the mesh was exported with, should it not say; without it every
            Gaussian that can have an octagon is taken to have one.
        max_residual: Octagons further from an affine image than this many standard deviations are
            crumpled. Default: 1.0.
        whole_octagons: Octagons of which only some corners moved move as a whole, or not at all if most
            stayed.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> len(osp.load(osp.edit("run", "edited.ply", meshes=["run/mesh.ply"]).files[0])) > 100
    True
    """
    return run_operation(
        "edit",
        {
            "overwrite": overwrite,
            "source": source,
            "output": output,
            "report": report,
            "method": method,
            "damaged": damaged,
            "axes": axes,
            "q": q,
            "min_opacity": min_opacity,
            "max_residual": max_residual,
            "whole_octagons": whole_octagons,
            "meshes": meshes,
        },
        progress,
        should_stop,
        threads,
    )


@names_checked
def deform(
    source: PathLike,
    output: PathLike,
    *,
    proxy: PathLike,
    deformed: Sequence[PathLike] | PathLike,
    overwrite: bool = False,
    report: PathLike | None = None,
    method: Literal["nearest", "mvc"] | None = None,
    reach: float | None = None,
    axes: Literal["auto"] | Literal["x0", "x90", "x180", "x270"] | None = None,
    mirrored: Literal["auto", "yes", "no"] | None = None,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "DeformResult":
    """Make a scene follow a deformed cage or coarse mesh.

    Args:
        source: The scene to read: a file of any format, or the folder of a run.
        output: The scene to write; the suffix says in which format. Of a run, a name without suffix
            writes a folder that is a run again, with what of it stays valid. For a sequence a pattern
            such as out/%04d.ply, or a folder.
        proxy: The mesh at rest (.ply, .obj or .glb), lying on or around what is to move.
        deformed: The same mesh deformed; several, or here a quoted pattern such as 'frames/*.obj', are
            a sequence.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
        report: Write all counts there.
        method: nearest: follow the triangles close by; mvc: mean-value coordinates of a closed cage.
            Default: nearest.
        reach: Follow fully up to this distance from the mesh, and not at all beyond twice of it; inf
            for everything. [default: nearest: a tenth of the mesh's diagonal; mvc: inside of the cage]
        axes: Turn of both meshes about x, in degrees, that brings them to the scene's axes: auto is
            x180 where octasplat wrote the proxy as GLB, which is y up, else x0; x90 is for what Blender
            saves as OBJ or GLB beside a scene imported as PLY. Default: auto.
        mirrored: Whether the deformed mesh was mirrored; auto looks at it, which a flat mesh cannot
            show. Default: auto.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> osp.deform("scene.ply", "bent.ply", proxy="cage.obj", deformed=["bent.obj"]).moving
    1200
    """
    return run_operation(
        "deform",
        {
            "overwrite": overwrite,
            "source": source,
            "output": output,
            "report": report,
            "proxy": proxy,
            "deformed": deformed,
            "method": method,
            "reach": reach,
            "axes": axes,
            "mirrored": mirrored,
        },
        progress,
        should_stop,
        threads,
    )


@names_checked
def transform(
    source: PathLike,
    output: PathLike,
    *,
    overwrite: bool = False,
    matrix: PathLike | Matrix | None = None,
    up: Sequence[Literal["x", "-x", "y", "-y", "z", "-z"]] | None = None,
    scale: float | None = None,
    rotate: Sequence[Sequence[Literal["x", "y", "z"] | float]] | None = None,
    translate: Numbers | None = None,
    about: Numbers | None = None,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "TransformResult":
    """Move, turn or scale a scene.

    Args:
        source: The scene to read: a file of any format, or the folder of a run.
        output: The scene to write; the suffix says in which format. Of a run, a name without suffix
            writes a folder that is a run again, with what of it stays valid.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
        matrix: An affine 4 x 4 or 3 x 4 matrix that maps old points to new ones, row by row: a text
            file or, in Python and JSON, its rows.
        up: Turn the axis that points up to another: -y z from COLMAP's usual frame to Blender's.
        scale: Scale by a factor.
        rotate: Turn about an axis, counter-clockwise seen from its tip; may be repeated.
        translate: Move.
        about: The point that up, scale and rotate leave where it is. Default: (0.0, 0.0, 0.0).
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> osp.transform("scene.ply", "moved.ply", translate=(0, 0, 1), scale=2).count
    1200
    >>> import numpy as np
    >>> osp.transform("scene.ply", "mirrored.ply", matrix=np.diag([-1, 1, 1, 1])).matrix[0]
    (-1.0, 0.0, 0.0, 0.0)
    """
    return run_operation(
        "transform",
        {
            "overwrite": overwrite,
            "source": source,
            "output": output,
            "matrix": matrix,
            "up": up,
            "scale": scale,
            "rotate": rotate,
            "translate": translate,
            "about": about,
        },
        progress,
        should_stop,
        threads,
    )


@names_checked
def crop(
    source: PathLike,
    output: PathLike,
    *,
    overwrite: bool = False,
    where: str | None = None,
    box: Numbers | None = None,
    sphere: Numbers | None = None,
    inverse: bool = False,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "CropResult":
    """Keep part of a scene.

    Args:
        source: The scene to read: a file of any format, or the folder of a run.
        output: The scene to write; the suffix says in which format. Of a run, a name without suffix
            writes a folder that is a run again, with what of it stays valid.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
        where: Comparisons joined by and, or, not that hold for them, of x, y, z, opacity and channels
            such as metallic, roughness and albedo.r: 'metallic > 0.5 and z < 0'.
        box: Two corners of a box that their centres lie in, smallest coordinates first.
        sphere: Centre and radius of a sphere that their centres lie in.
        inverse: Take the other Gaussians instead.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
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
            "overwrite": overwrite,
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


@names_checked
def merge(
    source: Sequence[PathLike] | PathLike,
    output: PathLike,
    scenes: Sequence[PathLike] | PathLike | None = None,
    *,
    overwrite: bool = False,
    sh_degree: int | None = None,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "MergeResult":
    """Put scenes together.

    Args:
        source: The first scene: a file of any format, or the folder of a run. Python also takes a list
            of all scenes here.
        output: The scene to write; the suffix says in which format. Of a run, a name without suffix
            writes a folder that is a run again, with what of it stays valid.
        scenes: The other scenes: files of any format, each in the same frame.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
        sh_degree: Degree of the colors' harmonics. [default: the highest among the scenes]
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> osp.merge(["scene.ply", "shiny.ply"], "both.ply").counts
    (1200, 1200)
    """
    return run_operation(
        "merge",
        {
            "overwrite": overwrite,
            "source": source,
            "output": output,
            "scenes": scenes,
            "sh_degree": sh_degree,
        },
        progress,
        should_stop,
        threads,
    )


@names_checked
def clean(
    source: PathLike,
    output: PathLike | None = None,
    *,
    overwrite: bool = False,
    min_opacity: float | None = None,
    min_scale: float | None = None,
    max_scale: float | None = None,
    floaters: bool = True,
    min_group: int | None = None,
    link: float | None = None,
    neighbors: int | None = None,
    camera_clearance: float | None = None,
    min_views: int | None = None,
    dry_run: bool = False,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "CleanResult":
    """Remove faint Gaussians, oversized ones and floaters.

    Args:
        source: The scene to read: a file of any format, or the folder of a run.
        output: The scene to write; the suffix says in which format. Of a run, a name without suffix
            writes a folder that is a run again, with what of it stays valid.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
        min_opacity: Remove fainter ones; below 0.01 they cannot be seen. Default: 0.01.
        min_scale: Remove those whose larger standard deviation is smaller, in the scene's units.
            Default: 0.0.
        max_scale: Remove those whose larger standard deviation is larger, in the scene's units.
        floaters: Remove small groups by themselves.
        min_group: Groups of fewer Gaussians are floaters. Default: 20.
        link: Neighbours belong together if their centres are no further apart than this many times the
            sum of their standard deviations. Default: 1.0.
        neighbors: How many nearest neighbours of a Gaussian may belong to its group. Default: 12.
        camera_clearance: In a run: remove those nearer to the camera of a training view than this share
            of the distance at which the sparse points around it begin; 0 for none. Default: 0.25.
        min_views: In a run: remove those whose centre lies in the image of fewer training views than
            this, which lie beyond what the cameras see; 0 for none. Default: 0.
        dry_run: Only count.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> cleaned = osp.clean("scene.ply", "cleaned.ply", min_opacity=0.5, floaters=False)
    >>> cleaned.count, cleaned.kept + cleaned.faint
    (1200, 1200)
    """
    return run_operation(
        "clean",
        {
            "overwrite": overwrite,
            "source": source,
            "min_opacity": min_opacity,
            "min_scale": min_scale,
            "max_scale": max_scale,
            "floaters": floaters,
            "min_group": min_group,
            "link": link,
            "neighbors": neighbors,
            "camera_clearance": camera_clearance,
            "min_views": min_views,
            "output": output,
            "dry_run": dry_run,
        },
        progress,
        should_stop,
        threads,
    )


@names_checked
def simplify(
    source: PathLike,
    output: PathLike,
    *,
    count: int,
    overwrite: bool = False,
    progress: EventListener | None = None,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> "SimplifyResult":
    """Merge neighbors until so many Gaussians are left.

    Args:
        source: The scene to read: a file of any format, or the folder of a run.
        output: The scene to write; the suffix says in which format. Of a run, a name without suffix
            writes a folder that is a run again, with what of it stays valid.
        count: Number of Gaussians to leave; a scene that has no more stays as it is.
        overwrite: Replace files that are there already, too, which are not of an earlier run of this
            command or were changed since. What is read is never replaced.
        progress: told each event; by default they are logged, or shown in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
        threads: number of threads; 0 takes all cores. The result does not depend on it.

    Raises:
        OctasplatError: something cannot be read, done or written; the text says what.

    >>> import octasplat as osp
    >>> osp.simplify("scene.ply", "small.ply", count=300).kept, len(osp.load("small.ply"))
    (300, 300)
    """
    return run_operation(
        "simplify",
        {"overwrite": overwrite, "source": source, "output": output, "count": count},
        progress,
        should_stop,
        threads,
    )
