"""Sizes of the photographs of a scene, by which costs are estimated."""

from collections import Counter
from pathlib import Path

from octasplat.engine.dataset.image_sizes import ImageSizes


def photograph_sizes(scene: Path) -> list[ImageSizes]:
    """Return the sizes of the photographs in a folder, read from their headers.

    Raises:
        DatasetError: there are none, or some cannot be read.
    """
    from octasplat.engine.core.errors import DamagedImageError
    from octasplat.engine.dataset.damaged_images import refuse_damaged
    from octasplat.engine.dataset.images import read_image_info
    from octasplat.engine.dataset.photograph_files import image_folder
    from octasplat.engine.poses.photographs import photographs_of_scene

    folder = image_folder(scene)
    infos, faults = [], []
    for name in photographs_of_scene(scene):
        try:
            infos.append(read_image_info(folder / name))
        except DamagedImageError as error:
            faults.append(error)
    refuse_damaged(faults, folder)
    counts = Counter((info.width_px, info.height_px) for info in infos)
    return [ImageSizes(width, height, count) for (width, height), count in counts.items()]
