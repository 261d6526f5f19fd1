"""Pictures of scenes in memory."""

import base64
import html
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float32, Int32

from octasplat.engine.core.rays import ImageRays
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.operation_calls import names_checked
from octasplat.paths import PathLike
from octasplat.scenes import Scene

if TYPE_CHECKING:
    from octasplat.engine.trace.protocol import Tracer

Background = Literal["black", "white"] | tuple[float, float, float]


@dataclass(frozen=True)
class Image:
    """An image of a scene, rendered for one camera.

    Attributes:
        rgb: display values in [0, 1] over the background.
        depth: mean distance along the ray, world units; 0 where nothing was met.
        normal: mean normal in the world, towards the viewer, of unit length; 0 where nothing was met.
        alpha: share of the pixel that the scene covers.

    >>> import octasplat as osp
    >>> scene = osp.load("scene.ply")
    >>> image = osp.render(scene, scene.camera(width=96, height=64))
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

        Raises:
            OutputError: the file cannot be written.

        >>> import octasplat as osp
        >>> scene = osp.load("scene.ply")
        >>> osp.render(scene, scene.camera(width=96, height=64)).save("view.png").name
        'view.png'
        """
        from octasplat.engine.render.image_files import exr_layers, write_exr, write_png

        target = Path(path)
        if target.suffix.lower() == ".exr":
            layers = exr_layers(self.rgb, alpha=self.alpha, depth=self.depth, normals_world=self.normal)
            write_exr(target, layers)
        else:
            write_png(target, self.rgb)
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
def render_view(
    scene: Scene, camera: PinholeCamera, *, background: Background = "black", threads: int = 0
) -> Image:
    """Return what a camera sees of a scene in memory, see :func:`octasplat.rendering.render`.

    Args:
        scene: the scene.
        camera: where from; :meth:`Scene.camera` and :meth:`Camera.looking_at` make some.
        background: what lies behind, by name or as display values in [0, 1].
        threads: 0 takes all cores; the result does not depend on it.
    """
    from octasplat.engine.render.renderer import background_color
    from octasplat.engine.render.supersampling import rays_per_pixel_side, render_averaged
    from octasplat.engine.shading.plain import PLAIN_SHADING

    behind = background_color(background) if isinstance(background, str) else np.array(background, np.float32)
    rays = camera.rays()
    tracer = _build_tracer(scene, threads)
    rendered = render_averaged(
        tracer, rays, behind, PLAIN_SHADING, rays_per_pixel_side(rays, scene.facts.pixel_rad)
    )
    return Image(
        rendered.rgb_srgb, rendered.depth, rendered.normal_world, rendered.alpha, scene, rays, threads
    )


def _build_tracer(scene: Scene, threads: int) -> "Tracer":
    from octasplat.engine.trace.factory import make_tracer
    from octasplat.engine.trace.protocol import TraceSettings

    tracer = make_tracer(TraceSettings(flip_normal_cos=scene.facts.turned_beyond), threads=threads)
    tracer.build(scene.gaussians)
    return tracer
