"""Removal of this machine's paths from sentences and log lines.

Files of a job are named relative to its scene or its result; of any other path only the last parts are left.
"""

import os
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

from octasplat.workers.worker.task import RUN_FOLDER

# A path begins where no word, address or other path goes on.
_ABSOLUTE = re.compile(r"""(?<![\w.~/…])(?!(?<=:)//)(?:/+[^\s/"'`:;,()<>|\[\]{}]+)+/?""")
_KEPT_PATH_PARTS = 2
_OTHER_ATTEMPT = (
    r"""(?<![^\s"'(=])(?:/[^\s/"'(=]+)+/attempts/[0-9a-f]{8}-[0-9a-f-]{27}\.\d+/"""
    rf"(?:{RUN_FOLDER}/)?"
)
"""The folder of an attempt, see :class:`octasplat.workers.worker.workspace.Workspace`, and its run."""


class PathRedactor:
    """Replaces paths of this machine in texts by neutral names.

    Args:
        folder: of an attempt, see :class:`octasplat.workers.worker.task.Task`.
        work: folder of all work on this machine.
        others: further folders whose paths are private, such as that of the store.
    """

    def __init__(self, folder: Path, work: Path, others: Iterable[Path] = ()) -> None:
        names: list[tuple[str, str]] = []
        for root in _path_patterns(folder):
            # Longer ones first; what lies in the scene or the result is called as it is there.
            names += [
                (rf"{root}/{RUN_FOLDER}/", ""),
                (rf"{root}/{RUN_FOLDER}\b", "the result"),
                (rf"{root}/", ""),
                (rf"{root}\b", "the job's folder"),
            ]
        # What an earlier attempt has noted, perhaps on another machine.
        names.append((_OTHER_ATTEMPT, ""))
        for root in _path_patterns(work):
            names += [
                # The folders are those of DatasetFolder: datasets, an id, and the dataset's name.
                (rf"{root}/datasets/[^/\s]+/[^/\s]+/", ""),
                (rf"{root}/datasets/[^/\s]+/[^/\s\"']+", "the scene"),
                (rf"{root}\b", "the work folder"),
            ]
        names += [(rf"{root}\b", f"…/{other.name}") for other in others for root in _path_patterns(other)]
        self._names = [(re.compile(pattern), name) for pattern, name in names]

    def redact(self, text: str) -> str:
        """Return the text without paths of this machine."""
        return shorten_absolute_paths(self.replace_job_paths(text)) if "/" in text else text

    def replace_job_paths(self, text: str) -> str:
        """Return the text with the files of the job as they are called; other paths are left alone."""
        for pattern, name in self._names:
            text = pattern.sub(name, text)
        return text


def shorten_absolute_paths(text: str) -> str:
    """Return the text with only the last parts of each absolute path of this machine."""
    return _ABSOLUTE.sub(_last_parts, text.replace("file://", ""))


def redact_json(value: Any, redactor: PathRedactor) -> Any:
    """Return a JSON value with all its texts redacted."""
    if isinstance(value, str):
        return redactor.redact(value)
    if isinstance(value, dict):
        return {key: redact_json(item, redactor) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [redact_json(item, redactor) for item in value]
    return value


def _last_parts(match: re.Match[str]) -> str:
    parts = [part for part in match[0].split("/") if part]
    # A route such as /api/jobs looks like a path, but begins with no folder of this machine.
    if parts[0] not in _top_folders():
        return match[0]
    last_parts = parts[1:][-_KEPT_PATH_PARTS:]
    return "/".join(["…", *last_parts]) if last_parts else "…"


@cache
def _top_folders() -> frozenset[str]:
    return frozenset(os.listdir("/"))  # noqa: PTH208 - names are all that is asked for


def _path_patterns(path: Path) -> list[str]:
    """Return the path as it is and with its links followed, as patterns."""
    return [re.escape(text) for text in dict.fromkeys((str(path.absolute()), os.path.realpath(path)))]
