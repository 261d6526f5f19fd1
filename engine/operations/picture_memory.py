"""Memory of a picture while it is rendered, by its pixels; imports neither torch nor numba."""

from octasplat.engine.operations.relight import RelightOptions
from octasplat.engine.operations.render import RenderOptions
from octasplat.engine.operations.render_options import PictureOptions

_PLAIN_PIXEL_BYTES = 150
"""For the harmonics; 83 to 230 were measured, most where several rays a pixel are traced."""
_LIT_PIXEL_BYTES = 350
"""For the split sum."""
_FILM_PIXEL_BYTES, _LAYERED_PIXEL_BYTES, _DENOISED_PIXEL_BYTES = 215, 570, 1200
"""For the sums over the paths of a stage and what is made of them; with layers for a compositor; and with
Open Image Denoise, most of it that program's own."""


def picture_bytes(options: PictureOptions, largest_photograph_pixels: int) -> int:
    """Return the memory that the largest picture of a render takes beside the scene.

    Args:
        options: of the pictures.
        largest_photograph_pixels: for views of the photographs, at the size of the pictures.
    """
    return _pixel_bytes(options) * _largest_pixels(options, largest_photograph_pixels)


def _pixel_bytes(options: PictureOptions) -> int:
    if isinstance(options, RelightOptions):
        return _FILM_PIXEL_BYTES if options.integrator == "path" else _LIT_PIXEL_BYTES
    stage = options.staged if isinstance(options, RenderOptions) else None
    if stage is None:
        return _PLAIN_PIXEL_BYTES
    if stage.integrator.denoise:
        return _DENOISED_PIXEL_BYTES
    return _LAYERED_PIXEL_BYTES if stage.integrator.layers else _FILM_PIXEL_BYTES


def _largest_pixels(options: PictureOptions, largest_photograph_pixels: int) -> int:
    if options.mode == "path" and options.camera_path is not None:
        return options.camera_path.width * options.camera_path.height
    if options.mode != "views":
        return options.width_px * options.height_px
    return largest_photograph_pixels
