"""Writing photographs, maps and the mesh of a generated scene."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Bool, Float32, Int32, UInt8, UInt16

from octasplat.engine.core.errors import OutputError


def _write_image(path: Path, pixels: np.ndarray, kind: str, channels: tuple[str, ...]) -> None:
    height, width = pixels.shape[:2]
    spec = oiio.ImageSpec(width, height, len(channels), kind)
    spec.channelnames = channels
    if "A" in channels:
        # PNG stores straight alpha, which is what the pixels are; otherwise they would be divided by it.
        spec.attribute("oiio:UnassociatedAlpha", 1)
    if path.suffix == ".exr":
        spec.attribute("compression", "zip")
        # Otherwise the file holds the time of writing, and equal settings give different bytes.
        spec.attribute("DateTime", "1970:01:01 00:00:00")
    output = oiio.ImageOutput.create(str(path))
    if output is None or not output.open(str(path), spec):
        raise OutputError(
            f"{path} cannot be written: {oiio.geterror() if output is None else output.geterror()}."
        )
    written = output.write_image(np.ascontiguousarray(pixels.reshape(height, width, len(channels))))
    if not (output.close() and written):
        raise OutputError(f"{path} cannot be written: {output.geterror()}.")


def write_channels(path: Path, pixels: UInt8[np.ndarray, "h w c"] | UInt16[np.ndarray, "h w c"]) -> None:
    """Write a PNG of one or three channels as they are, with 8 or 16 bits."""
    _write_image(path, pixels, pixels.dtype.name, ("R", "G", "B") if pixels.shape[2] == 3 else ("Y",))


def write_photograph(path: Path, pixels: UInt8[np.ndarray, "height width channels"]) -> None:
    """Write an RGB or RGBA photograph as PNG."""
    _write_image(path, pixels, "uint8", ("R", "G", "B", "A")[: pixels.shape[2]])


def write_mask(path: Path, mask: Bool[np.ndarray, "height width"]) -> None:
    """Write a mask as grey PNG, white where true."""
    _write_image(path, mask.astype(np.uint8) * np.uint8(255), "uint8", ("Y",))


def write_depth(path: Path, depth_cam: Float32[np.ndarray, "height width"]) -> None:
    """Write depths as OpenEXR, channel Z."""
    _write_image(path, depth_cam, "float", ("Z",))


def write_normals(path: Path, normals: Float32[np.ndarray, "height width 3"]) -> None:
    """Write normals as OpenEXR, channels N.x, N.y, N.z."""
    _write_image(path, normals, "float", ("N.x", "N.y", "N.z"))


def write_mesh(path: Path, vertices: Float32[np.ndarray, "n 3"], faces: Int32[np.ndarray, "m 3"]) -> None:
    """Write a triangle mesh as binary PLY."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("corners", "u1"), ("indices", "<i4", 3)])
    rows["corners"], rows["indices"] = 3, faces
    path.write_bytes(header.encode() + vertices.astype("<f4").tobytes() + rows.tobytes())
