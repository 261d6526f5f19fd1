"""Pictures: of a scene in memory as arrays, of a file or run as files."""

from typing import TYPE_CHECKING, Any, Unpack, overload

from octasplat import images, verbs
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.images import Background, Image, Shading
from octasplat.paths import PathLike
from octasplat.scenes import Scene

if TYPE_CHECKING:
    from octasplat.engine.operations.render import RenderResult


@overload
def render(
    source: Scene,
    camera: PinholeCamera,
    /,
    *,
    background: Background = "black",
    shading: Shading | None = None,
    threads: int = 0,
) -> Image: ...


@overload
def render(
    source: PathLike, output: PathLike, /, **options: Unpack[verbs.RenderArguments]
) -> "RenderResult": ...


def render(source: Scene | PathLike, target: PinholeCamera | PathLike, /, **options: Any) -> Any:
    """Return what a camera sees of a scene in memory, or write pictures of a file or run.

    Of a scene in memory:

    Args:
        source: the scene.
        target: the camera; :meth:`Scene.camera`, :meth:`Scene.turntable` and :meth:`Camera.looking_at` make
            some.
        options: ``background``, what lies behind, by name or as display values in [0, 1]; ``shading``,
            ``materials`` in the light that the run of the scene has learnt, which is the default where there
            is one, or ``harmonics``; ``threads``, of which 0 takes all cores.

    >>> import octasplat as osp
    >>> scene = osp.load("scene.ply")
    >>> camera = osp.Camera.looking_at((0, 0, -4), (0, 0, 0), 96, 64)
    >>> osp.render(scene, camera, background="white")
    Image(96 x 64)

    Of a file or a run, ``target`` is where to write, and the options are those of the command ``octasplat
    render``, see :func:`octasplat.verbs.render`:

    >>> osp.render("run", "turntable/", mode="turntable", frames=3, width_px=64, height_px=48).images
    3
    """
    if isinstance(source, Scene) and isinstance(target, PinholeCamera):
        return images.render(source, target, **options)
    if isinstance(source, Scene) or isinstance(target, PinholeCamera):
        raise TypeError(
            "a scene in memory goes with one camera (run.scene is the scene of a run), a file or a run with "
            "a place for pictures"
        )
    return verbs.render(source, target, **options)
