"""What the commands that change a scene share: sequences of meshes, targets, and reports in words."""

import glob
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
import numpy as np
from pydantic import BaseModel, ValidationError

from octasplat.engine.edit.deform import DeformReport, deform_to, deformation_corners
from octasplat.engine.edit.recovery import EditOptions, EditReport, recover_edit
from octasplat.engine.errors import ConfigError, SceneFileError
from octasplat.engine.files import ExportOptions, Mesh, export_scene, exporter_for, read_facts, read_mesh
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_facts import SceneFacts
from octasplat.engine.writing import write_json
from octasplat.workers.cli.scene_files import open_scene, warn_of_losses

Say = Callable[[str], None]


def checked_options(model: type[BaseModel], given: dict[str, Any]) -> Any:
    """An options model from what the user gave; None values take the default.

    Raises:
        ConfigError: a value is out of range.
    """
    try:
        return model.model_validate({name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        first = error.errors()[0]
        name = "--" + str(first["loc"][0]).replace("_", "-")
        raise ConfigError(f"{name}: {first['msg'].removeprefix('Value error, ')}.") from None


def mesh_paths(given: Sequence[str]) -> tuple[Path, ...]:
    """Files that the user named, one by one or by patterns such as ``frames/*.ply``.

    The matches of a pattern are in the order of the numbers in their names.

    Raises:
        ConfigError: a pattern matches nothing.
    """
    paths: list[Path] = []
    for text in given:
        if Path(text).exists() or not glob.has_magic(text):
            paths.append(Path(text))
            continue
        matches = sorted(glob.glob(text, recursive=True), key=_natural)  # noqa: PTH207 (may be absolute)
        if not matches:
            raise ConfigError(f"{text}: no file matches this pattern.")
        paths.extend(Path(match) for match in matches)
    return tuple(paths)


def _natural(name: str) -> list[tuple[int, int, str]]:
    """A sort key in which 10 comes after 9."""
    return [
        (0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name) if part
    ]


def targets_for(output: Path, sources: Sequence[Path], inputs: Sequence[Path]) -> tuple[Path, ...]:
    """The file to write for each source: ``output`` for one, numbered files for several.

    Several need a pattern such as ``out/%04d.ply``, a folder (names as those of the sources), or a plain name
    to which ``_0000`` and so on is added.

    Raises:
        ConfigError: a target is one of ``inputs``, or two targets are the same.
        SceneFileError: no format takes the name.
    """
    if "%" in output.name:
        try:
            targets = [output.with_name(output.name % number) for number in range(len(sources))]
        except (TypeError, ValueError):
            raise ConfigError(f"{output}: is no pattern; write one number as in frame_%04d.ply.") from None
    elif len(sources) == 1:
        targets = [output]
    elif output.suffix:
        targets = [
            output.with_name(f"{output.stem}_{number:04d}{output.suffix}") for number in range(len(sources))
        ]
    else:
        targets = [output / f"{source.stem}.ply" for source in sources]
    taken = {path.resolve() for path in inputs if path.exists()}
    for target in targets:
        exporter_for(target)  # complain before the long work
        if target.resolve() in taken:
            raise ConfigError(f"{target}: would overwrite what the command reads; choose another -o.")
    if len(set(targets)) < len(targets):
        raise ConfigError(f"{output}: gives two results the same name; write a pattern such as %04d.ply.")
    return tuple(targets)


def write_scene(
    gaussians: FlatGaussians, facts: SceneFacts, target: Path, say: Say, *, warn: bool = True
) -> None:
    """Write a scene in the format of its name and tell so, and with ``warn`` what the format leaves out."""
    if warn:
        warn_of_losses(gaussians, target)
    export_scene(gaussians, target, ExportOptions(facts=facts))
    say(
        f"Wrote {target}: {exporter_for(target).description.partition(';')[0]}, {len(gaussians):,} Gaussians."
    )


def speaker(quiet: bool) -> Say:
    """What tells the user things, or nothing."""
    return (lambda _line: None) if quiet else click.echo


def run_edit(
    source: Path,
    meshes: Sequence[str],
    output: Path,
    given: dict[str, Any],
    *,
    report_path: Path | None,
    quiet: bool,
) -> None:
    """Recover the scene from each edited mesh and write it.

    Raises:
        OctasplatError: something cannot be read, matched or written.
    """
    options: EditOptions = checked_options(EditOptions, given)
    paths = mesh_paths(meshes)
    targets = targets_for(output, paths, [source, *paths])
    gaussians, facts = open_scene(source, quiet=quiet), read_facts(source)
    say = speaker(quiet)
    reports: list[dict[str, Any]] = []
    for path, target in zip(paths, targets, strict=True):
        result, report = recover_edit(gaussians, read_mesh(path), path, options)
        if options.axes == "auto":  # all frames of a sequence came the same way
            options = options.model_copy(update={"axes": report.axes})
            warning = axes_warning(path, report)
            if warning:
                click.echo(warning, err=True)
        for line in edit_lines(path, report):
            if line.startswith("Warning"):
                click.echo(line, err=True)
            else:
                say(line)
        write_scene(result, facts, target, say, warn=target == targets[0])
        reports.append({"mesh": str(path), "output": str(target), **asdict(report)})
    if report_path is not None:
        write_json(report_path, reports)


def axes_warning(path: Path, report: EditReport) -> str | None:
    """What to tell when a mesh seems to have been turned on its way."""
    if report.axes == report.axes_usual:
        return None
    return (
        f"Warning: {path} came back along other axes than it was written with (as when a mesh changes format "
        f"in Blender) and was turned back; if turning it was your edit, say --axes {report.axes_usual}."
    )


def edit_lines(path: Path, report: EditReport) -> list[str]:
    """A report in words; what did not happen is left out."""
    lines = [
        f"{path}: {report.moved:,} Gaussians moved, {report.unmoved:,} did not "
        f"(vertices found by {report.matched_by})."
    ]
    counts = (
        (report.deleted, "deleted with their octagons"),
        (report.copies, "added, as their octagons were duplicated"),
        (report.carried, "too faint for an octagon, moved as their neighbours"),
        (report.orphaned, "too faint for an octagon, deleted with their neighbours"),
        (report.mirrored, "mirrored with their surroundings"),
        (report.incomplete, "with missing corners"),
        (report.crumpled, "crumpled (folded, without area or far from flat)"),
        (report.flipped, "flipped against their surroundings"),
        (report.dropped, "left out as damaged"),
        (report.snapped, "moved in part, taken as a whole"),
    )
    lines += [f"  {count:,} {what}" for count, what in counts if count]
    if report.partial > report.snapped:
        lines.append(
            f"Warning: {report.partial - report.snapped:,} octagons moved with some corners only, which "
            "makes long streaks: select whole octagons in the editor (Select Linked) or say --whole-octagons."
        )
    if report.foreign_vertices:
        lines.append(f"  {report.foreign_vertices:,} vertices belong to no octagon and were passed over")
    if report.ambiguous_corners:
        lines.append(f"  {report.ambiguous_corners:,} corners were there more than once and were passed over")
    if report.moved:
        lines.append(
            f"  distance from an affine map, in standard deviations: median {report.residual_median:.2g}, "
            f"95th percentile {report.residual_p95:.2g}, largest {report.residual_max:.2g}"
            + (f"; {report.strained:,} above 0.3" if report.strained else "")
        )
    return lines


def run_deform(
    source: Path,
    proxy_path: Path,
    deformed: Sequence[str],
    output: Path,
    *,
    method: str,
    reach: float | None,
    axes: str,
    mirrored: bool | None,
    report_path: Path | None,
    quiet: bool,
) -> None:
    """Bind the scene to a proxy at rest and write it for each deformed proxy.

    ``mirrored`` says whether the proxy was mirrored; None looks at it.

    Raises:
        OctasplatError: something cannot be read or written, or the proxies are not the same mesh.
    """
    from octasplat.engine.edit.proxy import bind

    paths = mesh_paths(deformed)
    targets = targets_for(output, paths, [source, proxy_path, *paths])
    gaussians, facts = open_scene(source, quiet=quiet), read_facts(source)
    say = speaker(quiet)
    rest = read_mesh(proxy_path)
    proxy = _as_proxy(proxy_path, rest, axes, mirrored)
    corners = deformation_corners(gaussians)
    try:
        binding = bind(proxy, corners, "mvc" if method == "mvc" else "nearest", reach)
    except SceneFileError as error:
        raise SceneFileError(f"{proxy_path}: {error}") from None
    moving = int(binding.moving.sum())
    if moving == 0:
        raise SceneFileError(
            f"{proxy_path}: no Gaussian is near enough to be moved; if the proxy was saved along other axes, "
            "as Blender does for OBJ and GLB, say --axes x90, else widen --reach."
        )
    say(f"{proxy_path}: moves {moving:,} of {len(gaussians):,} Gaussians.")
    reports: list[dict[str, Any]] = []
    for path, target in zip(paths, targets, strict=True):
        mesh = read_mesh(path)
        if len(mesh) != len(rest) or not _same_faces(mesh, rest):
            raise SceneFileError(
                f"{path}: is not the mesh {proxy_path} with vertices moved; both need the same vertices and "
                "faces in the same order."
            )
        vertices = _turned(mesh, axes)
        result, report = deform_to(gaussians, corners, binding.deform(vertices), binding.mirrored(vertices))
        for line in deform_lines(path, report):
            say(line)
        write_scene(result, facts, target, say, warn=target == targets[0])
        reports.append({"deformed": str(path), "output": str(target), **asdict(report)})
    if report_path is not None:
        write_json(report_path, reports)


def deform_lines(path: Path, report: DeformReport) -> list[str]:
    """A report in words."""
    line = (
        f"{path}: {report.moved:,} Gaussians moved; distance from an affine map, in standard deviations: "
        f"median {report.residual_median:.2g}, 95th percentile {report.residual_p95:.2g}, "
        f"largest {report.residual_max:.2g}."
    )
    lines = [line]
    if report.mirrored:
        lines.append(f"  {report.mirrored:,} mirrored with the proxy")
    if report.collapsed:
        lines.append(f"  {report.collapsed:,} lost their area and were only placed")
    return lines


def _as_proxy(path: Path, mesh: Mesh, axes: str, mirrored: bool | None) -> Any:
    from octasplat.engine.edit.proxy import Proxy

    try:
        return Proxy(_turned(mesh, axes), mesh.triangles, mirrored)
    except SceneFileError as error:
        raise SceneFileError(f"{path}: {error}") from None


def _turned(mesh: Mesh, axes: str) -> Any:
    from octasplat.engine.edit.axes import TURNS

    return mesh.vertices @ {str(name): turn for name, turn in TURNS.items()}[axes].T


def _same_faces(one: Mesh, other: Mesh) -> bool:
    """Whether the same vertices make triangles; programs may have turned over those of a mirrored mesh."""
    if one.triangles.shape != other.triangles.shape:
        return False
    if np.array_equal(one.triangles, other.triangles):
        return True
    first, second = (np.sort(mesh.triangles, axis=1) for mesh in (one, other))
    return np.array_equal(first[np.lexsort(first.T)], second[np.lexsort(second.T)])
