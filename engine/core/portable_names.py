"""Names of files that every system can hold: relative, portable, and distinct on every file system.

Uploads take no others. An invalid name is refused, never repaired, so that users see the names that they
sent.
"""

import re
import unicodedata
from collections.abc import Iterable

from octasplat.engine.core.errors import DatasetError

MAX_NAME_BYTES = 1000
MAX_COMPONENT_BYTES = 240
MAX_DEPTH = 12

_SHOWN_NAMES = 3
# Windows reserves these with any suffix or spaces after them, and takes superscript digits for 1 to 3.
_RESERVED_NAMES = re.compile(
    r"(con|prn|aux|nul|conin\$|conout\$|clock\$|(com|lpt)[0-9\u00b9\u00b2\u00b3]) *(\..*)?",
    re.IGNORECASE | re.DOTALL,
)
_FORBIDDEN_CHARACTERS = frozenset('<>:"|?*')


class FileNameError(DatasetError):
    """A file name that is refused; ``code`` names the reason."""

    error_type = "name_refused"

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


def check_name(name: str) -> str:
    """Return the name itself, if it is a relative path with forward slashes that every system can hold.

    Raises:
        FileNameError: with the code ``name-empty``, ``name-too-long``, ``name-not-text``, ``name-nul``,
            ``name-control``, ``name-unc``, ``name-backslash``, ``name-absolute``, ``name-drive``,
            ``name-character``, ``name-empty-part``, ``name-traversal``, ``name-trailing``, ``name-reserved``
            or ``name-too-deep``.
    """
    if not name:
        raise FileNameError("name-empty", "A file has an empty name.")
    quoted = quoted_name(name)
    try:
        encoded = name.encode("utf-8")
    except UnicodeEncodeError:
        raise FileNameError("name-not-text", f"The file name {quoted} is not valid Unicode.") from None
    if len(encoded) > MAX_NAME_BYTES:
        raise FileNameError("name-too-long", f"The file name {quoted} is longer than {MAX_NAME_BYTES} bytes.")
    if "\0" in name:
        raise FileNameError("name-nul", f"The file name {quoted} contains a NUL character.")
    # Cf holds the marks that turn the direction of writing, with which a name can look like another.
    if any(unicodedata.category(letter) in ("Cc", "Cf", "Zl", "Zp") for letter in name):
        raise FileNameError("name-control", f"The file name {quoted} contains invisible characters.")
    if name.startswith(("\\\\", "//")):
        raise FileNameError("name-unc", f"The file name {quoted} is a network path; names must be relative.")
    if "\\" in name:
        raise FileNameError(
            "name-backslash", f"The file name {quoted} contains a backslash; use forward slashes."
        )
    if name.startswith("/"):
        raise FileNameError("name-absolute", f"The file name {quoted} is absolute; names must be relative.")
    if re.match("[A-Za-z]:", name):
        raise FileNameError(
            "name-drive", f"The file name {quoted} begins with a drive; names must be relative."
        )
    if _FORBIDDEN_CHARACTERS & set(name):
        raise FileNameError(
            "name-character",
            f'The file name {quoted} contains one of < > : " | ? *, which not every system takes.',
        )
    parts = name.split("/")
    if len(parts) > MAX_DEPTH:
        raise FileNameError("name-too-deep", f"The file name {quoted} has more than {MAX_DEPTH} parts.")
    for part in parts:
        _check_component(part, quoted)
    return name


def name_or(name: str, alternative: str) -> str:
    """Return the name if it is valid, else the alternative, see :func:`check_name`.

    Raises:
        FileNameError: the alternative is not valid either.
    """
    try:
        return check_name(name)
    except FileNameError:
        return check_name(alternative)


def _check_component(component: str, quoted: str) -> None:
    if not component:
        raise FileNameError(
            "name-empty-part", f"The file name {quoted} has an empty part (two slashes, or one at the end)."
        )
    if component in (".", ".."):
        raise FileNameError(
            "name-traversal",
            f"The file name {quoted} contains '{component}' as a part, which may lead elsewhere.",
        )
    # Windows drops a dot or a space at the end, so that two names would be one file.
    if component.endswith((".", " ")) or component.startswith(" "):
        raise FileNameError(
            "name-trailing",
            f"The file name {quoted} has a part that begins with a space or ends with a dot or a space.",
        )
    if _RESERVED_NAMES.fullmatch(component):
        raise FileNameError(
            "name-reserved", f"The file name {quoted} contains a name that Windows keeps for devices."
        )
    if len(component.encode("utf-8")) > MAX_COMPONENT_BYTES:
        raise FileNameError(
            "name-too-long", f"The file name {quoted} has a part longer than {MAX_COMPONENT_BYTES} bytes."
        )


def collision_key(name: str) -> str:
    """Return the key that names share which some file system treats as equal: NFC without case."""
    # Canonical caseless matching (Unicode, D145): folding the case can undo a normal form.
    return unicodedata.normalize(
        "NFC", unicodedata.normalize("NFD", unicodedata.normalize("NFD", name).casefold())
    )


def is_text(path: object) -> bool:
    """Return whether a path is valid Unicode, which some libraries need."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def quoted_name(name: str) -> str:
    """Return a name for use in a sentence: quoted, escaped and cut."""
    text = name if len(name) <= 80 else f"{name[:60]}...{name[-15:]}"
    return ascii(text) if not text.isprintable() or "\\" in text else f"'{text}'"


def unportable_names_sentence(names: Iterable[str]) -> str | None:
    """Return what to say of names that are read here and refused where they are sent; None without any.

    >>> unportable_names_sentence(["a.jpg", "con.jpg"])
    "The service would refuse 1 of these files by their names ('con.jpg'); rename them before they are sent."
    """
    known, refused = NameSet(), []
    for name in names:
        try:
            known.add(name)
        except FileNameError:
            refused.append(name)
    if not refused:
        return None
    shown = ", ".join(map(quoted_name, refused[:_SHOWN_NAMES])) + ", ..." * (len(refused) > _SHOWN_NAMES)
    return (
        f"The service would refuse {len(refused)} of these files by their names ({shown}); rename them "
        "before they are sent."
    )


class NameSet:
    """A set of names; each added one is checked against all others."""

    def __init__(self) -> None:
        self._files: dict[str, str] = {}
        self._folders: dict[str, str] = {}

    def add(self, name: str) -> None:
        """Add a checked name of a file.

        Raises:
            FileNameError: ``name-duplicate``, ``name-twin`` (differs in case or in the spelling of accents
                only), or ``name-conflict`` (a file where another name has a folder).
        """
        check_name(name)
        key = collision_key(name)
        other = self._files.get(key)
        if other is not None:
            if other == name:
                raise FileNameError("name-duplicate", f"The file name {quoted_name(name)} occurs twice.")
            raise FileNameError(
                "name-twin",
                f"The file names {quoted_name(other)} and {quoted_name(name)} differ only in case or in the "
                "spelling of accents; some systems take them for one.",
            )
        if key in self._folders:
            raise FileNameError(
                "name-conflict", f"{quoted_name(name)} is the name of a file and of a folder as well."
            )
        self._add_folders(name)
        self._files[key] = name

    def add_folder(self, name: str) -> None:
        """Add the name of a folder, without its final slash; repeats are allowed.

        Raises:
            FileNameError: as by :meth:`add`, but for ``name-duplicate``.
        """
        check_name(name)
        self._add_folders(f"{name}/")

    def _add_folders(self, name: str) -> None:
        position = name.find("/")
        while position >= 0:
            folder = name[:position]
            key = collision_key(folder)
            if key in self._files:
                raise FileNameError(
                    "name-conflict", f"{quoted_name(folder)} is the name of a file and of a folder as well."
                )
            other = self._folders.setdefault(key, folder)
            if other != folder:
                raise FileNameError(
                    "name-twin",
                    f"The folder names {quoted_name(other)} and {quoted_name(folder)} differ only in case or "
                    "in the spelling of accents; some systems take them for one.",
                )
            position = name.find("/", position + 1)
