"""Things of many materials with known truth: generated meshes, rendered by Mitsuba, as folders to train on.

    python -m benchmarks.material_things -o FOLDER                   # all five, a few CPU minutes each
    python -m benchmarks.material_things -o FOLDER kettle --side 256

Each thing has a folder with ``images/`` and ``sparse/0`` (views to train on), ``test/`` (other views with
``mask``, ``normal``, ``depth``, ``albedo``, ``roughness`` and ``metallic`` beside ``images/``),
``relight/<sky>/`` (some of the test views under other skies), ``env/`` and ``truth.json``, whose format is in
docs/materials.md. Settings are chosen on the things of ``CHOOSING``; those of ``REPORTING`` are for measuring
alone.
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float, Float32

from benchmarks.material_thing_shapes import RADIUS, THINGS, Thing
from benchmarks.material_thing_skies import HEIGHT, SKIES
from octasplat.engine.core.color import linear_to_srgb, to_bytes
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset.synthetic.colmap_writer import write_model
from octasplat.engine.dataset.synthetic.files import write_channels
from octasplat.engine.dataset.synthetic.photograph_renderer import rays_world
from octasplat.engine.dataset.synthetic.points import SurfacePoints, list_observations
from octasplat.engine.dataset.synthetic.synthetic_views import SyntheticView, directions_cam, project_visible
from octasplat.engine.pathtracing.denoising import load_denoiser
from octasplat.engine.render.environment_files import write_environment
from octasplat.engine.render.image_files import write_png
from octasplat.engine.trace.triangle_bvh import TriangleBvh

CHOOSING = {"kettle": "noon", "bowl": "studio"}
"""Things by which settings are chosen, and the sky over their photographs."""
REPORTING = {"engine": "dusk", "lamp": "noon", "cart": "studio"}
"""Things that are measured and decide nothing."""
DISTANCE = 4.0
"""From the cameras to the origin, world units."""
MAX_DEPTH = 8.0
"""That a depth map can hold, world units."""
BOUNCES = 6
POINT_NOISE = 1e-4
MAX_TRACK = 8
"""Most views that show one point."""


@dataclass(frozen=True)
class Sizes:
    """How much is rendered.

    Attributes:
        side: of the pictures, pixels.
        train_views: views to train on.
        test_views: views with truth.
        relit_views: test views under each other sky.
        train_samples: of a pixel of the training views.
        test_samples: of a pixel of the other views.
        points: of the sparse model.
        sky_height: texels of the skies from top to bottom.
        denoise: whether the pictures are denoised.
    """

    side: int = 200
    train_views: int = 64
    test_views: int = 12
    relit_views: int = 4
    train_samples: int = 16
    test_samples: int = 25
    points: int = 4000
    sky_height: int = HEIGHT
    denoise: bool = True


def camera_of(side: int) -> pycolmap.Camera:
    """Return the camera of all views; the sphere of the thing fills its picture."""
    focal = 0.48 * side / np.tan(np.arcsin(RADIUS / DISTANCE))
    return pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=side, height=side, params=[focal, focal, side / 2, side / 2]
    )


def views_around(count: int, stem: str, phase: float) -> list[SyntheticView]:
    """Return views of the origin, spread evenly over a sphere but for its lowest part."""
    views = []
    for k in range(count):
        up = np.sin(np.radians(75)) * (k + 0.5) / count + np.sin(np.radians(-20)) * (1 - (k + 0.5) / count)
        angle = np.pi * (3 - np.sqrt(5)) * (k + phase)
        across = np.sqrt(1 - up**2)
        centre = DISTANCE * np.array([across * np.cos(angle), across * np.sin(angle), up])
        ahead = -centre / DISTANCE
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(ahead, right), ahead])
        views.append(SyntheticView(f"{stem}_{k:03d}.png", rotation, -rotation @ centre))
    return views


class Surface:
    """What rays through a thing meet, by its triangles."""

    def __init__(self, thing: Thing) -> None:
        self.thing = thing
        self._bvh = TriangleBvh(thing.vertices, thing.faces)
        self._values = np.concatenate(
            [thing.normals, thing.albedo_linear, thing.roughness[:, None], thing.metallic[:, None]], axis=1
        )

    def hits(self, rays: RayBatch) -> tuple[Float32[np.ndarray, " r"], Float[np.ndarray, "r 8"]]:
        """Return distances in lengths of the directions (infinite: nothing), and interpolated values."""
        hits = self._bvh.closest(rays)
        corners = self.thing.faces[np.maximum(hits.faces, 0)]
        second, third = hits.barycentrics[:, :1], hits.barycentrics[:, 1:]
        weights = (1 - second - third, second, third)
        values = sum(w * self._values[corners[:, k]] for k, w in enumerate(weights))
        return hits.distances, np.where(hits.is_hit[:, None], values, 0.0)

    def is_seen(self, view: SyntheticView, points: Float[np.ndarray, "n 3"]) -> np.ndarray:
        """Return whether nothing is between a view's centre and each point."""
        ways = (points - view.centre_world).astype(np.float32)
        origins = np.broadcast_to(view.centre_world.astype(np.float32), ways.shape)
        return ~self._bvh.occluded(RayBatch(np.ascontiguousarray(origins), ways, t_max=1 - 1e-3))


def pixel_centres(side: int) -> Float[np.ndarray, "p 2"]:
    """Return image positions of all pixels' centres, row by row."""
    y, x = np.divmod(np.arange(side * side), side)
    return np.stack([x + 0.5, y + 0.5], axis=1)


def write_truth_maps(folder: Path, surface: Surface, camera: pycolmap.Camera, view: SyntheticView) -> None:
    """Write what is true at the centres of a view's pixels."""
    side = camera.width
    origins, directions = rays_world(view, directions_cam(camera, pixel_centres(side)))
    depth, values = surface.hits(RayBatch(origins, directions))
    seen = np.isfinite(depth)
    normal = values[:, :3] / np.maximum(np.linalg.norm(values[:, :3], axis=1, keepdims=True), 1e-12)
    normal[(normal * directions).sum(axis=1) > 0] *= -1
    steps = np.where(seen[:, None], np.round((normal + 1) / 2 * 65535), 0)
    depth_steps = np.where(seen, np.round(depth / MAX_DEPTH * 65535), 0)
    kinds: dict[str, np.ndarray] = {
        "mask": to_bytes(seen.astype(np.float32)[:, None]),
        "normal": steps.astype(np.uint16),
        "depth": depth_steps.astype(np.uint16)[:, None],
        "albedo": to_bytes(linear_to_srgb(values[:, 3:6]).astype(np.float32)),
        "roughness": to_bytes(values[:, 6:7].astype(np.float32)),
        "metallic": to_bytes(values[:, 7:8].astype(np.float32)),
    }
    for kind, pixels in kinds.items():
        (folder / kind).mkdir(parents=True, exist_ok=True)
        write_channels(folder / kind / view.name, pixels.reshape(side, side, -1))


def sample_points(
    surface: Surface, camera: pycolmap.Camera, views: list[SyntheticView], count: int
) -> SurfacePoints:
    """Return points under random pixels, each with the views that see it, at most ``MAX_TRACK``."""
    random = np.random.default_rng(5)
    places, colors = [], []
    for view in views:
        pixels = random.uniform(0, camera.width, (4 * count // len(views) + 8, 2))
        origins, directions = rays_world(view, directions_cam(camera, pixels))
        distance, values = surface.hits(RayBatch(origins, directions))
        met = np.isfinite(distance)
        places.append(origins[met] + distance[met, None] * directions[met])
        colors.append(values[met, 3:6])
    chosen = random.permutation(sum(map(len, places)))[: 2 * count]
    xyz, rgb = np.concatenate(places)[chosen].astype(np.float64), np.concatenate(colors)[chosen]
    observed = np.full((len(xyz), len(views), 2), np.nan)
    for k, view in enumerate(views):
        pixels = project_visible(camera, view, xyz)
        inside = np.isfinite(pixels[:, 0])
        inside[inside] = surface.is_seen(view, xyz[inside])
        observed[inside, k] = pixels[inside]
    order = random.random(observed.shape[:2])
    order[np.isnan(observed[..., 0])] = 2
    observed[np.argsort(np.argsort(order, axis=1), axis=1) >= MAX_TRACK] = np.nan
    good = np.flatnonzero(np.isfinite(observed[..., 0]).sum(axis=1) >= 2)[:count]
    noisy = xyz[good] + random.normal(0, POINT_NOISE, (len(good), 3))
    colors_srgb8 = to_bytes(linear_to_srgb(rgb[good]).astype(np.float32))
    return SurfacePoints(noisy, colors_srgb8, *list_observations(observed[good]))


class Photographs:
    """A thing under a sky in Mitsuba."""

    def __init__(
        self,
        thing: Thing,
        sky: Float32[np.ndarray, "h w 3"],
        camera: pycolmap.Camera,
        folder: Path,
        denoise: bool,
    ) -> None:
        import mitsuba as mi

        mi.set_variant("scalar_rgb")
        self._mi, self._camera = mi, camera
        self._denoise = load_denoiser() if denoise else None
        mesh = folder / "thing.ply"
        write_mitsuba_mesh(mesh, thing)
        # The plugin has pixels at the ends of its columns and at both poles: nodes of the same bilinear map.
        height = len(sky)
        rows = np.clip((np.arange(2 * height + 1) - 1) / 2, 0, height - 1)
        low = np.minimum(rows.astype(int), height - 2)
        part = (rows - low)[:, None, None].astype(np.float32)
        nodes = np.ascontiguousarray(sky[low] * (1 - part) + sky[low + 1] * part)
        # local x, y, z of the plugin are the world's y, z, x
        axes = [[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
        attributes = {"base_color": "base", "roughness": "rough", "metallic": "metal"}
        bsdf: dict[str, Any] = {"type": "principled", "specular": 0.5} | {
            name: {"type": "mesh_attribute", "name": f"vertex_{column}_color"}
            for name, column in attributes.items()
        }
        path = {"type": "path", "max_depth": BOUNCES + 1, "rr_depth": 100, "hide_emitters": True}
        self._scene = mi.load_dict(
            {
                "type": "scene",
                "thing": {"type": "ply", "filename": str(mesh), "bsdf": bsdf},
                "sky": {"type": "envmap", "bitmap": mi.Bitmap(nodes), "to_world": mi.ScalarTransform4f(axes)},
                "integrator": {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal", "colors": path},
            }
        )

    def take(
        self, view: SyntheticView, samples: int, seed: int
    ) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """Return straight display colors and coverage of a view."""
        mi, side = self._mi, self._camera.width
        centre, (_, down, ahead) = view.centre_world, view.rotation_cam_from_world
        sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov": float(2 * np.degrees(np.arctan(0.5 * side / self._camera.params[0]))),
                "to_world": mi.ScalarTransform4f().look_at(
                    origin=centre.tolist(), target=(centre + ahead).tolist(), up=(-down).tolist()
                ),
                "film": {
                    "type": "hdrfilm", "width": side, "height": side, "pixel_format": "rgba",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "multijitter", "sample_count": samples},
            }
        )  # fmt: skip
        layers = np.array(mi.render(self._scene, sensor=sensor, spp=samples, seed=seed), np.float32)
        linear, alpha = np.nan_to_num(np.maximum(layers[..., :3], 0)), np.clip(layers[..., 3], 0, 1)
        if self._denoise is not None:
            linear = self._denoise(
                np.ascontiguousarray(linear),
                np.ascontiguousarray(np.clip(layers[..., 4:7], 0, 1)),
                np.ascontiguousarray(layers[..., 7:10]),
            )
        straight = linear / np.maximum(alpha, 1e-6)[..., None] * (alpha > 0)[..., None]
        return linear_to_srgb(np.clip(straight, 0, 1)).astype(np.float32), alpha


def write_mitsuba_mesh(path: Path, thing: Thing) -> None:
    """Write a binary PLY with normals, and materials as attributes of the vertices."""
    names = ("x", "y", "z", "nx", "ny", "nz", "base_r", "base_g", "base_b", "rough_r", "metal_r")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(thing.vertices)}\n"
    header += "".join(f"property float {name}\n" for name in names)
    header += f"element face {len(thing.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    columns = np.concatenate(
        [
            thing.vertices, thing.normals, thing.albedo_linear,
            thing.roughness[:, None], thing.metallic[:, None],
        ],
        axis=1,
    )  # fmt: skip
    faces = np.zeros(len(thing.faces), [("corners", "u1"), ("indices", "<i4", 3)])
    faces["corners"], faces["indices"] = 3, thing.faces
    path.write_bytes(header.encode() + columns.astype("<f4").tobytes() + faces.tobytes())


def write_thing(
    folder: Path, name: str, thing: Thing, skies: dict[str, Float32[np.ndarray, "h w 3"]], sizes: Sizes
) -> None:
    """Write a thing's folder; ``skies`` has the one over its photographs first.

    ``truth.json`` comes last, so that a folder without it is not finished.
    """
    camera, surface = camera_of(sizes.side), Surface(thing)
    train, test = views_around(sizes.train_views, "train", 0.0), views_around(sizes.test_views, "test", 0.37)
    relit = test[:: max(1, len(test) // max(sizes.relit_views, 1))][: sizes.relit_views]
    first, *others = skies
    (folder / "env").mkdir(parents=True, exist_ok=True)
    for sky, values in skies.items():
        write_environment(folder / "env" / f"{sky}.hdr", values)
    for sky in skies:
        photographs = Photographs(thing, skies[sky], camera, folder, sizes.denoise)
        jobs = [
            (folder / "images", train, sizes.train_samples),
            (folder / "test" / "images", test, sizes.test_samples),
        ]
        if sky != first:
            jobs = [(folder / "relight" / sky, relit, sizes.test_samples)]
        for where, views, samples in jobs:
            where.mkdir(parents=True, exist_ok=True)
            for seed, view in enumerate(views):
                write_png(where / view.name, *photographs.take(view, samples, seed))
    (folder / "thing.ply").unlink()
    write_model(folder / "sparse" / "0", camera, train, sample_points(surface, camera, train, sizes.points))
    unseen = list_observations(np.zeros((0, len(test), 2)))
    nothing = SurfacePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), *unseen)
    write_model(folder / "test" / "sparse" / "0", camera, test, nothing)
    for view in test:
        write_truth_maps(folder / "test", surface, camera, view)
    write_json(folder / "truth.json", {
        "name": name,
        "world": {"up": "+z"},
        "environment": {"train": first, "relight": others},
        "test": {
            "truth_views": [view.name for view in test],
            "normal": "v/65535*2-1", "depth": f"v/65535*{MAX_DEPTH}", "roughness": "v/255",
            "metallic": "v/255", "albedo": "8 bits, sRGB curve of the linear base color",
        },
        "relight": {"folders": [f"relight/{sky}" for sky in others], "views": [view.name for view in relit]},
    })  # fmt: skip


def main() -> None:
    """Generate the things that are named, each with what it took."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(THINGS)}; all if left out")
    parser.add_argument("-o", "--output", type=Path, required=True, help="a folder for a folder each")
    parser.add_argument("--side", type=int, default=Sizes.side, help="pixels of a picture's side")
    given = parser.parse_args()
    skies = CHOOSING | REPORTING
    if unknown := sorted(set(given.names) - set(skies)):
        parser.error(f"there is no thing called {unknown[0]!r}; choose among {', '.join(skies)}")
    sizes = Sizes(side=given.side)
    for name in given.names or skies:
        began = time.process_time()
        order = sorted(SKIES, key=lambda sky: sky != skies[name])
        maps = {sky: SKIES[sky](sizes.sky_height) for sky in order}
        write_thing(given.output / name, name, THINGS[name](), maps, sizes)
        role = "choosing" if name in CHOOSING else "reporting"
        print(
            f"{name}: for {role}, under {skies[name]}; {time.process_time() - began:.0f} s of CPU", flush=True
        )


if __name__ == "__main__":
    main()
