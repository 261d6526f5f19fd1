"""Names of files that came from elsewhere: relative, portable, and none the twin of another.

A name that is odd is refused, never mended, so that what the user sees is what was sent.
"""

import re
import unicodedata

from octasplat.engine.errors import DatasetError

MAX_NAME_BYTES = 1000
MAX_PART_BYTES = 240
MAX_DEPTH = 12

_RESERVED = re.compile(
    r"(con|prn|aux|nul|conin\$|conout\$|clock\$|(com|lpt)[0-9\u00b9\u00b2\u00b3]) *(\..*)?",
    re.IGNORECASE | re.DOTALL,
)
_FORBIDDEN = frozenset('<>:"|?*')


class NameRefused(DatasetError):
    """A file name that cannot be taken; ``code`` names the reason."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


def check_name(name: str) -> str:
    """The name itself, if it is a relative path with forward slashes that every system can hold.

    Raises:
        NameRefused: with the code ``name-empty``, ``name-too-long``, ``name-not-text``, ``name-nul``,
            ``name-control``, ``name-unc``, ``name-backslash``, ``name-absolute``, ``name-drive``,
            ``name-character``, ``name-empty-part``, ``name-traversal``, ``name-trailing``, ``name-reserved``
            or ``name-too-deep``.
    """
    if not name:
        raise NameRefused("name-empty", "A file has an empty name.")
    shown = shown_name(name)
    try:
        encoded = name.encode("utf-8")
    except UnicodeEncodeError:
        raise NameRefused("name-not-text", f"The file name {shown} is not valid Unicode.") from None
    if len(encoded) > MAX_NAME_BYTES:
        raise NameRefused("name-too-long", f"The file name {shown} is longer than {MAX_NAME_BYTES} bytes.")
    if "\0" in name:
        raise NameRefused("name-nul", f"The file name {shown} contains a NUL character.")
    # Cf holds the marks that turn the direction of writing, with which a name can look like another.
    if any(unicodedata.category(letter) in ("Cc", "Cf", "Zl", "Zp") for letter in name):
        raise NameRefused("name-control", f"The file name {shown} contains invisible characters.")
    if name.startswith(("\\\\", "//")):
        raise NameRefused("name-unc", f"The file name {shown} is a network path; names must be relative.")
    if "\\" in name:
        raise NameRefused(
            "name-backslash", f"The file name {shown} contains a backslash; use forward slashes."
        )
    if name.startswith("/"):
        raise NameRefused("name-absolute", f"The file name {shown} is absolute; names must be relative.")
    if re.match("[A-Za-z]:", name):
        raise NameRefused("name-drive", f"The file name {shown} begins with a drive; names must be relative.")
    if _FORBIDDEN & set(name):
        raise NameRefused(
            "name-character",
            f'The file name {shown} contains one of < > : " | ? *, which not every system takes.',
        )
    parts = name.split("/")
    if len(parts) > MAX_DEPTH:
        raise NameRefused("name-too-deep", f"The file name {shown} has more than {MAX_DEPTH} parts.")
    for part in parts:
        _check_part(part, shown)
    return name


def _check_part(part: str, shown: str) -> None:
    if not part:
        raise NameRefused(
            "name-empty-part", f"The file name {shown} has an empty part (two slashes, or one at the end)."
        )
    if part in (".", ".."):
        raise NameRefused(
            "name-traversal", f"The file name {shown} contains '{part}' as a part, which may lead elsewhere."
        )
    if part.endswith((".", " ")) or part.startswith(" "):
        raise NameRefused(
            "name-trailing",
            f"The file name {shown} has a part that begins with a space or ends with a dot or a space.",
        )
    if _RESERVED.fullmatch(part):
        raise NameRefused(
            "name-reserved", f"The file name {shown} contains a name that Windows keeps for devices."
        )
    if len(part.encode("utf-8")) > MAX_PART_BYTES:
        raise NameRefused(
            "name-too-long", f"The file name {shown} has a part longer than {MAX_PART_BYTES} bytes."
        )


def twin_key(name: str) -> str:
    """What two names share that some file system takes for one: canonical Unicode without case."""
    return unicodedata.normalize(
        "NFC", unicodedata.normalize("NFD", unicodedata.normalize("NFD", name).casefold())
    )


def shown_name(name: str) -> str:
    """A name as it can be put into a sentence: quoted, escaped and cut."""
    text = name if len(name) <= 80 else f"{name[:60]}...{name[-15:]}"
    return ascii(text) if not text.isprintable() or "\\" in text else f"'{text}'"


class NameSet:
    """Names taken so far; adding one checks it against all the others."""

    def __init__(self) -> None:
        self._files: dict[str, str] = {}
        self._folders: dict[str, str] = {}

    def add(self, name: str) -> None:
        """Take a checked name of a file.

        Raises:
            NameRefused: ``name-duplicate``, ``name-twin`` (differs in case or in the spelling of accents
                only), or ``name-conflict`` (a file where another name has a folder).
        """
        check_name(name)
        key = twin_key(name)
        other = self._files.get(key)
        if other is not None:
            if other == name:
                raise NameRefused("name-duplicate", f"The file name {shown_name(name)} occurs twice.")
            raise NameRefused(
                "name-twin",
                f"The file names {shown_name(other)} and {shown_name(name)} differ only in case or in the "
                "spelling of accents; some systems take them for one.",
            )
        if key in self._folders:
            raise NameRefused(
                "name-conflict", f"{shown_name(name)} is the name of a file and of a folder as well."
            )
        self._add_folders(name)
        self._files[key] = name

    def add_folder(self, name: str) -> None:
        """Take the name of a folder, without its final slash; repeats are welcome.

        Raises:
            NameRefused: as by :meth:`add`, but for ``name-duplicate``.
        """
        check_name(name)
        self._add_folders(f"{name}/")

    def _add_folders(self, name: str) -> None:
        position = name.find("/")
        while position >= 0:
            folder = name[:position]
            key = twin_key(folder)
            if key in self._files:
                raise NameRefused(
                    "name-conflict", f"{shown_name(folder)} is the name of a file and of a folder as well."
                )
            other = self._folders.setdefault(key, folder)
            if other != folder:
                raise NameRefused(
                    "name-twin",
                    f"The folder names {shown_name(other)} and {shown_name(folder)} differ only in case or "
                    "in the spelling of accents; some systems take them for one.",
                )
            position = name.find("/", position + 1)
