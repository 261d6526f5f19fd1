"""Export as SOG (PlayCanvas), the smallest format, through the program splat-transform where that is."""

import tempfile
from pathlib import Path

from engine.errors import SceneFileError
from engine.files.gaussian_ply import write_gaussian_ply
from engine.files.options import ExportOptions
from engine.files.registry import Exporter, register
from engine.files.selection import selected
from engine.files.splat_transform import convert
from engine.gaussians.model import FlatGaussians
from engine.writing import replacing


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write a bundled SOG; the program puts the Gaussians into an order of its own.

    Raises:
        SceneFileError: nothing to write, values that are not finite, or the program is missing or fails.
    """
    scene = selected(gaussians, path, options)
    try:
        with tempfile.TemporaryDirectory(prefix="octasplat-") as folder, replacing(path) as temporary:
            source, target = Path(folder) / "scene.ply", Path(folder) / "scene.sog"
            write_gaussian_ply(scene, source)
            try:
                convert(source, target)
            except SceneFileError as error:
                raise SceneFileError(str(error).replace(str(target), str(path), 1)) from error
            temporary.write_bytes(target.read_bytes())
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be written ({error.strerror or error}).") from error
    return (path,)


register(Exporter("sog", ("*.sog",), "SOG of PlayCanvas, the smallest; needs splat-transform", write))
