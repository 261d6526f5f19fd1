"""A colored surface beside the scene that it was made of, at views that neither was trained on.

    octasplat surface OUT -o thing.glb --texture-size 2048
    python benchmarks/surface_views.py OUT thing.glb [--pictures FOLDER]
    python benchmarks/surface_views.py scene.ply thing.glb         # of a file: at eight views of a turntable

Prints PSNR in dB, means over the views: of the surface and of the scene to the photographs (of a run), of the
surface to the scene, and how much of the picture the surface covers. Surfaces are drawn as an unlit viewer
draws them, with four rays a pixel, and so is the scene that they are held against; itself held against
photographs, it is drawn with one, as it was trained.
"""

import argparse
import io
from itertools import product
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from PIL import Image
from scipy.ndimage import map_coordinates

from octasplat.engine.core.color import composite_over, linear_to_srgb
from octasplat.engine.core.rays import ImageRays, RayBatch
from octasplat.engine.files import read_mesh, read_scene
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.geometry.imported_mesh import ImportedMesh
from octasplat.engine.render.image_files import write_png
from octasplat.engine.render.renderer import background_color, render_rays
from octasplat.engine.render.shots import gaussian_turntable, turntable_cameras
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.run_dataset import open_run_dataset
from octasplat.engine.runs.run_folder import CONFIG, SCENE, is_run, photographs_folder
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import Tracer, TraceSettings
from octasplat.engine.trace.triangle_bvh import TriangleBvh

TURNTABLE = {"frames": 8, "width_px": 480, "height_px": 480}
OFFSETS = (-0.25, 0.25)
Picture = Float32[np.ndarray, "h w 3"]


class Surface:
    """A mesh as an unlit viewer draws it."""

    def __init__(self, path: Path) -> None:
        mesh = read_mesh(path, with_materials=True)
        self._mesh: ImportedMesh = mesh
        turned = mesh.vertices * [1, -1, -1] if path.suffix == ".glb" else mesh.vertices
        self._scene = TriangleBvh(turned.astype(np.float32), mesh.triangles)
        self._texture: Picture | None = None
        texture = mesh.materials[0].texture if mesh.materials else None
        if texture is not None and texture.content is not None:
            self._texture = (
                np.asarray(Image.open(io.BytesIO(texture.content)).convert("RGB"), np.float32) / 255
            )

    def draw(self, rays: ImageRays, background: Float32[np.ndarray, "3"]) -> tuple[Picture, float]:
        """The picture, and the share of it that is covered."""
        total, covered = np.zeros((rays.height_px, rays.width_px, 3), np.float32), 0.0
        for down, across in product(OFFSETS, OFFSETS):
            image = rays.shifted(across, down)
            directions = image.directions_world.reshape(-1, 3)
            origins = np.broadcast_to(image.origin_world, directions.shape)
            hits = self._scene.closest(RayBatch(origins, directions))
            rgb = np.tile(background, (len(directions), 1)).astype(np.float32)
            hit = hits.is_hit
            b = hits.barycentrics[hit]
            weights = np.stack([1 - b.sum(axis=1), b[:, 0], b[:, 1]], axis=1)
            rgb[hit] = self._colors(hits.faces[hit], weights)
            total += rgb.reshape(total.shape) / len(OFFSETS) ** 2
            covered += float(hit.mean()) / len(OFFSETS) ** 2
        return total, covered

    def _colors(self, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
        mesh = self._mesh
        if self._texture is not None and mesh.corner_uv is not None:
            uv = (weights[:, :, None] * mesh.corner_uv[faces]).sum(axis=1)
            height, width = self._texture.shape[:2]
            at = np.stack([uv[:, 1] * height - 0.5, uv[:, 0] * width - 0.5])
            return np.stack(
                [map_coordinates(self._texture[..., c], at, order=1, mode="nearest") for c in range(3)],
                axis=1,
            )
        assert mesh.rgb_linear is not None, "the surface has neither a texture nor colors"
        linear = mesh.rgb_linear[mesh.triangles[faces]]
        return linear_to_srgb((weights[:, :, None] * linear).sum(axis=1).astype(np.float32))


def views_of(
    source: Path, gaussians: FlatGaussians
) -> tuple[list[tuple[str, ImageRays, Picture | None]], TraceSettings, Float32[np.ndarray, "3"]]:
    """Names, rays and photographs of the held-out views of a run, or turntable views of a file."""
    if not is_run(source):
        cameras = turntable_cameras(gaussian_turntable(gaussians), **TURNTABLE)
        black = background_color("black")
        return (
            [(f"turn_{k}", camera.rays(), None) for k, camera in enumerate(cameras)],
            TraceSettings(),
            black,
        )
    config = read_config(source / CONFIG)
    dataset = open_run_dataset(photographs_folder(source), source, config, 0, lambda _event: None)
    color = background_color(config.evaluation_background)
    found: list[tuple[str, ImageRays, Picture | None]] = []
    for index in dataset.test_indices:
        rgb, alpha, _ = dataset.view_image(int(index))
        rays = dataset.view_rays(int(index))
        found.append((Path(dataset.views[index].name).stem, rays, composite_over(rgb, alpha, color)))
    return found, config.train.trace, color


def drawn_scene(tracer: Tracer, rays: ImageRays, background: Float32[np.ndarray, "3"]) -> Picture:
    """The scene's picture with as many rays a pixel as the surface's."""
    total = np.zeros((rays.height_px, rays.width_px, 3), np.float32)
    for down, across in product(OFFSETS, OFFSETS):
        total += render_rays(tracer, rays.shifted(across, down), background).rgb_srgb / len(OFFSETS) ** 2
    return total


def psnr_db(one: Picture, other: Picture) -> float:
    """Of display values."""
    return float(-10 * np.log10(np.mean((one.astype(np.float64) - other) ** 2)))


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("surfaces", type=Path, nargs="+")
    parser.add_argument("--pictures", type=Path)
    given = parser.parse_args()
    gaussians, _ = read_scene(given.source / SCENE if is_run(given.source) else given.source)
    views, settings, background = views_of(given.source, gaussians)
    tracer = make_tracer(settings)
    tracer.build(gaussians)
    scenes = [drawn_scene(tracer, rays, background) for _, rays, _ in views]
    photographs = [photograph for _, _, photograph in views if photograph is not None]
    if photographs:
        plain = [render_rays(tracer, rays, background).rgb_srgb for _, rays, _ in views]
        pairs = zip(plain, photographs, strict=True)
        print(f"scene to photographs: {np.mean([psnr_db(*pair) for pair in pairs]):.2f} dB")
    for path in given.surfaces:
        surface = Surface(path)
        drawn = [surface.draw(rays, background) for _, rays, _ in views]
        pictures = [picture for picture, _ in drawn]
        told = [f"to the scene {np.mean([psnr_db(*p) for p in zip(pictures, scenes, strict=True)]):.2f} dB"]
        if photographs:
            found = [psnr_db(*pair) for pair in zip(pictures, photographs, strict=True)]
            told.insert(0, f"to photographs {np.mean(found):.2f} dB")
        print(f"{path}: {', '.join(told)}, covers {np.mean([share for _, share in drawn]):.1%}")
        if given.pictures:
            for (name, _, photograph), picture, scene in zip(views, pictures, scenes, strict=True):
                shown = [picture, scene] + ([] if photograph is None else [photograph])
                write_png(
                    given.pictures / f"{path.stem}_{name}.png", np.concatenate(shown, axis=1).clip(0, 1)
                )


if __name__ == "__main__":
    main()
