"""Named channels: further data per Gaussian, such as albedo, roughness or a label.

A channel has a name and f numbers a Gaussian. Every number is a scalar: where a scene is moved, turned or
mirrored, channels stay as they are, so directions do not belong into one. Which channels a scene has is set
once (:meth:`octasplat.engine.gaussians.model.FlatGaussians.with_channels`); from then on they go wherever the
Gaussians go. Whether one is trained is for the trainer to say.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.errors import ConfigError

FILL_VALUE = 0.0
"""What Gaussians have that come to a scene from one without the channel."""
RESERVED_COLUMNS = re.compile(
    r"x|y|z|n[xyz]|s|t|red|green|blue|alpha|opacity|(f_dc|f_rest|scale|rot)(_\d+)?|packed_.*"
    r"|gid|corner|radius|displaycolor|displayopacity"
    r"|filter_3d|f_rest_.*|f_offset.*|f_anchor_feat.*",
    re.IGNORECASE,
)
"""Columns that mean something else in some format."""
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_NUMBERED = re.compile(r"(.+)_(0|[1-9]\d{0,8})")


class Channels(Mapping[str, np.ndarray]):
    """Arrays of shape (n, f) by name, in the order in which they were set.

    The set of names never changes; the numbers may be written to, as those of any other parameter.

    >>> channels = Channels({"albedo": np.zeros((4, 3), np.float32), "metallic": np.ones((4, 1), np.float32)})
    >>> channels.widths
    {'albedo': 3, 'metallic': 1}
    """

    def __init__(self, arrays: Mapping[str, np.ndarray] | None = None) -> None:
        """Take over ``arrays``, which are not copied.

        Raises:
            ConfigError: a name cannot be used, or two would be one in a file.
            ValueError: an array is not float32, is not of shape (n, f) with f > 0, or has another n.
        """
        self._arrays = dict(arrays or {})
        for name, array in self._arrays.items():
            if array.dtype != np.float32 or array.ndim != 2 or array.shape[1] == 0:
                raise ValueError(f"channel '{name}' should be float32 of shape (n, f)")
        if len({len(array) for array in self._arrays.values()}) > 1:
            raise ValueError("channels should have a row for every Gaussian")
        check_channel_names(self.widths)

    def __getitem__(self, name: str) -> Float32[np.ndarray, "n f"]:
        return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)

    def __repr__(self) -> str:
        return f"Channels({', '.join(f'{name}: {width}' for name, width in self.widths.items())})"

    @property
    def widths(self) -> dict[str, int]:
        """Return the width (numbers per Gaussian) of each channel."""
        return {name: array.shape[1] for name, array in self._arrays.items()}

    def map(self, function: Callable[[np.ndarray], np.ndarray]) -> "Channels":
        """Return the channels with ``function`` applied to each array."""
        return Channels({name: function(array) for name, array in self._arrays.items()})

    def with_filled(self, widths: Mapping[str, int], count: int) -> "Channels":
        """Return the channels of ``widths`` in that order; missing ones hold ``FILL_VALUE``."""
        return Channels(
            {
                name: self._arrays[name]
                if name in self._arrays
                else np.full((count, width), FILL_VALUE, np.float32)
                for name, width in widths.items()
            }
        )


def check_row_count(channels: Channels, count: int) -> None:
    """Check that channels have ``count`` rows.

    Raises:
        ValueError: they have not.
    """
    for name, array in channels.items():
        if len(array) != count:
            raise ValueError(f"channel '{name}' has {len(array)} rows for {count} Gaussians")


def merge_widths(sets: Iterable[Channels]) -> dict[str, int]:
    """Return the channels that any of ``sets`` has, with their widths.

    Raises:
        ConfigError: two have a channel of one name and different widths.
    """
    widths: dict[str, int] = {}
    for channels in sets:
        for name, width in channels.widths.items():
            if widths.setdefault(name, width) != width:
                raise ConfigError(
                    f"The channel '{name}' has {widths[name]} numbers in one scene and {width} in another; "
                    "rename one of them."
                )
    return widths


def stack_channels(channels: Channels, names: Sequence[str] | None = None) -> Float32[np.ndarray, "n f"]:
    """Return channels side by side, as a tracer takes its features.

    Args:
        channels: at least one.
        names: which, and in which order; None takes all.
    """
    return np.concatenate([channels[name] for name in names or channels], axis=1)


def column_names(name: str, width: int) -> tuple[str, ...]:
    """Return a channel's column names in files: ``metallic``, or ``albedo_0``, ``albedo_1``, ``albedo_2``.

    >>> column_names("metallic", 1), column_names("albedo", 3)
    (('metallic',), ('albedo_0', 'albedo_1', 'albedo_2'))
    """
    return (name,) if width == 1 else tuple(f"{name}_{place}" for place in range(width))


def group_columns(columns: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Group column names to channels: names numbered from 0 without a gap, two at least, are one channel.

    >>> group_columns(["albedo_0", "albedo_1", "albedo_2", "metallic"])
    {'albedo': ('albedo_0', 'albedo_1', 'albedo_2'), 'metallic': ('metallic',)}
    """
    found = list(columns)
    numbered: dict[str, set[int]] = {}
    for column in found:
        if match := _NUMBERED.fullmatch(column):
            numbered.setdefault(match[1], set()).add(int(match[2]))
    complete = {stem for stem, places in numbered.items() if 1 < len(places) == max(places) + 1}
    groups: dict[str, tuple[str, ...]] = {}
    for column in found:
        match = _NUMBERED.fullmatch(column)
        if match and match[1] in complete:
            if len(groups.get(match[1], ())) != len(numbered[match[1]]):
                groups[match[1]] = column_names(match[1], len(numbered[match[1]]))
        else:
            groups[column] = (column,)
    return groups


def is_valid_channel_name(name: str, columns: Iterable[str]) -> bool:
    """Return whether a channel may have this name and these columns, other channels aside.

    >>> is_valid_channel_name("label", ["label"]), is_valid_channel_name("opacity", ["opacity"])
    (True, False)
    """
    return bool(_NAME.fullmatch(name)) and not any(
        RESERVED_COLUMNS.fullmatch(text) for text in (name, *columns)
    )


def check_channel_names(widths: Mapping[str, int]) -> None:
    """Check that files can tell these channels from each other and from other columns.

    Raises:
        ConfigError: they cannot.
    """
    columns = {name: column_names(name, width) for name, width in widths.items()}
    for name, own in columns.items():
        if not _NAME.fullmatch(name):
            raise ConfigError(f"'{name}' cannot name a channel; use letters, digits and _, a letter first.")
        if not is_valid_channel_name(name, own):
            raise ConfigError(f"'{name}' cannot name a channel, as files use this name for something else.")
    every = [column for own in columns.values() for column in own]
    # A file must give back the channels as they are here.
    if len({column.lower() for column in every}) < len(every) or group_columns(every) != columns:
        raise ConfigError(
            f"The channels {', '.join(widths)} cannot be told apart in a file; choose names that do not end "
            "in _ and a number, and that differ in more than upper and lower case."
        )
