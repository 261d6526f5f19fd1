"""Which files make up a scene, by their paths: the one decision for folders, archives, uploads and runs.

images/<name>, or input/<name>      photographs; without these folders all photographs that there are
masks/<name>.png                    masks, where there are any
depths/<name>.png, or depth/        depth maps, where there are any, see
                                    :mod:`octasplat.engine.dataset.depth_maps`
sparse, colmap/sparse, distorted/sparse, each also with a number below it: cameras, images, points3D, rigs
                                    and frames (.bin or .txt); the same beside the photographs, if all are
                                    there, as Metashape and RealityScan export them
transforms.json, or transforms_train.json, transforms_test.json and transforms_val.json, and <name>.ply with
                                    the points that they name: poses as nerfstudio, instant-ngp and Blender
                                    scenes have them
geometry.ply, .obj, .glb, .las, .laz    what is known of the geometry, see
                                    :mod:`octasplat.engine.dataset.known_geometry`
gcp_list.txt, control_points.csv    ground control points, see :mod:`octasplat.engine.georeference`
"""

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import PurePosixPath

from octasplat.engine.core.name_lists import name_list

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".exr", ".hdr"})
"""Photographs that are taken at every door."""
UNREAD_SUFFIXES = frozenset(
    {".heic", ".heif", ".avif", ".jxl", ".jp2", ".gif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf"}
    | {".orf", ".rw2", ".pef", ".srw", ".raw", ".insp", ".ppm", ".pgm", ".tga", ".dpx", ".psd", ".j2k"}
)
"""Photographs in formats that are not taken."""
_PHOTOGRAPH_SUFFIXES = IMAGE_SUFFIXES | UNREAD_SUFFIXES
ARCHIVE_SUFFIXES = frozenset({".zip", ".7z", ".rar", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".zst"})
VIDEO_SUFFIXES = frozenset({".mov", ".mp4", ".m4v", ".avi", ".mkv", ".mts", ".webm", ".insv", ".360"})
IMAGES = "images/"
"""What the names of a scene's photographs begin with."""
POSE_RECORD = "poses.json"
"""Beside the files of a model that a run keeps: what was found, or changed of the model that was given."""
MIN_PHOTOGRAPHS = 3
"""Fewer photographs than this do not make a scene."""
DEPTH_FOLDERS = ("depths", "depth")
"""Folders of depth maps, in the order in which they are looked for."""
SCENE_FOLDERS = ("images", "masks", *DEPTH_FOLDERS, "sparse", "colmap", "distorted")
"""Folders whose names say what is in them."""

MASK_ENDING = "_mask"
"""What the name of a mask that lies beside its photograph ends with, before the suffix."""

_MODEL_FILE = re.compile(
    r"((colmap/|distorted/)?sparse(/[0-9]+)?/)?(cameras|images|points3D|rigs|frames)\.(bin|txt)"
)
_CONTROL_FILE = re.compile(r"gcp_list\.txt|control_points\.csv")
_GEOMETRY_FILE = re.compile(r"geometry\.(ply|obj|glb|las|laz)", re.IGNORECASE)
_POSES_FILE = re.compile(r"transforms(_train|_test|_val)?\.json")
_POINTS_FILE = re.compile(r"[^/]+\.ply", re.IGNORECASE)
_MODEL_ELSEWHERE = re.compile(r"(.*/)?images\.(bin|txt)")
# Of Metashape, Bundler, VisualSFM, OpenSfM and Polycam.
_POSES_OF_OTHERS = re.compile(
    r"(.*/)?(cameras\.xml|bundle\.out|[^/]+\.nvm|reconstruction\.json|(corrected_)?cameras/[^/]+\.json)",
    re.IGNORECASE,
)
# RealityScan, formerly RealityCapture, writes poses to both; so do others for other ends.
_TABLE_SUFFIXES = frozenset({".xmp", ".csv"})
SIDECAR_SUFFIX = ".xmp"
"""Of files beside photographs: with poses by RealityScan, with settings by programs that develop them."""
# "Icon\r" is the icon of a folder on macOS; "." and ".." are not hidden files.
_IGNORED_FILE = re.compile(
    r"(^|/)(__MACOSX/|\.(?!\.?(/|$))[^/]*|thumbs\.db$|desktop\.ini$|Icon\r?$)", re.IGNORECASE
)
_GENERATED_FILE = re.compile(
    r"(.*/)?(generated\.json|ground_truth/(mesh\.ply|(depth|normals)/[^/]+\.exr|masks/[^/]+\.png))"
)
"""What a generated scene has beside its photographs, and nobody misses among them."""


class FileRole(Enum):
    """Role of a file in a dataset."""

    IMAGE = "image"
    MASK = "mask"
    DEPTH = "depth"
    MODEL = "model"
    CONTROL = "control"
    GEOMETRY = "geometry"
    OTHER = "other"


_DEPTHS = tuple((folder,) for folder in DEPTH_FOLDERS)
_MAP_FOLDERS = (*_DEPTHS, ("confidence",))
_MAP_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".exr"})
_PHOTOGRAPH_FOLDERS = (("images",), ("input",))
_KEPT_ROLES = (FileRole.MODEL, FileRole.MASK, FileRole.DEPTH, FileRole.CONTROL, FileRole.GEOMETRY)
"""Roles of files that keep their names; photographs are moved to ``images/``."""
_ROLES_BY_FOLDER = {
    "images": FileRole.IMAGE,
    "masks": FileRole.MASK,
    **dict.fromkeys(DEPTH_FOLDERS, FileRole.DEPTH),
}


RUN_FILES = frozenset({"config.json", "events.jsonl"})
"""At the top of the folder of a run."""


@dataclass(frozen=True)
class SceneLayout:
    """Files that belong to a dataset, among others.

    Attributes:
        files: the path of each file of the scene by its name in the scene, e.g. ``images/a.jpg``.
        left_out: paths of the other files, but for those that are ignored.
        ignored: paths of what file managers leave behind, of hidden files, and of the ground truth of a
            generated scene.
        folder: the folder, with its slash, that is around everything; empty where there is none.
        without_poses: paths of files left out that might hold poses by their names and do not.
    """

    files: Mapping[str, str]
    left_out: tuple[str, ...]
    ignored: tuple[str, ...]
    folder: str
    without_poses: frozenset[str] = frozenset()

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what is left out, with names relative to the folder around everything."""
        names = sorted(path.removeprefix(self.folder) for path in self.left_out)
        return left_out_sentences(names, {path.removeprefix(self.folder) for path in self.without_poses})


def lay_out_scene(
    paths: Sequence[str], holds_poses: Callable[[str], bool] = lambda _path: True
) -> SceneLayout:
    """Return which of the files below a folder, or in an archive, make up a scene.

    Args:
        paths: of the files.
        holds_poses: whether an XMP file has poses in it, where that can be told.

    >>> lay_out_scene(["DCIM/100MEDIA/a.JPG", "DCIM/100MEDIA/a.MOV"]).files
    {'images/a.JPG': 'DCIM/100MEDIA/a.JPG'}
    """
    ignored = tuple(path for path in paths if is_ignored_file(path) or _GENERATED_FILE.fullmatch(path))
    known = set(ignored)
    rest = [path for path in paths if path not in known]
    folder = common_folder(rest)
    names = {path: path.removeprefix(folder) for path in rest}
    results = results_folders(names.values())
    photographs = {name for name in names.values() if is_photograph(name, results)}
    top = next((top for top in (IMAGES, "input/") if any(name.startswith(top) for name in photographs)), "")
    if not top and is_results_folder(names.values()):
        photographs = set()
    unused = _unused_model_files(names.values())
    files: dict[str, str] = {}
    for path, name in names.items():
        if name not in unused and file_role(name) in _KEPT_ROLES:
            files[name] = path
        elif name.startswith(top) and name in photographs:
            files[f"images/{name.removeprefix(top)}"] = path
    taken = set(files.values())
    left_out = tuple(path for path in rest if path not in taken)
    sidecars = (path for path in left_out if PurePosixPath(path).suffix.lower() == SIDECAR_SUFFIX)
    without_poses = frozenset(path for path in sidecars if not holds_poses(path))
    return SceneLayout(files, left_out, ignored, folder, without_poses)


def _unused_model_files(names: Iterable[str]) -> set[str]:
    """Return files that may be of a model but are not: parts of one at the top, points without poses."""
    at_top = {name for name in names if "/" not in name}
    forms = ({f"{part}{suffix}" for part in ("cameras", "images", "points3D")} for suffix in (".bin", ".txt"))
    unused = set() if any(form <= at_top for form in forms) else set(filter(_MODEL_FILE.fullmatch, at_top))
    if not at_top & {"transforms.json", "transforms_train.json"}:
        unused |= {name for name in at_top if _POSES_FILE.fullmatch(name) or _POINTS_FILE.fullmatch(name)}
    return {name for name in unused if not is_geometry_file(name)}


def is_photograph(name: str, results: Iterable[str] = ()) -> bool:
    """Return whether a file is a photograph by its path: no mask, no depth map, and no result of a run.

    Args:
        name: path below the folder of the scene.
        results: folders of runs, with their slashes.
    """
    folders = PurePosixPath(name).parts[:-1]
    is_map = "masks" in folders or folders[:1] in _DEPTHS or _is_map_of_camera(name, folders)
    return _is_picture(name) and not is_map and not any(name.startswith(folder) for folder in results)


def _is_map_of_camera(name: str, folders: tuple[str, ...]) -> bool:
    """Return whether a file is what depth cameras write for each photograph, in a folder further below."""
    is_precise = PurePosixPath(name).suffix.lower() in _MAP_SUFFIXES  # photographs are JPEG there
    return is_precise and folders[-1:] in _MAP_FOLDERS and folders[:1] not in _PHOTOGRAPH_FOLDERS


def results_folders(names: Iterable[str]) -> tuple[str, ...]:
    """Return the folders of runs among files, with their slashes."""
    known = set(names)
    heads = [name.removesuffix("events.jsonl") for name in known if name.endswith("/events.jsonl")]
    return tuple(head for head in heads if f"{head}config.json" in known)


def is_results_folder(names: Iterable[str]) -> bool:
    """Return whether a folder with these files is that of a run, whose renders are no photographs."""
    return set(names) >= RUN_FILES


def file_role(name: str) -> FileRole:
    """Return what the file ``name``, relative to the scene, is."""
    if is_ignored_file(name):
        return FileRole.OTHER
    if is_geometry_file(name):
        return FileRole.GEOMETRY
    if any(pattern.fullmatch(name) for pattern in (_MODEL_FILE, _POSES_FILE, _POINTS_FILE)):
        return FileRole.MODEL
    if _CONTROL_FILE.fullmatch(name):
        return FileRole.CONTROL
    top, slash, rest = name.partition("/")
    if slash and rest and _is_picture(rest):
        return _ROLES_BY_FOLDER.get(top, FileRole.OTHER)
    return FileRole.OTHER


def is_geometry_file(name: str) -> bool:
    """Return whether a file, by its path below the folder of the scene, is its known geometry."""
    return _GEOMETRY_FILE.fullmatch(name) is not None


def is_ignored_file(name: str) -> bool:
    """Return whether a file is one that file managers leave behind, or hidden."""
    return _IGNORED_FILE.search(name) is not None


def common_folder(names: Sequence[str]) -> str:
    """Return the folder, with its slash, around all of ``names``; empty where there is none.

    It ends above a folder whose name says what is in it.
    """
    folder = ""
    while True:
        tops = {name[len(folder) :].partition("/")[0] if "/" in name[len(folder) :] else "" for name in names}
        top = tops.pop() if len(tops) == 1 else ""
        if top in ("", *SCENE_FOLDERS):
            return folder
        folder += f"{top}/"


def masks_beside(names: Iterable[str]) -> dict[str, str]:
    """Return the names that are masks of others among them, as ``a_mask.png`` of ``a.jpg``.

    Args:
        names: paths of images, with forward slashes.

    Returns:
        The photograph of each mask.

    >>> masks_beside(["a.jpg", "a_mask.png", "b_MASK.png", "the_mask.jpg"])
    {'a_mask.png': 'a.jpg'}
    """
    by_stem = {str(PurePosixPath(name).with_suffix("")).casefold(): name for name in names}
    owners = {}
    for stem, name in by_stem.items():
        if stem.endswith(MASK_ENDING) and (owner := by_stem.get(stem.removesuffix(MASK_ENDING))) is not None:
            owners[name] = owner
    return owners


def too_few_photographs(count: int) -> str | None:
    """Return the sentence that refuses a scene of so many photographs; None where they are enough."""
    if count >= MIN_PHOTOGRAPHS:
        return None
    formats = "JPEG, PNG, TIFF, WebP, BMP, EXR and HDR are read"
    return f"There are {count} photographs; at least {MIN_PHOTOGRAPHS} are needed ({formats})."


def left_out_sentences(paths: Sequence[str], without_poses: Collection[str] = frozenset()) -> tuple[str, ...]:
    """Return what to say of files that are left out: how many of each kind, which, and the way out.

    Args:
        paths: of the files.
        without_poses: those that might hold poses by their names and do not.
    """
    kinds: dict[str, list[str]] = {}
    results = ("",) if is_results_folder(paths) else results_folders(paths)
    for path in paths:
        kind = "results" if path.startswith(results) else _kind_of(path)
        kind = "other" if kind == "table" and path in without_poses else kind
        kinds.setdefault(kind, []).append(path)
    return tuple(
        sentence.format(count=len(kinds[kind]), names=name_list(kinds[kind]))
        for kind, sentence in _SENTENCES.items()
        if kind in kinds
    )


_SENTENCES = {
    "results": "{count} files of results among the photographs are left out ({names}).",
    "unread": "{count} files look like photographs but are of formats that are not read, and are left out "
    "({names}); convert them to JPEG, PNG or TIFF.",
    "picture": "{count} photographs do not lie where those of the scene do and are left out ({names}); move "
    "them into its images folder.",
    "video": "{count} videos are left out ({names}); save frames of them as photographs.",
    "archive": "{count} archives are left out ({names}); unpack them first.",
    "poses": "{count} files hold poses that are not read ({names}); to use them, put them as a COLMAP "
    "model into sparse/0.",
    "table": "{count} XMP and CSV files are left out ({names}); if they hold poses of RealityScan "
    "(RealityCapture), these are not read: to use them, export its registration as a COLMAP model into "
    "sparse/0.",
    "other": "{count} files are no part of a scene and are left out ({names}).",
}


def _kind_of(path: str) -> str:
    pure = PurePosixPath(path)
    suffix = pure.suffix.lower()
    if suffix in UNREAD_SUFFIXES:
        return "unread"
    if _is_picture(path):
        return "picture"
    if suffix in VIDEO_SUFFIXES:
        return "video"
    if suffix in ARCHIVE_SUFFIXES:
        return "archive"
    if suffix in _TABLE_SUFFIXES:
        # after the whole name of a photograph, as darktable names them: RealityScan leaves its suffix out
        is_edit = suffix == SIDECAR_SUFFIX and PurePosixPath(pure.stem).suffix.lower() in _PHOTOGRAPH_SUFFIXES
        return "other" if is_edit else "table"
    is_transforms = pure.name.startswith("transforms") and suffix == ".json"
    is_poses = is_transforms or _MODEL_ELSEWHERE.fullmatch(path) or _POSES_OF_OTHERS.fullmatch(path)
    return "poses" if is_poses else "other"


def _is_picture(name: str) -> bool:
    return PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES
