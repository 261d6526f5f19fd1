"""Sizes of the photographs of a scene, by which costs are estimated."""

from collections import Counter
from pathlib import Path

from octasplat.engine.dataset.image_sizes import ImageSizes


def photograph_sizes(scene: Path) -> list[ImageSizes]:
    """Return the sizes of the photographs in a folder, read from their headers.

    Raises:
        DatasetError: there are none, or some cannot be read.
    """
    from octasplat.engine.dataset.damaged_images import read_headers, refuse_damaged
    from octasplat.engine.dataset.photograph_files import image_folder
    from octasplat.engine.poses.photographs import photographs_of_scene

    folder = image_folder(scene)
    infos, faults = read_headers(folder / name for name in photographs_of_scene(scene))
    refuse_damaged(faults, folder)
    counts = Counter((info.width_px, info.height_px) for info in infos.values())
    return [ImageSizes(width, height, count) for (width, height), count in counts.items()]
