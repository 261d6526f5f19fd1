"""Pictures of scenes in memory."""

import base64
import html
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from jaxtyping import Float32, Int32

from octasplat.engine.core.errors import ConfigError, OutputError
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.operation_calls import check_threads, names_checked
from octasplat.paths import PathLike
from octasplat.scenes import Scene

if TYPE_CHECKING:
    from octasplat.engine.shading.deferred import DeferredShading
    from octasplat.engine.shading.protocol import ShadingModel
    from octasplat.engine.trace.protocol import Tracer

Background = Literal["black", "white"] | tuple[float, float, float]
Shading = Literal["materials", "harmonics"]
_EIGHT_BITS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
"""Suffixes of formats that hold display values."""


@dataclass(frozen=True, eq=False)
class Image:
    """An image of a scene, rendered for one camera.

    Attributes:
        rgb: display values in [0, 1] over the background.
        depth: mean distance along the ray, world units; 0 where nothing was met.
        normal: mean normal in the world, towards the viewer, of unit length; 0 where nothing was met.
        alpha: share of the pixel that the scene covers.

    >>> import octasplat as osp
    >>> scene = osp.load("scene.ply")
    >>> image = osp.render(scene, scene.camera(width_px=96, height_px=64))
    >>> image.rgb.shape, image.depth.shape, image.normal.shape, image.alpha.shape
    ((64, 96, 3), (64, 96), (64, 96, 3), (64, 96))
    >>> image.gaussian.shape, int(image.gaussian.max()) < len(scene)
    ((64, 96), True)
    """

    rgb: Float32[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    normal: Float32[np.ndarray, "h w 3"]
    alpha: Float32[np.ndarray, "h w"]
    _scene: Scene = field(repr=False)
    _rays: ImageRays = field(repr=False)
    _threads: int = field(repr=False)

    @cached_property
    def gaussian(self) -> Int32[np.ndarray, "h w"]:
        """Return the id of the Gaussian with the largest weight at each pixel centre, -1 where there is none.

        It is found when it is first asked for, in the scene as it then is.
        """
        from octasplat.engine.render.renderer import dominant_gaussians

        return dominant_gaussians(
            _build_tracer(self._scene, self._threads), self._scene.gaussians, self._rays
        )

    def save(self, path: PathLike) -> Path:
        """Write an 8-bit PNG of the colors, or an OpenEXR with linear colors, alpha, depth and normals.

        JPEG, TIFF, WebP and BMP hold the same colors as PNG.

        Raises:
            OutputError: the name is that of another format, or the file cannot be written.

        >>> import octasplat as osp
        >>> scene = osp.load("scene.ply")
        >>> osp.render(scene, scene.camera(width_px=96, height_px=64)).save("view.png").name
        'view.png'
        """
        from octasplat.engine.render.image_files import exr_layers, write_exr, write_png

        target = Path(path)
        if target.suffix.lower() == ".exr":
            layers = exr_layers(self.rgb, alpha=self.alpha, depth=self.depth, normals_world=self.normal)
            write_exr(target, layers)
        elif target.suffix.lower() in _EIGHT_BITS:
            write_png(target, self.rgb)
        else:
            # Others hold linear light, such as HDR, or few colors.
            raise OutputError(f"{target}: a picture is written as {', '.join(_EIGHT_BITS)} or .exr.")
        return target

    def __repr__(self) -> str:
        height, width = self.alpha.shape
        return f"Image({width} x {height})"

    def _repr_png_(self) -> bytes:
        from io import BytesIO

        from PIL import Image as Picture

        from octasplat.engine.core.color import to_bytes

        memory = BytesIO()
        Picture.fromarray(to_bytes(self.rgb)).save(memory, "PNG")
        return memory.getvalue()

    def _repr_html_(self) -> str:
        source = base64.b64encode(self._repr_png_()).decode("ascii")
        return f'<img src="data:image/png;base64,{source}" alt="{html.escape(repr(self))}">'


@names_checked
def render(
    scene: Scene,
    camera: PinholeCamera,
    *,
    background: Background = "black",
    shading: Shading | None = None,
    threads: int = 0,
) -> Image:
    """Return what a camera sees of a scene in memory, see :func:`octasplat.rendering.render`.

    Args:
        scene: the scene.
        camera: where from; :meth:`Scene.camera` and :meth:`Camera.looking_at` make some.
        background: what lies behind, by name or as display values in [0, 1].
        shading: show materials in the light that the run has learnt, or harmonics; None shows materials if
            the scene has them, and came with that light.
        threads: 0 takes all cores; the result does not depend on it.

    Raises:
        ConfigError: materials are asked for, and the scene has none, or no light; or the background, the
            shading or the number of threads is none.
    """
    from octasplat.engine.gaussians.materials import is_material_known
    from octasplat.engine.render.shots import scene_image
    from octasplat.engine.shading.plain import PLAIN_SHADING

    check_threads(threads)
    behind = _background_color(background)
    if shading not in (None, *get_args(Shading)):
        raise ConfigError(f"shading: {shading!r} is neither 'materials' nor 'harmonics'.")
    is_lit = scene.materials is not None and bool(is_material_known(scene.gaussians).all())
    if shading == "materials" and not is_lit:
        raise ConfigError(
            "The scene has no materials with a light that was learnt; load the folder of a run that was "
            "reconstructed with materials, or leave out `shading`."
        )
    materials = scene.materials if is_lit and shading != "harmonics" else None

    rays = camera.rays()
    rendered = scene_image(
        _build_tracer(scene, threads, materials),
        rays,
        behind,
        trained_rad=scene.facts.pixel_rad,
        shading=PLAIN_SHADING if materials is None else _with_residual(scene, materials, threads),
        gives_radiance=materials is not None,
    )
    return Image(
        rendered.rgb_srgb, rendered.depth, rendered.normal_world, rendered.alpha, scene, rays, threads
    )


def _with_residual(scene: Scene, materials: "DeferredShading", threads: int) -> "ShadingModel":
    """Return materials in the learnt light with the residual colors of the scene, where it has any."""
    from octasplat.engine.shading.residual_colors import ResidualColors
    from octasplat.engine.trace.factory import make_tracer

    residual_sh = scene.residual_sh
    if residual_sh is None:
        return materials
    if len(residual_sh) != len(scene):
        raise ConfigError(
            f"scene.residual_sh: {len(residual_sh):,} rows for {len(scene):,} Gaussians; set it to None to "
            "show materials alone."
        )
    tracer = make_tracer(scene.trace_settings, threads=threads)
    return ResidualColors(materials, scene.gaussians, residual_sh, tracer)


def _background_color(background: Background) -> Float32[np.ndarray, "3"]:
    """Return the display values of a background; refuses other names, and what are no display values."""
    from octasplat.engine.render.renderer import background_color

    if isinstance(background, str) and background in ("black", "white"):
        return background_color(background)
    try:
        color = np.array(background, np.float32)
    except (TypeError, ValueError):
        color = np.zeros(0, np.float32)
    if color.shape != (3,) or not ((color >= 0) & (color <= 1)).all():
        raise ConfigError(
            f"background: {background!r} is neither 'black', 'white' nor three display values from 0 to 1."
        )
    return color


def _build_tracer(scene: Scene, threads: int, materials: "DeferredShading | None" = None) -> "Tracer":
    from octasplat.engine.trace.factory import make_tracer

    tracer = make_tracer(scene.trace_settings, threads=threads)
    tracer.build(scene.gaussians, None if materials is None else materials.features(scene.gaussians))
    return tracer
