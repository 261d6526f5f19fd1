"""Cameras of a job for the 3D view: of its results, of a training under way, or of its photographs."""

import re
from pathlib import PurePosixPath
from typing import Any

from octasplat.engine.core.scene_layout import FileRole, file_role
from octasplat.service.state import Service
from octasplat.service.web.cameras import (
    CamerasUnreadableError,
    PhotographPose,
    read_poses,
    read_view_poses,
    viewer_cameras,
)
from octasplat.service.web.results import TRAINING, VIEWS, read_json, read_json_content, read_names
from octasplat.workers.db.live_scenes import LiveScene
from octasplat.workers.db.rows import Artifact, DatasetFile
from octasplat.workers.storage.errors import StorageError

_POSES_FILE = re.compile(r"poses/(sparse/0/)?[^/]+")
MAX_UNPLACED = 1000
"""Most names of photographs without a place that are listed."""


def viewer_cameras_of_job(
    service: Service,
    artifacts: list[Artifact],
    files: list[DatasetFile],
    held_out: Artifact | None,
    live: LiveScene | None = None,
) -> dict[str, object]:
    """Return the cameras of a job, and the names of the photographs that were not placed."""
    cameras = _posed_cameras(service, artifacts, files, held_out, live)
    placed = cameras.pop("placed", [])
    photographs = [
        file.path.removeprefix("images/")
        for file in files
        if file_role(file.path) is FileRole.IMAGE and file.path.startswith("images/")
    ]
    if placed:
        cameras["unplaced"] = sorted(set(photographs) - set(placed))[:MAX_UNPLACED]
    return cameras


def _posed_cameras(
    service: Service,
    artifacts: list[Artifact],
    files: list[DatasetFile],
    held_out: Artifact | None,
    live: LiveScene | None,
) -> dict[str, Any]:
    """Return the cameras that the job's result keeps, else of its poses or its dataset; none without any.

    Only the first are about the local origin of a scene with large coordinates, as the scene is, and there
    whatever form the poses of the dataset have.
    """
    names = read_names(service.storage, held_out)
    by_name = {row.name: row for row in artifacts}
    content = read_json(service.storage, by_name.get(VIEWS))
    # A training under way has no results yet, but its live scene has cameras.
    if not content and live is not None:
        content = read_json_content(service.storage, live.views_sha256)
        names = [str(view.get("name")) for view in content.get("views", ()) if view.get("held_out")]
    if content and (poses := read_view_poses(content)):
        nearest = read_json(service.storage, by_name.get(TRAINING)).get("nearest_world")
        return _viewer_content(poses, names, nearest if isinstance(nearest, dict) else {})
    found = {
        PurePosixPath(row.name).name: row.sha256
        for row in artifacts
        if _POSES_FILE.fullmatch(row.name)  # in numbered folders lie models that are not taken
    }
    if not found:
        found = {name: row.sha256 for name, row in _model_files(files).items()}
    for suffix in (".bin", ".txt"):
        if f"cameras{suffix}" not in found or f"images{suffix}" not in found:
            continue
        try:
            with (
                service.storage.open(found[f"cameras{suffix}"]) as cameras,
                service.storage.open(found[f"images{suffix}"]) as images,
            ):
                poses = read_poses(cameras, images, binary=suffix == ".bin")
        except (CamerasUnreadableError, StorageError):
            break
        if poses:
            return _viewer_content(poses, names, {})
    return {"views": []}


def _viewer_content(
    poses: list[PhotographPose], held_out: list[str], nearest: dict[str, Any]
) -> dict[str, Any]:
    numbers = {name: float(value) for name, value in nearest.items() if isinstance(value, int | float)}
    return {**viewer_cameras(poses, held_out, numbers), "placed": [pose.name for pose in poses]}


def _model_files(files: list[DatasetFile]) -> dict[str, DatasetFile]:
    """Return the files of the model with the most of images, by their last part."""
    models: dict[PurePosixPath, dict[str, DatasetFile]] = {}
    for file in files:
        if file_role(file.path) is FileRole.MODEL:
            path = PurePosixPath(file.path)
            models.setdefault(path.parent, {})[path.name] = file

    def image_bytes(model: dict[str, DatasetFile]) -> int:
        return max((file.size_bytes for name, file in model.items() if name.startswith("images.")), default=0)

    return max(models.values(), key=image_bytes, default={})
