"""Validation of uploaded file names: each is checked once, where it arrives, and trusted afterwards.

Names arrive with a single file (:func:`check_file_name`), or in numbers (:class:`FileNames`): those of an
archive, and those of a dataset that is committed.
"""

from octasplat.engine.core.portable_names import FileNameError, NameSet, check_name, quoted_name
from octasplat.engine.core.scene_layout import FileRole, file_role
from octasplat.service.intake.faults import IntakeError, IntakeFault


def check_file_name(name: str) -> FileRole:
    """Return the role of a file of that name in a dataset.

    Raises:
        IntakeError: the name is refused (``name-...``), or is that of no part of a scene
            (``name-unexpected``).
    """
    try:
        check_name(name)
    except FileNameError as error:
        raise _intake_error(error, name) from None
    return check_scene_file(name)


def check_scene_file(name: str) -> FileRole:
    """Return the role in a dataset of a file whose name is checked.

    Raises:
        IntakeError: ``name-unexpected``, as it is no part of one.
    """
    part = file_role(name)
    if part is FileRole.OTHER:
        raise IntakeError(
            IntakeFault(
                "name-unexpected",
                f"{quoted_name(name)} is no part of a scene; these are images/, masks/, depths/, "
                "geometry.ply and the COLMAP model in sparse/0.",
                name,
            )
        )
    return part


class FileNames:
    """A set of file names; each added one is checked by itself and against all others."""

    def __init__(self) -> None:
        self._names = NameSet()

    def add(self, name: str) -> None:
        """Add the name of a file, or that of a folder, which ends with a slash.

        Raises:
            IntakeError: ``name-...``.
        """
        try:
            if name.endswith("/"):
                self._names.add_folder(name.removesuffix("/"))
            else:
                self._names.add(name)
        except FileNameError as error:
            raise _intake_error(error, name) from None


def _intake_error(error: FileNameError, name: str) -> IntakeError:
    return IntakeError(IntakeFault(error.code, str(error), name))
