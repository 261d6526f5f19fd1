"""A table of file formats that fills itself from the modules of a package, for reading and for writing."""

import fnmatch
import importlib
import pkgutil
from pathlib import Path
from typing import Generic, Protocol, TypeVar, runtime_checkable

from engine.errors import SceneFileError


@runtime_checkable
class Format(Protocol):
    """A named file format with the file names that it takes, as in ``*.glb``."""

    @property
    def name(self) -> str:
        """What ``format=`` calls it."""
        ...

    @property
    def patterns(self) -> tuple[str, ...]:
        """File names that it takes; where two formats match, more literal characters win."""
        ...


F = TypeVar("F", bound=Format)


class FormatTable(Generic[F]):
    """Formats by name. Modules of a package that hold one register it when they are imported.

    Args:
        package: its modules are imported once, when somebody first asks.
        noun: for errors, as in "import".
    """

    def __init__(self, package: str, noun: str) -> None:
        self._package = package
        self._noun = noun
        self._known: dict[str, F] = {}
        self._complete = False

    def register(self, entry: F) -> F:
        """Add a format.

        Raises:
            ValueError: there is one of that name.
        """
        if entry.name in self._known:
            raise ValueError(f"an {self._noun}er named '{entry.name}' is registered already")
        self._known[entry.name] = entry
        return entry

    def all(self) -> tuple[F, ...]:
        """All formats, by name."""
        if not self._complete:
            for module in pkgutil.iter_modules(importlib.import_module(self._package).__path__):
                importlib.import_module(f"{self._package}.{module.name}")
            self._complete = True
        return tuple(self._known[name] for name in sorted(self._known))

    def named(self, name: str, path: Path) -> F:
        """The format of that name.

        Raises:
            SceneFileError: there is none; the text names ``path`` and lists those that exist.
        """
        by_name = {entry.name: entry for entry in self.all()}
        if name not in by_name:
            choices = ", ".join(by_name)
            raise SceneFileError(
                f"{path}: there is no {self._noun} format '{name}'; choose one of {choices}."
            )
        return by_name[name]

    def by_file_name(self, path: Path, otherwise: str) -> F:
        """The format that takes this file name; upper and lower case are the same.

        Raises:
            SceneFileError: there is none: ``otherwise``, and the formats with their patterns.
        """
        matches = [
            (sum(character not in "*?" for character in pattern), entry)
            for entry in self.all()
            for pattern in entry.patterns
            if fnmatch.fnmatchcase(path.name.lower(), pattern)
        ]
        if not matches:
            choices = "; ".join(f"{entry.name} ({', '.join(entry.patterns)})" for entry in self.all())
            raise SceneFileError(f"{path}: {otherwise}; the formats are {choices}.")
        return max(matches, key=lambda match: match[0])[1]
