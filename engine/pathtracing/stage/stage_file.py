"""Stage files: TOML read and validated. Imports neither torch nor numba."""

import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.pathtracing.stage.materials import TEXTURE_KEYS, Glass
from octasplat.engine.pathtracing.stage.model import Stage, StageMesh
from octasplat.engine.pathtracing.stage.sidecar_files import sidecar_files
from octasplat.engine.pathtracing.stage.stage_errors import stage_error

MAX_STAGE_BYTES = 16 << 20


def read_stage(path: Path) -> Stage:
    """Return the stage of a TOML file, its files' names made relative to the file's folder.

    Raises:
        ConfigError: no such file, no TOML, an unknown key, a value out of range, or a file that it names
            and that is not there.
    """
    try:
        if path.stat().st_size > MAX_STAGE_BYTES:
            raise ConfigError(f"{path}: is larger than {MAX_STAGE_BYTES >> 20} MB, which no stage needs.")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: the stage cannot be read ({error}).") from None
    stage = parse_stage(text, str(path))
    for key, name in referenced_files(stage):
        if not (path.parent / name).is_file():
            raise ConfigError(f"{path}: {key}: there is no file {path.parent / name}.")
    return stage


def parse_stage(text: str, name: str) -> Stage:
    """Return the stage of a TOML text; ``name`` is what errors call it.

    Raises:
        ConfigError: no TOML, an unknown key, or a value out of range.
    """
    try:
        return Stage.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name}: is no TOML: {toml_complaint(text, error)}.") from None
    except ValidationError as error:
        raise ConfigError(f"{name}: {stage_error(error.errors()[0])[1]}") from None


def toml_complaint(text: str, error: Exception) -> str:
    """Return what is wrong with a TOML text, with the rule that numbers begin with a digit where it helps."""
    lines, place = text.splitlines(), re.search(r"line (\d+)", str(error))
    line = lines[int(place[1]) - 1] if place is not None and int(place[1]) <= len(lines) else ""
    if number := re.search(r"(?<![\w.])[-+]?\.\d+", line):
        return f"{error}; write {number[0].replace('.', '0.')} for {number[0]}"
    return str(error)


def referenced_files(stage: Stage) -> Iterator[tuple[str, str]]:
    """Return the key and the name of every file that a stage names."""
    if stage.environment is not None:
        yield "environment.file", stage.environment.file
    for number, scene in enumerate(stage.gaussians):
        if scene.file is not None:
            yield f"gaussians[{number}].file", scene.file
    for number, mesh in enumerate(stage.meshes):
        if mesh.file is not None:
            yield f"meshes[{number}].file", mesh.file
        for key in TEXTURE_KEYS:
            texture = getattr(mesh.material, key, None)
            if texture is not None:
                yield f"meshes[{number}].material.{key}", texture


def glass_meshes(stage: Stage) -> dict[int, StageMesh]:
    """Return the meshes of files that are to be glass, and so must be closed, by their numbers."""
    return {
        number: mesh
        for number, mesh in enumerate(stage.meshes)
        if mesh.file is not None and isinstance(mesh.material, Glass)
    }


def stage_identity(stage: Stage, folder: Path) -> tuple[object, ...]:
    """Return what of a stage decides how an image looks: the stage, and the files that it names.

    Args:
        stage: the stage.
        folder: where the names of its files are relative to.
    """
    files = [folder / name for _, name in referenced_files(stage)]
    return stage, files, [path.parent / name for path in files for name in sidecar_files(path)]


def with_renamed_files(stage: Stage, names: Mapping[str, str]) -> Stage:
    """Return the stage with its files under other names, keyed by their present ones."""
    content = stage.model_dump(mode="json")
    for key, name in referenced_files(stage):
        *path, last = key.replace("[", ".").replace("]", "").split(".")
        place: Any = content
        for part in path:
            place = place[int(part) if part.isdigit() else part]
        place[last] = names.get(name, name)
    return Stage.model_validate(content)
