"""Record of a series' finished images, by which an interrupted series is resumed.

Beside the images a file says, a line each, what they are images of and which of them are whole. It is there
only while the series is unfinished. An image counts if its line is there and its content is as it says, or if
:data:`MOVED_FILE` says that whoever runs the series keeps it elsewhere.
"""

import hashlib
import json
from pathlib import Path

from octasplat.engine.core.errors import ConfigError, OutputError
from octasplat.engine.core.writing import report_disk_full, write_text

RECORD_FILE = "unfinished.jsonl"
MOVED_FILE = "moved.json"
"""Names and SHA-256 of finished images that were moved from the folder."""


class FinishedImages:
    """The finished images of a series in one folder.

    Args:
        folder: of the images and of the record.
        identity: of everything that decides what the images show; those of another are never taken.
        resume: go on with what is there.
        or_anew: forget an unfinished series that is of another identity, or is not to be gone on with, rather
            than refuse.
        record: name of the record, where several series share a folder.

    Raises:
        ConfigError: there is an unfinished series in the folder, and it is not to be gone on with, or is of
            another identity.
    """

    def __init__(
        self, folder: Path, identity: str, *, resume: bool, or_anew: bool = False, record: str = RECORD_FILE
    ) -> None:
        self.folder = folder
        self.record = folder / record
        self._identity = identity
        self._digests = self._read(resume, or_anew)
        self._moved = self._read_moved() if self._digests else {}

    def __len__(self) -> int:
        """Return the number of images that the record names."""
        return len(self._digests)

    def is_finished(self, path: Path) -> bool:
        """Return whether an image is finished and its file unchanged."""
        digest = self._digests.get(self._name(path))
        if digest is None:
            return False
        # moved images are believed, files are read
        return self._moved.get(self._name(path)) == digest or (path.is_file() and _sha256(path) == digest)

    def add(self, path: Path) -> None:
        """Record that an image is finished; its file is written.

        Raises:
            DiskFullError: there is no room for the record.
            OutputError: the record cannot be written.
        """
        name, digest = self._name(path), _sha256(path)
        lines = [] if self._digests else [{"identity": self._identity}]  # the first line names the series
        text = "".join(json.dumps(line) + "\n" for line in [*lines, {"file": name, "sha256": digest}])
        try:
            with report_disk_full(self.record), self.record.open("a" if self._digests else "w") as file:
                file.write(text)
        except OSError as error:
            raise OutputError(f"{self.record} cannot be written ({error.strerror or error}).") from error
        self._digests[name] = digest

    def remove_record(self) -> None:
        """Remove the record, as all images are finished."""
        self.record.unlink(missing_ok=True)
        (self.folder / MOVED_FILE).unlink(missing_ok=True)

    def _name(self, path: Path) -> str:
        return path.relative_to(self.folder).as_posix()

    def _read(self, resume: bool, or_anew: bool) -> dict[str, str]:
        try:
            lines = self.record.read_text(encoding="utf-8").splitlines(keepends=True)
        except FileNotFoundError:
            return {}
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{self.record} cannot be read ({error}); remove it.") from None
        # A kill may have cut the last line short; its image is rendered again.
        complete = [line for line in lines if line.endswith("\n")]
        if len(complete) < 2:  # only a header: nothing was finished
            return self._forget()
        if not resume:
            if or_anew:
                return self._forget()
            raise ConfigError(
                f"{self.folder} holds images of a render that was stopped ({len(complete) - 1} are done); "
                "add --resume to go on with it, or --overwrite to begin anew."
            )
        try:
            rows = [json.loads(line) for line in complete]
            identity, digests = rows[0]["identity"], {row["file"]: row["sha256"] for row in rows[1:]}
        except (ValueError, KeyError, TypeError):
            raise ConfigError(f"{self.record} is damaged; remove it to begin anew.") from None
        if identity != self._identity:
            if or_anew:
                return self._forget()
            raise ConfigError(
                f"{self.folder} holds images of another render (its scene, stage, cameras or version "
                "differ); say --overwrite to begin anew."
            )
        if len(lines) > len(complete):  # a cut last line would join with the next one
            write_text(self.record, "".join(complete))
        self._remove_partial()
        return digests

    def _read_moved(self) -> dict[str, str]:
        try:
            moved: dict[str, str] = json.loads((self.folder / MOVED_FILE).read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        return moved

    def _forget(self) -> dict[str, str]:
        self.record.unlink()
        self._remove_partial()
        return {}

    def _remove_partial(self) -> None:
        """Remove files that a killed process did not complete."""
        for partial in self.folder.rglob(".*.partial.*"):
            partial.unlink(missing_ok=True)


def _sha256(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
