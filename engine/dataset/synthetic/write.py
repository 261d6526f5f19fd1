"""Writer of the files of a synthetic dataset."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import lru_cache
from pathlib import Path

from octasplat.engine.dataset.synthetic import colmap_writer, files, synthetic_views
from octasplat.engine.dataset.synthetic.config import SyntheticDatasetConfig
from octasplat.engine.dataset.synthetic.lit_scene import THREADS, LitScene
from octasplat.engine.dataset.synthetic.photograph_renderer import PhotographRenderer
from octasplat.engine.dataset.synthetic.points import sample_surface_points
from octasplat.engine.dataset.synthetic.still_life import build_still_life
from octasplat.engine.dataset.synthetic.street import build_street


@lru_cache(maxsize=1)
def cached_lit_scene(name: str, houses: int) -> LitScene:
    """Return the lit scene of a name; cached, because lighting it takes longer than a photograph."""
    return LitScene(build_street(houses) if name == "street" else build_still_life())


def write_dataset_files(
    root: Path, config: SyntheticDatasetConfig, progress: Callable[[int, int], None]
) -> None:
    """Write images, model and ground truth under ``root``; ``progress`` counts photographs."""
    scene = cached_lit_scene(config.scene, config.houses)
    camera, views = synthetic_views.synthetic_camera(config), synthetic_views.synthetic_views(config)
    truth = root / "ground_truth"
    folders = [root / "images", truth / "depth", truth / "normals", truth / "masks"]
    for folder in [*folders, *([root / "masks"] if config.with_masks else [])]:
        folder.mkdir(parents=True)
    photographer = PhotographRenderer(scene, camera, config)

    def take(view: synthetic_views.SyntheticView) -> None:
        photograph = photographer.render(view)
        stem = Path(view.name).stem
        files.write_photograph(root / "images" / view.name, photograph.pixels)
        files.write_depth(truth / "depth" / f"{stem}.exr", photograph.depth_cam)
        files.write_normals(truth / "normals" / f"{stem}.exr", photograph.normals_world)
        files.write_mask(truth / "masks" / f"{stem}.png", photograph.is_foreground)
        if config.with_masks:
            files.write_mask(root / "masks" / f"{view.name}.png", photograph.is_foreground)

    files.write_mesh(truth / "mesh.ply", scene.unlit.vertices, scene.unlit.faces)
    colmap_writer.write_model(
        root / "sparse" / "0", camera, views, sample_surface_points(scene, camera, views, config)
    )
    progress(0, len(views))
    with ThreadPoolExecutor(THREADS) as pool:
        waiting = [pool.submit(take, view) for view in views]
        try:
            for done, photograph in enumerate(as_completed(waiting), start=1):
                photograph.result()
                progress(done, len(views))
        except BaseException:
            # After an error or an interruption the other photographs need not be rendered.
            pool.shutdown(wait=True, cancel_futures=True)
            raise
