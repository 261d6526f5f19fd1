"""Search for the known name that a mistyped one probably means."""

from collections.abc import Iterable
from difflib import get_close_matches


def nearest_name(name: str, known: Iterable[str]) -> str | None:
    """Return the known name nearest to ``name``; None where none is near.

    Names with dots are also found by their last part.

    >>> nearest_name("ray_patch_ray", ["ray_patch_rays", "lr.quat"])
    'ray_patch_rays'
    >>> nearest_name("quats", ["ray_patch_rays", "lr.quat"])
    'lr.quat'
    >>> nearest_name("fov", ["fov_y_degrees", "frames"])
    'fov_y_degrees'
    """
    names = list(known)
    if matches := get_close_matches(name, names, n=1, cutoff=0.75):
        return matches[0]
    # a name without its unit, such as fov
    if len(longer := [full for full in names if full.startswith(f"{name}_")]) == 1:
        return longer[0]
    by_last_part: dict[str, str] = {}
    for full in names:
        by_last_part.setdefault(full.rpartition(".")[2], full)
    # users may leave out the section
    last = get_close_matches(name.rpartition(".")[2], list(by_last_part), n=1, cutoff=0.75)
    return by_last_part[last[0]] if last else None
