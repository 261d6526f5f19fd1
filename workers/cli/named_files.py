"""Files that the options of a derived job name, as the command line is given them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.portable_names import check_name, name_or
from octasplat.engine.operations import operation, operation_names
from octasplat.engine.operations.file_patterns import expand_patterns
from octasplat.workers.client.submission import Derivation


def with_named_files(derivation: Derivation, files_by_option: Sequence[tuple[str, Path]]) -> Derivation:
    """Return the same with files for options that name some, such as ``("meshes", Path("edited.ply"))``.

    An option that takes several gets all that are given for it, and patterns such as ``frames/*.ply`` stand
    for their matches.

    Raises:
        ConfigError: a file is not there, or several are given for an option that takes one.
    """
    options, files = dict(derivation.options), dict(derivation.files)
    for option in dict.fromkeys(name for name, _ in files_by_option):
        paths = expand_patterns([path for name, path in files_by_option if name == option])
        names = [_upload_name(path, files) for path in paths]
        if _is_list_option(derivation.kind, option):
            options[option] = names
        elif len(names) == 1:
            options[option] = names[0]
        else:
            raise ConfigError(f"{option}: takes one file, and {len(names)} are given.")
    return replace(derivation, options=options, files=files)


def _upload_name(path: Path, files: dict[str, Path]) -> str:
    """Return a name for a file among those that are sent, which it is added to."""
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such file.")
    name = name_or(path.name, f"file_{len(files)}{path.suffix.lower()}")
    if name in files:
        name = check_name(f"{len(files)}/{name}")
    files[name] = path
    return name


def _is_list_option(kind: str, option: str) -> bool:
    """Return whether an option of a verb is a list; one of another kind is taken for one that is not."""
    if kind not in operation_names():
        return False
    schema = operation(kind).options.model_json_schema()["properties"].get(option, {})
    return bool(schema.get("type") == "array")
