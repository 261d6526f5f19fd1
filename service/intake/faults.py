"""Faults of uploaded data, in a form for programs and for people."""

from dataclasses import dataclass
from typing import NoReturn

from octasplat.engine.core.errors import DatasetError


def shown_name(name: str) -> str:
    """Return a name with bytes that are not UTF-8 written as escapes."""
    return name.encode("utf-8", "backslashreplace").decode()


@dataclass(frozen=True)
class IntakeFault:
    """One fault.

    Attributes:
        code: stable name of the reason, e.g. ``name-traversal``.
        detail: one sentence that says what is wrong and what to do.
        file: name of the file in the dataset or archive that it concerns, if it is one; bytes of it that are
            not UTF-8 are written as escapes.
    """

    code: str
    detail: str
    file: str | None = None

    def __post_init__(self) -> None:
        if self.file is not None:
            object.__setattr__(self, "file", shown_name(self.file))

    @property
    def pointer(self) -> str:
        """Return the JSON pointer (RFC 6901, as a fragment) to the file in the dataset."""
        if self.file is None:
            return "#/files"
        return f"#/files/{self.file.replace('~', '~0').replace('/', '~1')}"

    def as_dict(self) -> dict[str, str]:
        """Return an element of ``errors`` in a problem document (RFC 9457)."""
        facts = {"code": self.code, "detail": self.detail, "pointer": self.pointer}
        return facts if self.file is None else {**facts, "file": self.file}


class IntakeError(DatasetError):
    """An upload is refused; ``faults`` have the reasons, the text is that of the first."""

    error_type = "intake_refused"

    def __init__(self, *faults: IntakeFault) -> None:
        super().__init__(faults[0].detail)
        self.faults = faults

    @property
    def code(self) -> str:
        """Return the code of the first fault."""
        return self.faults[0].code


def raise_intake_error(code: str, detail: str, name: str | None = None) -> NoReturn:
    """Refuse the archive.

    Raises:
        IntakeError: always.
    """
    raise IntakeError(IntakeFault(code, detail, name))
