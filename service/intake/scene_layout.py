"""Which files make up a scene, by their names.

images/<name>           photographs
masks/<name>.png        masks, where there are any
sparse/0, sparse or colmap/sparse/0 with cameras, images, points3D, rigs, frames (.bin or .txt)
"""

import re
from collections.abc import Sequence
from enum import Enum
from pathlib import PurePosixPath

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".exr", ".hdr"})
"""Of the formats that the engine reads, those whose headers are checked here."""

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")
"""The first that holds a model counts; as in the engine."""

_MODEL_FILE = re.compile(
    r"(sparse|sparse/0|colmap/sparse/0)/(cameras|images|points3D|rigs|frames)\.(bin|txt)"
)
_IGNORED_FILE = re.compile(r"(^|/)(__MACOSX/|\.[^/]*|thumbs\.db$|desktop\.ini$)", re.IGNORECASE)


class FileRole(Enum):
    """What a file is in a scene."""

    IMAGE = "image"
    MASK = "mask"
    MODEL = "model"
    OTHER = "other"


def file_role(name: str) -> FileRole:
    """Return what the file ``name``, relative to the scene, is."""
    if is_ignored_file(name):
        return FileRole.OTHER
    if _MODEL_FILE.fullmatch(name):
        return FileRole.MODEL
    top, slash, rest = name.partition("/")
    if slash and rest and PurePosixPath(rest).suffix.lower() in IMAGE_SUFFIXES:
        return {"images": FileRole.IMAGE, "masks": FileRole.MASK}.get(top, FileRole.OTHER)
    return FileRole.OTHER


def is_ignored_file(name: str) -> bool:
    """Return whether a file is one that file managers leave behind, or hidden."""
    return _IGNORED_FILE.search(name) is not None


def common_folder(names: Sequence[str]) -> str:
    """Return the folder around all of ``names``, with its slash; empty if none or a scene's own."""
    tops = {name.partition("/")[0] if "/" in name else "" for name in names}
    if len(tops) != 1:
        return ""
    top = tops.pop()
    return "" if top in ("", "images", "masks", "sparse", "colmap") else f"{top}/"


def model_files(names: Sequence[str]) -> dict[str, str]:
    """Files of the model that counts, by their last part; empty if there is no model."""
    for folder in MODEL_FOLDERS:
        found = {
            name.rpartition("/")[2]: name
            for name in names
            if name.rpartition("/")[0] == folder and file_role(name) is FileRole.MODEL
        }
        if found:
            return found
    return {}
