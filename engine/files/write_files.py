"""Scenes and surfaces written to files of any known format."""

from collections.abc import Sequence
from pathlib import Path

from octasplat.engine.core.errors import ConfigError, SceneFileError
from octasplat.engine.core.local_origin import describe_origin, is_set
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.registry import SurfaceWriter, exporter_for, surface_suffixes, surface_writer_for
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import UNKNOWN_METADATA, SceneMetadata
from octasplat.engine.geometry.triangle_mesh import TriangleMesh


def export_scene(
    gaussians: FlatGaussians, path: Path, options: ExportOptions | None = None, format: str | None = None
) -> tuple[Path, ...]:
    """Write ``gaussians`` to ``path`` in the format that its name or ``format`` says.

    Formats without a place for named channels or harmonics leave them out; :func:`dropped_on_export` tells.

    Returns:
        Every file written, ``path`` first.

    Raises:
        SceneFileError: no such format, nothing to write, values that are not finite, or a file that cannot be
            written.
    """
    exporter = exporter_for(path, format)
    try:
        return exporter.write(gaussians, path, options or ExportOptions())
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be written ({error.strerror or error}).") from error


def dropped_on_export(
    gaussians: FlatGaussians,
    paths: Sequence[Path],
    format: str | None = None,
    *,
    facts: SceneMetadata = UNKNOWN_METADATA,
) -> tuple[str, ...]:
    """Return what :func:`export_scene` will leave out at all of ``paths``, a sentence for each loss.

    Args:
        gaussians: the scene.
        paths: the files.
        format: name of the format, if the files' names do not say it.
        facts: what is known of the scene as a whole.

    Raises:
        SceneFileError: there is no such format.
    """
    chosen = {exporter.name: exporter for exporter in (exporter_for(path, format) for path in paths)}
    lines = []
    without = [name for name, exporter in chosen.items() if not exporter.holds_channels]
    if gaussians.channels and without:
        names = ", ".join(gaussians.channels)
        lines.append(
            f"{_format_list_text(without, 'has', 'have')} no place for named channels; "
            f"{names} will be left out."
        )
    without = [name for name, exporter in chosen.items() if not exporter.holds_harmonics]
    if gaussians.sh_degree > 0 and without:
        lines.append(
            f"{_format_list_text(without, 'has', 'have')} one color for each Gaussian; "
            "how colors change with the direction will be left out (octasplat export --color "
            "chooses the one)."
        )
    without = [name for name, exporter in chosen.items() if not exporter.holds_origin]
    if is_set(facts.origin_world) and without:
        lines.append(
            f"{_format_list_text(without, 'has', 'have')} no place for the origin of large coordinates; add "
            f"{describe_origin(facts.origin_world)} to its positions."
        )
    if facts.georeference is not None and without:
        lines.append(
            f"{_format_list_text(without, 'has', 'have')} no place for the georeference: "
            f"{facts.georeference.describe()}."
        )
    for exporter in chosen.values():
        lines += exporter.find_place_losses(facts)
        lines += exporter.find_losses(gaussians)
    return tuple(lines)


def _format_list_text(names: Sequence[str], one: str, several: str) -> str:
    """Return the formats as the subject of a sentence, and its verb."""
    if len(names) == 1:
        return f"The format {names[0]} {one}"
    return f"The formats {', '.join(names[:-1])} and {names[-1]} {several}"


def check_surface_path(
    path: Path, *, textured: bool, lit: bool = False, is_written_here: bool = True
) -> None:
    """Refuse names that no writer takes, before the long work.

    Args:
        path: of the surface.
        textured: whether it has a texture.
        lit: whether it has materials.
        is_written_here: whether what the format needs is to be installed on this machine.

    Raises:
        ConfigError: the suffix is unknown, or cannot hold a texture or materials, or needs what is missing.
    """
    writer = _surface_writer(path, textured, lit)
    if is_written_here and (lacking := writer.missing_requirement()) is not None:
        raise ConfigError(f"{path}: {lacking}.")


def surface_files(path: Path, *, textured: bool) -> tuple[Path, ...]:
    """Return every file that a surface is written to, ``path`` first.

    Raises:
        ConfigError: the suffix is unknown, or cannot hold a texture.
    """
    writer = _surface_writer(path, textured, False)
    return (path, *(writer.beside(path) if textured else ()))


def write_surface(
    mesh: TriangleMesh, path: Path, turn_xyzw: Sequence[float] | None = None
) -> tuple[Path, ...]:
    """Write ``mesh`` as its suffix says, and return every file written, ``path`` first.

    GLB: unlit, the colors being those of the photographs with their light; normals are there for who wants
    to light it anew. Its root node turns the scene upright. With materials it is lit, and the node turns the
    light's up to glTF's. USDZ likewise, but a georeference says its place and its metres. PLY and
    OBJ keep the world frame. OBJ with vertex colors writes them behind the positions; with a texture, an MTL
    and a PNG lie beside it.

    Args:
        mesh: the surface.
        path: the file.
        turn_xyzw: rotation (x, y, z, w) that turns the scene upright, y up; None is half a turn about x,
            which brings COLMAP's frame to glTF's.

    Raises:
        ConfigError: the suffix does not fit.
        SceneFileError: the file cannot be written.
    """
    writer = _surface_writer(path, mesh.texture_srgb is not None, mesh.materials is not None)
    try:
        return writer.write(mesh, path, turn_xyzw)
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be written ({error.strerror or error}).") from error


def _surface_writer(path: Path, textured: bool, lit: bool) -> SurfaceWriter:
    writer = surface_writer_for(path)
    if writer is None:
        raise ConfigError(f"{path}: a surface is written as {surface_suffixes()}; name one of these.")
    if lit and not writer.lit:
        raise ConfigError(
            f"{path}: materials are written as .glb or .usdz; name one, or leave the materials out."
        )
    if textured and not writer.textured:
        raise ConfigError(
            f"{path}: a PLY holds no texture; name a .glb, .obj or .usdz, or leave the texture out."
        )
    return writer
