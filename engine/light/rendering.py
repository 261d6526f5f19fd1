"""Pictures and films of a stage."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from engine.light.film import StageImage
from engine.light.integrator import PathTracer
from engine.light.stage import Integrator
from engine.light.staging import LitMeshes, refuse_inside_glass
from engine.render.images import write_exr, write_png
from engine.render.jobs import Shot
from engine.render.video import VideoWriter

Progress = Callable[[int, int], None]
STEPS = 100
"""Progress of a picture is told in so many parts."""


def render_stage_images(
    tracer: PathTracer,
    meshes: LitMeshes,
    settings: Integrator,
    shots: Sequence[Shot],
    file_of: Callable[[int, Shot], Path],
    progress: Progress = lambda _done, _total: None,
) -> tuple[Path, ...]:
    """Render each shot to a file of its own.

    Args:
        tracer: of the stage.
        meshes: of the stage.
        settings: with exposure and tone curve.
        shots: what to render.
        file_of: the file of a shot. ``.exr`` gets the linear picture before exposure and tone curve as R, G,
            B, and alpha as A; anything else gets 8-bit display values.
        progress: told (done, in all).

    Raises:
        ConfigError: a camera stands in glass; then nothing is rendered.
        OutputError: a file cannot be written.
    """
    for shot in shots:
        refuse_inside_glass(meshes, shot.rays().origin_world, shot.name)
    paths = []
    for number, (shot, image) in enumerate(_rendered(tracer, settings, shots, progress)):
        path = file_of(number, shot)
        write_stage_image(path, image)
        paths.append(path)
    return tuple(paths)


def render_stage_video(
    tracer: PathTracer,
    meshes: LitMeshes,
    settings: Integrator,
    shots: Sequence[Shot],
    path: Path,
    fps: float,
    progress: Progress = lambda _done, _total: None,
) -> None:
    """Render shots of one image size as the frames of a video.

    Raises:
        ConfigError: a camera stands in glass; then nothing is rendered.
        OutputError: the video cannot be written.
    """
    first = shots[0].rays()
    for shot in shots:
        refuse_inside_glass(meshes, shot.rays().origin_world, shot.name)
    with VideoWriter(path, fps, first.width_px, first.height_px) as video:
        for _, image in _rendered(tracer, settings, shots, progress):
            video.write(image.rgb_srgb)


def render_preview(
    tracer: PathTracer,
    meshes: LitMeshes,
    settings: Integrator,
    shot: Shot,
    path: Path,
    progress: Progress = lambda _done, _total: None,
) -> None:
    """Render one shot and write it again each time that it has become about twice as fine.

    The last picture is the very one that :func:`render_stage_images` makes, but for rounding.

    Raises:
        ConfigError: the camera stands in glass.
        OutputError: the file cannot be written.
    """
    image = shot.rays()
    refuse_inside_glass(meshes, image.origin_world, shot.name)
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


def _rendered(
    tracer: PathTracer, settings: Integrator, shots: Sequence[Shot], progress: Progress
) -> Iterator[tuple[Shot, StageImage]]:
    whole = STEPS * len(shots)
    for number, shot in enumerate(shots):

        def part(done: int, of: int, first: int = STEPS * number) -> None:
            progress(first + STEPS * done // of, whole)

        film = tracer.render(shot.rays(), part)
        yield shot, film.image(exposure=settings.exposure, tone=settings.tone)
