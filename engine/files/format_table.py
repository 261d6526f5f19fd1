"""A table of what can be done with files, which fills itself from the modules of a package."""

import fnmatch
import importlib
import pkgutil
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, TypeVar

from octasplat.engine.core.errors import SceneFileError


@dataclass(frozen=True)
class Entry:
    """One way to read or write one format.

    Attributes:
        name: of the format, unique among entries of one class.
        patterns: file names that it takes, as in ``*.glb``; where two formats match, the pattern with more
            literal characters wins.
    """

    noun: ClassVar[str]
    """For errors, as in "import"."""
    name: str
    patterns: tuple[str, ...]


E = TypeVar("E", bound=Entry)


class FormatTable:
    """Entries of several classes by name. Modules of a package register theirs when they are imported.

    Args:
        package: its modules are imported once, when somebody first asks.
    """

    def __init__(self, package: str) -> None:
        self._package = package
        self._entries: dict[tuple[type[Entry], str], Entry] = {}
        self._is_loaded = False

    def register(self, entry: Entry) -> None:
        """Add an entry.

        Raises:
            ValueError: there is one of that class and name.
        """
        key = (type(entry), entry.name)
        if key in self._entries:
            raise ValueError(f"the {entry.noun} format '{entry.name}' is registered already")
        self._entries[key] = entry

    def entries(self, kind: type[E]) -> tuple[E, ...]:
        """Return all entries of a class, by name."""
        if not self._is_loaded:
            for module in pkgutil.iter_modules(importlib.import_module(self._package).__path__):
                importlib.import_module(f"{self._package}.{module.name}")
            self._is_loaded = True
        found = (entry for entry in self._entries.values() if isinstance(entry, kind))
        return tuple(sorted(found, key=lambda entry: entry.name))

    def get(self, kind: type[E], name: str, path: Path) -> E:
        """Return the entry of that class and name.

        Raises:
            SceneFileError: there is none; the text names ``path`` and lists those that exist.
        """
        by_name = {entry.name: entry for entry in self.entries(kind)}
        if name not in by_name:
            choices = ", ".join(by_name)
            raise SceneFileError(f"{path}: there is no {kind.noun} format '{name}'; choose one of {choices}.")
        return by_name[name]

    def by_file_name(self, kind: type[E], path: Path) -> E | None:
        """Return the entry that takes this file name, or None; upper and lower case are the same."""
        matches = [
            (sum(character not in "*?" for character in pattern), entry)
            for entry in self.entries(kind)
            for pattern in entry.patterns
            if fnmatch.fnmatchcase(path.name.lower(), pattern)
        ]
        return max(matches, key=lambda match: match[0])[1] if matches else None

    def describe_choices(self, kind: type[E]) -> str:
        """Return all entries with their patterns, for errors."""
        return "; ".join(f"{entry.name} ({', '.join(entry.patterns)})" for entry in self.entries(kind))

    def suffixes(self, kind: type[E]) -> str:
        """Return the suffixes that entries take, as in ".glb, .ply or .obj"."""
        found = [pattern.lstrip("*") for entry in self.entries(kind) for pattern in entry.patterns]
        return " or ".join([", ".join(found[:-1]), found[-1]] if len(found) > 1 else found)
