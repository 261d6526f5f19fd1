"""Names of files at the door: each is checked once, where it comes in, and taken as it is behind it.

The doors are a file that is put (:func:`check_file_name`), and many that come or are counted together
(:class:`FileNames`): those of an archive, and those of a dataset that is committed.
"""

from octasplat.service.intake.faults import Fault, IntakeRefused
from octasplat.service.intake.layout import Part, part_of
from octasplat.workers.store.names import NameRefused, NameSet, check_name, shown_name


def check_file_name(name: str) -> Part:
    """What a file of that name is in a dataset.

    Raises:
        IntakeRefused: the name is refused (``name-...``), or is that of no part of a scene
            (``name-unexpected``).
    """
    try:
        check_name(name)
    except NameRefused as error:
        raise _refused(error, name) from None
    return scene_part(name)


def scene_part(name: str) -> Part:
    """What a file of that name, which is checked, is in a scene.

    Raises:
        IntakeRefused: ``name-unexpected``, as it is no part of one.
    """
    part = part_of(name)
    if part is Part.OTHER:
        raise IntakeRefused(
            Fault(
                "name-unexpected",
                f"{shown_name(name)} is no part of a scene; these are images/, masks/ and the COLMAP model "
                "in sparse/0.",
                name,
            )
        )
    return part


class FileNames:
    """Names taken so far; adding one checks it by itself and against all the others."""

    def __init__(self) -> None:
        self._names = NameSet()

    def add(self, name: str) -> None:
        """Take the name of a file, or that of a folder, which ends with a slash.

        Raises:
            IntakeRefused: ``name-...``.
        """
        try:
            if name.endswith("/"):
                self._names.add_folder(name.removesuffix("/"))
            else:
                self._names.add(name)
        except NameRefused as error:
            raise _refused(error, name) from None


def _refused(error: NameRefused, name: str) -> IntakeRefused:
    return IntakeRefused(Fault(error.code, str(error), name))
