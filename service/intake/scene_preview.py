"""What would be taken of a scene, told by the names and sizes of its files before any of them is sent."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

from octasplat.engine.core.portable_names import quoted_name
from octasplat.engine.core.scene_layout import FileRole, file_role, lay_out_scene
from octasplat.service.intake.archive import list_archive_end
from octasplat.service.intake.dataset import photograph_count_fault, photographs_among
from octasplat.service.intake.faults import IntakeError, IntakeFault
from octasplat.service.intake.receive import UploadLimits
from octasplat.service.intake.upload_names import FileNames

_MAX_FAULTS = 100


@dataclass(frozen=True)
class ListedFile:
    """A file that is to be sent: its path in the folder or archive, and its length."""

    path: str
    size_bytes: int


@dataclass(frozen=True)
class PreviewedFile:
    """A file that is taken: its name in the dataset, its path in the folder or archive, and its length."""

    name: str
    path: str
    size_bytes: int


@dataclass(frozen=True)
class ScenePreview:
    """Files of a folder or an archive that would be taken.

    Attributes:
        files: what is taken, by name.
        left_out: paths of the other files, but for what file managers leave behind.
        notes: sentences on these.
        faults: why the whole would be refused.
        folder: the folder, with its slash, that is around everything.
        photographs: number of photographs.
        has_poses: whether there is a COLMAP model.
    """

    files: tuple[PreviewedFile, ...] = ()
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    faults: tuple[IntakeFault, ...] = ()
    folder: str = ""
    photographs: int = 0
    has_poses: bool = False


class ArchiveEndTooShortError(Exception):
    """The end of an archive that was given lacks a part of its list; ``needed_bytes`` hold it."""

    def __init__(self, needed_bytes: int) -> None:
        super().__init__(f"The last {needed_bytes} bytes of the archive are needed.")
        self.needed_bytes = needed_bytes


def preview_files(listed: Sequence[ListedFile], limits: UploadLimits) -> ScenePreview:
    """Return what would be taken of a folder of these files."""
    sizes = {file.path: file.size_bytes for file in listed}
    layout = lay_out_scene(list(sizes))
    files = tuple(PreviewedFile(name, path, sizes[path]) for name, path in sorted(layout.files.items()))
    return _preview_files(files, layout.left_out, layout.notes, layout.folder, limits)


def preview_archive(end: bytes, size_bytes: int, limits: UploadLimits) -> ScenePreview:
    """Return what would be taken of an archive.

    Args:
        end: its last bytes, in which its list of contents is looked for.
        size_bytes: length of the whole archive.
        limits: what an upload may ask for.

    Raises:
        ArchiveEndTooShortError: more of the end is needed.
    """
    if size_bytes > limits.max_archive_bytes:
        return ScenePreview(faults=(_too_large("The archive", size_bytes, limits.max_archive_bytes),))
    try:
        listing = list_archive_end(_ArchiveEnd(end, size_bytes), limits.archive)
    except IntakeError as error:
        return ScenePreview(faults=tuple(error.faults))
    files = tuple(
        PreviewedFile(file.name, file.record.name, file.size_bytes)
        for file in sorted(listing.files, key=lambda file: file.name)
    )
    return _preview_files(files, listing.left_out, listing.notes, listing.folder, limits)


def _preview_files(
    files: tuple[PreviewedFile, ...],
    left_out: tuple[str, ...],
    notes: tuple[str, ...],
    folder: str,
    limits: UploadLimits,
) -> ScenePreview:
    faults: list[IntakeFault] = []
    known = FileNames()
    for file in files:
        try:
            known.add(file.name)
        except IntakeError as error:
            faults += error.faults
        if file.size_bytes > limits.max_file_bytes:
            faults.append(
                _too_large(quoted_name(file.name), file.size_bytes, limits.max_file_bytes, file.name)
            )
    names = [file.name for file in files]
    photographs = photographs_among(names)
    if (fault := photograph_count_fault(len(photographs), limits.dataset.max_photographs)) is not None:
        faults.append(fault)
    return ScenePreview(
        files=files,
        left_out=left_out,
        notes=notes,
        faults=tuple(faults[:_MAX_FAULTS]),
        folder=folder,
        photographs=len(photographs),
        has_poses=any(file_role(name) is FileRole.MODEL for name in names),
    )


def _too_large(what: str, size_bytes: int, limit: int, name: str | None = None) -> IntakeFault:
    detail = f"{what} has {size_bytes / 1e6:,.1f} MB; the service takes {limit / 1e6:,.1f} MB."
    return IntakeFault("too-large", detail, name)


class _ArchiveEnd(io.BytesIO):
    """The end of a file at the positions that it has in the whole."""

    def __init__(self, end: bytes, size_bytes: int) -> None:
        super().__init__(end)
        self._size, self._start = size_bytes, size_bytes - len(end)

    def seek(self, position: int, whence: int = io.SEEK_SET, /) -> int:
        """Move to a position of the whole file; it must lie in the part that is there."""
        # Counted from the end, places are the same as in the whole.
        if whence == io.SEEK_END:
            return super().seek(position, whence) + self._start
        if position < self._start:
            raise ArchiveEndTooShortError(self._size - position)
        return super().seek(position - self._start) + self._start
