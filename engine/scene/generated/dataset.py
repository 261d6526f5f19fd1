"""Filling a folder with the generated scene's files."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import lru_cache
from pathlib import Path

from octasplat.engine.scene.generated import cameras, colmap, files
from octasplat.engine.scene.generated.arrangement import still_life
from octasplat.engine.scene.generated.config import GeneratedSceneConfig
from octasplat.engine.scene.generated.photographs import Photographer
from octasplat.engine.scene.generated.points import surface_points
from octasplat.engine.scene.generated.tracing import THREADS, LitScene


@lru_cache(maxsize=1)
def lit_scene() -> LitScene:
    """The still life, lit; kept, because lighting it takes longer than a photograph."""
    return LitScene(still_life())


def write_files(root: Path, config: GeneratedSceneConfig, progress: Callable[[int, int], None]) -> None:
    """Write images, model and ground truth under ``root``; ``progress`` counts photographs."""
    scene = lit_scene()
    camera, views = cameras.lens(config), cameras.views(config)
    truth = root / "ground_truth"
    folders = [root / "images", truth / "depth", truth / "normals", truth / "masks"]
    for folder in [*folders, *([root / "masks"] if config.with_masks else [])]:
        folder.mkdir(parents=True)
    photographer = Photographer(scene, camera, config)

    def take(view: cameras.View) -> None:
        photograph = photographer.take(view)
        stem = Path(view.name).stem
        files.write_photograph(root / "images" / view.name, photograph.pixels)
        files.write_depth(truth / "depth" / f"{stem}.exr", photograph.depth_cam)
        files.write_normals(truth / "normals" / f"{stem}.exr", photograph.normals_world)
        files.write_mask(truth / "masks" / f"{stem}.png", photograph.is_object)
        if config.with_masks:
            files.write_mask(root / "masks" / f"{view.name}.png", photograph.is_object)

    files.write_mesh(truth / "mesh.ply", scene.still_life.vertices, scene.still_life.faces)
    colmap.write_model(root / "sparse" / "0", camera, views, surface_points(scene, camera, views, config))
    progress(0, len(views))
    with ThreadPoolExecutor(THREADS) as pool:
        waiting = [pool.submit(take, view) for view in views]
        try:
            for done, photograph in enumerate(as_completed(waiting), start=1):
                photograph.result()
                progress(done, len(views))
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
