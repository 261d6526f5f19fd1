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
