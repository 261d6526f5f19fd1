"""Channel columns of a file: which exist, and which of them are requested."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.gaussians.channels import group_columns, is_valid_channel_name

ChannelChoice = Literal["own", "all"] | tuple[str, ...]
"""``own``: those that the file says are channels, as ours do; ``all``: every column of which nothing else is
known, too; or names."""


def select_channel_columns(
    path: Path, declared: Mapping[str, tuple[str, ...]], columns: Iterable[str], choice: ChannelChoice
) -> dict[str, tuple[str, ...]]:
    """Return the columns of each channel that is wanted, by the channel's name.

    Args:
        path: named in errors.
        declared: the channels that the file itself names, with their columns; passed over where one of those
            is missing or means something else.
        columns: all that the file has, in its order.
        choice: what is wanted.

    Raises:
        SceneFileError: a channel that was asked for by name is not there.
    """
    every = list(columns)
    own = {
        name: named
        for name, named in declared.items()
        if set(named) <= set(every) and is_valid_channel_name(name, named)
    }
    taken = {column for named in own.values() for column in named}
    # Columns of declared channels are not grouped once more.
    rest = group_columns(column for column in every if column not in taken)
    known = {**own, **{name: named for name, named in rest.items() if is_valid_channel_name(name, named)}}
    if choice == "own":
        return own
    if choice == "all":
        return known
    for name in choice:
        if name not in known:
            raise SceneFileError(f"{path}: has no channel '{name}'; it has {', '.join(known) or 'none'}.")
    return {name: known[name] for name in choice}
