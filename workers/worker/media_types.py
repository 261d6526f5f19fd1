"""Media types of files, by their names."""

import mimetypes
from pathlib import PurePosixPath

_MEDIA_TYPES = {
    ".ply": "application/octet-stream",
    ".npz": "application/octet-stream",
    ".bin": "application/octet-stream",
    ".spz": "application/octet-stream",
    ".splat": "application/octet-stream",
    ".exr": "image/x-exr",
    ".hdr": "image/vnd.radiance",
    ".webp": "image/webp",
    ".glb": "model/gltf-binary",
    ".gltf": "model/gltf+json",
    ".obj": "model/obj",
    ".mtl": "model/mtl",
    ".stl": "model/stl",
    ".jsonl": "application/jsonl",
}


def media_type(name: str) -> str:
    """Return the media type of a file of that name."""
    suffix = PurePosixPath(name).suffix.lower()
    return _MEDIA_TYPES.get(suffix) or mimetypes.guess_type(name)[0] or "application/octet-stream"
