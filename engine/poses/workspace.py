"""What a search for poses works with: photographs under other names, and stages that are told of."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from octasplat.engine.core.events import EventListener
from octasplat.engine.core.progress import counted_phase


def link_photographs(images: Path, names: Sequence[str], folder: Path) -> tuple[str, ...]:
    """Make a folder of links to photographs whose names COLMAP can list and number; returns these names.

    COLMAP lists pairs by names with a space between, and its numbers follow the order of names.
    """
    aliases = tuple(f"{k:06d}{Path(name).suffix.lower()}" for k, name in enumerate(names))
    folder.mkdir()
    for alias, name in zip(aliases, names, strict=True):
        (folder / alias).symlink_to((images / name).resolve())
    return aliases


@contextmanager
def progress_stage(name: str, steps: int, progress: EventListener) -> Iterator[Callable[[int], None]]:
    """A stage whose steps are known beforehand; yields what is to be told how many are done."""
    with counted_phase(name, progress, steps) as count:
        yield lambda done: count(done, steps)
