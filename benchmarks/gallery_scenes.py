"""Scenes of the gallery: what is generated for each, how it is reconstructed, its figures and pictures."""

import importlib.util
import json
import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from PIL import Image
from pydantic import BaseModel, ConfigDict

import octasplat as osp
from benchmarks.large_growth import measured
from benchmarks.mirror_room import write_room
from octasplat.engine.core.color import composite_over, to_bytes
from octasplat.engine.core.versions import RESULTS_VERSION
from octasplat.engine.core.writing import atomic_replace, write_json
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.dataset.views_file import SplitViewpoints, read_views
from octasplat.engine.evaluate.gallery import magma
from octasplat.engine.evaluate.held_out import METRICS, RENDERS
from octasplat.engine.evaluate.metrics import flip
from octasplat.engine.render.file_names import unique_render_names
from octasplat.engine.render.image_files import read_image
from octasplat.engine.render.pose_paths import PosePath
from octasplat.engine.render.renderer import background_color
from octasplat.engine.runs.run_folder import VIEWS

JPEG_QUALITY = 82
SAME_VIEW_DEG = 35.0
"""Cameras that look further apart than this are no neighbours, however near they stand."""
Picture = Float32[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class GalleryScene:
    """A scene of the gallery.

    Attributes:
        title: heading on the page.
        about: what there is to see, and what is hard about it.
        photographs: writes the photographs and their model into a folder that is not there.
        options: of ``octasplat reconstruct``, beside the preset.
        needs: a package without which the photographs cannot be made.
    """

    title: str
    about: str
    photographs: Callable[[Path], None]
    options: tuple[str, ...] = ()
    needs: str | None = None


def _generated(root: Path, config: SyntheticDatasetConfig) -> None:
    write_synthetic_dataset(root, config)


def _kettle(root: Path) -> None:
    # here, as Mitsuba is only installed for development
    from benchmarks.material_thing_shapes import THINGS
    from benchmarks.material_thing_skies import SKIES
    from benchmarks.material_things import CHOOSING, Sizes, write_thing

    sizes = Sizes(train_views=48, train_samples=12, test_views=1, relit_views=0)
    sky = CHOOSING["kettle"]
    write_thing(root, "kettle", THINGS["kettle"](), {sky: SKIES[sky](sizes.sky_height)}, sizes)
    # Beside the photographs a reconstruction would warn of them.
    for truth in ("env", "test"):
        shutil.rmtree(root / truth)
    (root / "truth.json").unlink()


_TABLE = SyntheticDatasetConfig()
_CUTOUT = SyntheticDatasetConfig(
    views=20, width_px=256, height_px=256, camera_model="OPENCV_FISHEYE", transparent=True
)
_STREET = SyntheticDatasetConfig(
    views=128, width_px=320, height_px=240, samples_per_side=2, points=8000, scene="street", houses=2
)
SCENES: Mapping[str, GalleryScene] = {
    "table": GalleryScene(
        "Things on a table",
        "The scene of `octasplat demo`: 40 photographs of 320 x 240 px on three rings around a table.",
        partial(_generated, config=_TABLE),
    ),
    "cutout": GalleryScene(
        "Cut out, few photographs",
        "The same things without what surrounds them: 20 photographs of 256 x 256 px with alpha, by a "
        "fisheye lens.",
        partial(_generated, config=_CUTOUT),
    ),
    "street": GalleryScene(
        "A street",
        "Outdoors: 128 photographs of 320 x 240 px from two walks between houses, every seventh held out.",
        partial(_generated, config=_STREET),
        # Every eighth would always be the one that looks down the street from the same side.
        options=("--test-every", "7"),
    ),
    "mirror_room": GalleryScene(
        "A room with a mirror ball",
        "40 photographs of 180 x 180 px from within a closed room (`benchmarks.mirror_room`), reconstructed "
        "without materials.",
        partial(write_room, views=40, side=180),
    ),
    "mirror_room_materials": GalleryScene(
        "The same room with materials",
        "The same photographs, with a recipe of materials that mirrors what stands near; a short training "
        "whose length the preset does not change.",
        partial(write_room, views=40, side=180),
        options=(
            "--materials", "--iterations", "1400", "--set", "materials.recipe=near_field",
            "--set", "exposure=false", "--set", "rays_per_batch=2048", "--set", "max_gaussians=8000",
        ),
    ),
    "kettle": GalleryScene(
        "A shiny kettle",
        "Steel beside paint, thin wires, wood (`benchmarks.material_things`, by Mitsuba): 48 photographs of "
        "200 x 200 px with alpha, reconstructed without materials.",
        _kettle,
        needs="mitsuba",
    ),
}  # fmt: skip


class ShownView(BaseModel):
    """A held-out view and how well it is shown."""

    model_config = ConfigDict(frozen=True)

    name: str
    psnr: float
    ssim: float | None


class SceneFigures(BaseModel):
    """What the gallery tells of one reconstruction.

    Attributes:
        preset: of the training.
        version: of the program.
        results_version: see :data:`octasplat.engine.core.versions.RESULTS_VERSION`.
        photographs: how many there are.
        held_out: how many of them were held out.
        psnr: mean over the held-out views, dB.
        training_psnr: mean over the training views, dB.
        ssim: mean over the held-out views.
        gaussians: how many.
        cpu_seconds: of the whole command; ``None`` if it was stopped and went on.
        worst_now: the worst held-out view.
        worst: the view that is shown as the worst, which was that when the views were chosen.
        median: the view that is shown as the median one.
        between: the training views half-way between which a view is shown.
    """

    model_config = ConfigDict(frozen=True)

    preset: str
    version: str
    results_version: int
    photographs: int
    held_out: int
    psnr: float
    training_psnr: float | None
    ssim: float | None
    gaussians: int
    cpu_seconds: float | None
    worst_now: ShownView
    worst: ShownView
    median: ShownView
    between: tuple[str, str]

    @property
    def views(self) -> tuple[str, ...]:
        """Return the names of the photographs that are shown."""
        return (self.worst.name, self.median.name, *self.between)


def available(scene: GalleryScene) -> bool:
    """Return whether the photographs of a scene can be made here."""
    return scene.needs is None or importlib.util.find_spec(scene.needs) is not None


def train(name: str, folder: Path, preset: str, threads: int) -> None:
    """Generate and reconstruct a scene in ``folder``; what is there already is kept, or gone on with.

    Raises:
        SystemExit: the reconstruction failed.
    """
    scene, photographs, run, cost = SCENES[name], folder / "photographs", folder / "run", folder / "cost.json"
    if not photographs.exists():
        unfinished = folder / "photographs.partial"
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.parent.mkdir(parents=True, exist_ok=True)
        scene.photographs(unfinished)
        unfinished.rename(photographs)
    if cost.exists():
        return
    is_new = not run.exists()
    command = [sys.executable, "-m", "octasplat", "reconstruct", str(photographs), "-o", str(run), "--resume"]
    command += ["--quiet", "--preset", preset, "--threads", str(threads), "--exports", "", *scene.options]
    seconds, _ = measured(command)
    write_json(cost, {"cpu_seconds": seconds if is_new else None})


def scene_figures(folder: Path, preset: str, kept: SceneFigures | None = None) -> SceneFigures:
    """Return the figures of what :func:`train` left, and which views are to be shown.

    Args:
        folder: as that of :func:`train`.
        preset: that it was trained with.
        kept: figures of an earlier gallery, whose views are shown if they are there.
    """
    metrics = json.loads((folder / "run" / METRICS).read_text(encoding="utf-8"))
    viewpoints = read_views(folder / "run" / VIEWS).viewpoints(None)
    rows = {
        name: ShownView(name=name, psnr=row["psnr"], ssim=row["ssim"])
        for name, row in metrics["views"].items()
        if row["psnr"] is not None
    }
    order = sorted(rows.values(), key=lambda row: (row.psnr, row.name))
    worst, median, between = order[0], order[len(order) // 2], widest_gap(viewpoints)
    if kept is not None and set(kept.views) <= {view.name for view in viewpoints.views}:
        worst, median = rows.get(kept.worst.name, worst), rows.get(kept.median.name, median)
        between = kept.between
    return SceneFigures(
        preset=preset,
        version=metrics["versions"]["octasplat"],
        results_version=RESULTS_VERSION,
        photographs=len(viewpoints.views),
        held_out=len(rows),
        psnr=metrics["mean"]["psnr"],
        training_psnr=metrics["training_views"]["psnr"],
        ssim=metrics["mean"]["ssim"],
        gaussians=metrics["gaussians"],
        cpu_seconds=json.loads((folder / "cost.json").read_text(encoding="utf-8"))["cpu_seconds"],
        worst_now=order[0],
        worst=worst,
        median=median,
        between=between,
    )


def widest_gap(viewpoints: SplitViewpoints) -> tuple[str, str]:
    """Return the names of the two neighbouring training views that lie furthest apart.

    A view's neighbour is the nearest one that looks about the same way.

    Raises:
        SystemExit: no two views look the same way.
    """
    views = [viewpoints.views[index] for index in viewpoints.train_indices]
    centres = np.stack([view.origin_world for view in views])
    ahead = np.stack([view.rotation_cam_from_world[2] for view in views])
    distances = np.linalg.norm(centres[:, None] - centres, axis=-1)
    distances[ahead @ ahead.T < np.cos(np.radians(SAME_VIEW_DEG))] = np.inf
    np.fill_diagonal(distances, np.inf)
    gaps = distances.min(axis=1)
    if not np.isfinite(gaps).any():
        raise SystemExit("No two training views look the same way, so that none lies between two.")
    first = int(np.where(np.isfinite(gaps), gaps, -1.0).argmax())
    return views[first].name, views[int(distances[first].argmin())].name


def between_path(viewpoints: SplitViewpoints, names: tuple[str, str]) -> dict[str, object]:
    """Return the camera path, as ``docs/cameras.md`` has it, of the one camera half-way between two views."""
    by_name = {view.name: view for view in viewpoints.views}
    first, second = by_name[names[0]], by_name[names[1]]
    keys = np.tile(np.eye(4), (2, 1, 1))
    for key, view in zip(keys, (first, second), strict=True):
        key[:3, :3], key[:3, 3] = view.rotation_cam_from_world.T, view.origin_world
    fx, fy, cx, cy = viewpoints.cameras[first.camera_index].params[:4]
    lens = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    pose = PosePath(keys).poses_at(np.array([0.5]))[0]
    frame = {"camera_to_world": pose.tolist(), **lens}
    return {"width": first.width_px, "height": first.height_px, "frames": [frame]}


def write_strips(folder: Path, figures: SceneFigures, pictures: Path, name: str, threads: int) -> None:
    """Write the pictures of a scene: ``NAME_worst.jpg``, ``NAME_median.jpg`` and ``NAME_between.jpg``.

    The first two have photograph, render and FLIP error side by side; the last the render half-way between
    the photographs of two training views.
    """
    run = folder / "run"
    background = json.loads((run / METRICS).read_text(encoding="utf-8"))["background"]
    record = read_views(run / VIEWS)
    names = [view.name for view in record.views]
    renders = dict(zip(names, unique_render_names(names), strict=True))
    for what, shown in (("worst", figures.worst), ("median", figures.median)):
        taken = photograph(folder / "photographs", shown.name, background)
        render = read_image(run / RENDERS / f"{renders[shown.name]}.png")[..., :3]
        write_jpeg(pictures / f"{name}_{what}.jpg", [taken, render, magma(flip(render, taken).error)])
    between = folder / "between" / "view.png"
    path = between_path(record.viewpoints(None), figures.between)
    osp.render(run, between, camera_path=path, overwrite=True, threads=threads)
    first, second = (photograph(folder / "photographs", view, background) for view in figures.between)
    write_jpeg(pictures / f"{name}_between.jpg", [first, read_image(between)[..., :3], second])


def photograph(dataset: Path, name: str, background: str) -> Picture:
    """Return a photograph over the background that it is evaluated on."""
    image = read_image(dataset / "images" / name)
    if image.shape[2] < 4:
        return image
    return composite_over(image[..., :3], image[..., 3], background_color(background)).astype(np.float32)


def write_jpeg(path: Path, images: list[Picture]) -> None:
    """Write display values side by side as a JPEG, atomically."""
    with atomic_replace(path) as temporary:
        side_by_side = Image.fromarray(to_bytes(np.concatenate(images, axis=1)))
        side_by_side.save(temporary, quality=JPEG_QUALITY, optimize=True)
