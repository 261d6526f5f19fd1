"""3DGS PLY: the native file, and what most programs of the field write."""

from engine.files.gaussian_ply import read_ply_cloud
from engine.files.importing import Importer, register


def _recognises(head: bytes) -> bool:
    return head.startswith(b"ply") and b"packed_position" not in head


register(
    Importer("gaussians", ("*.ply",), "Gaussians in the PLY layout of 3DGS", read_ply_cloud, _recognises)
)
