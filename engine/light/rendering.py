"""Pictures and films of a stage."""

from collections.abc import Callable, Sequence
from pathlib import Path

from octasplat.engine.light.film import StageImage
from octasplat.engine.light.integrator import PathTracer
from octasplat.engine.light.stage import Integrator
from octasplat.engine.light.staging import LitMeshes, refuse_inside_glass
from octasplat.engine.render.images import write_exr, write_png
from octasplat.engine.render.jobs import Paint, Shot


def stage_paint(tracer: PathTracer, settings: Integrator) -> Paint:
    """What renders a shot of a stage to a file.

    ``.exr`` gets the linear picture before exposure and tone curve as R, G, B, and alpha as A; anything else
    gets 8-bit display values.

    Args:
        tracer: of the stage.
        settings: with exposure and tone curve.
    """

    def paint(shot: Shot, path: Path, part: Callable[[float], None]) -> None:
        film = tracer.render(shot.rays(), lambda done, of: part(done / of))
        write_stage_image(path, film.image(exposure=settings.exposure, tone=settings.tone))

    return paint


def refuse_cameras_in_glass(meshes: LitMeshes, shots: Sequence[Shot]) -> None:
    """Look at all cameras before anything is rendered.

    Raises:
        ConfigError: one stands in glass.
    """
    for shot in shots:
        refuse_inside_glass(meshes, shot.rays().origin_world, shot.name)


def render_preview(
    tracer: PathTracer,
    settings: Integrator,
    shot: Shot,
    path: Path,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> None:
    """Render one shot and write it again each time that it has become about twice as fine.

    The last picture is the very one that :func:`stage_paint` makes, but for rounding.

    Raises:
        OutputError: the file cannot be written.
    """
    image = shot.rays()
    done = 0
    progress(0, settings.samples)
    for film in tracer.refine(image):
        write_stage_image(path, film.image(exposure=settings.exposure, tone=settings.tone))
        done = max(1, min(2 * done, settings.samples))
        progress(done, settings.samples)


def write_stage_image(path: Path, image: StageImage) -> None:
    """Write a picture: linear channels, alpha and a compositor's layers for ``.exr``, else display values.

    Raises:
        OutputError: the file cannot be written.
    """
    if path.suffix.lower() == ".exr":
        layers = {name: image.rgb_linear[..., k] for k, name in enumerate("RGB")}
        write_exr(path, {**layers, "A": image.alpha, **image.layers})
    else:
        write_png(path, image.rgb_srgb)
