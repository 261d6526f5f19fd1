"""Which photographs each block of a plan needs, in a file beside the plan.

A machine that trains a block fetches only those. The file also keeps what all photographs together decide, so
that the block is trained on the same numbers as beside all of them.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from octasplat.engine.core.errors import CheckpointError
from octasplat.engine.core.scene_layout import FileRole, file_role
from octasplat.engine.core.writing import write_text
from octasplat.engine.dataset.photograph_facts import PhotographFacts

PHOTOGRAPHS_FILE = "photographs.json"
MAX_FILE_BYTES = 1 << 28
"""About 200 bytes for each photograph, and 5 for each that a block needs."""
_PICTURES = (FileRole.IMAGE, FileRole.MASK, FileRole.DEPTH)


class BlockPhotographs(BaseModel):
    """What a block needs of the photographs, and what it needs to know of all others.

    Attributes:
        facts: on all photographs.
        exposure: whether exposures are learnt.
        views: indices of the views that train each block, ascending.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1] = 1
    facts: PhotographFacts
    exposure: bool
    views: tuple[tuple[int, ...], ...]

    def needed_files(self, number: int, names: Sequence[str]) -> set[str]:
        """Return those files of a scene that a block needs: its pictures, and all that are no pictures.

        Args:
            number: of the block, from 1.
            names: paths of all files of the scene below its folder.
        """
        views: Sequence[int] = self.views[number - 1] if number <= len(self.views) else ()
        files = self.facts.files
        own = {name for view in views if 0 <= view < len(files) for name in files[view] if name is not None}
        pictures = {name for of_view in files for name in of_view if name is not None}
        others = (name for name in names if name not in pictures)
        return own.intersection(names) | {name for name in others if file_role(name) not in _PICTURES}


def write_block_photographs(record: BlockPhotographs, folder: Path) -> None:
    """Write the file to the folder of the pieces."""
    write_text(folder / PHOTOGRAPHS_FILE, record.model_dump_json() + "\n")


def read_block_photographs(folder: Path) -> BlockPhotographs | None:
    """Read the file from the folder of the pieces; None where there is none, as beside plans of old.

    Raises:
        CheckpointError: it is damaged.
    """
    path = folder / PHOTOGRAPHS_FILE
    try:
        if not path.exists():
            return None
        if path.stat().st_size > MAX_FILE_BYTES:
            raise CheckpointError(f"{path} is too large; train again without --resume.")
        return BlockPhotographs.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        fault = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error.strerror
        raise CheckpointError(f"{path} cannot be read ({fault}); train again without --resume.") from None
