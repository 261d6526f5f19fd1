"""Matching of the image names in a model with files whose names are spelt differently.

Models come from other machines: case, backslashes, leading folders and suffixes differ. A name is matched
with a file only where no other name and no other file fits.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import PurePosixPath

from octasplat.engine.core.relative_paths import normalize_name


def match_image_names(names: Iterable[str], files: Collection[str]) -> Mapping[str, str]:
    """Return the file of each name of a model that has one, as paths below the folder of the images.

    Args:
        names: of the images of the model, each once.
        files: paths below the folder of the images, normalised, with forward slashes.

    >>> match_image_names(["A/1.JPG", "2.jpg", "/tmp/3.png"], ["a/1.jpg", "2.jpg", "3.png", "4.png"])
    {'2.jpg': '2.jpg', 'A/1.JPG': 'a/1.jpg', '/tmp/3.png': '3.png'}
    """
    names = [name for name in names if PurePosixPath(_with_forward_slashes(name)).name]
    found = {name: normalize_name(name) for name in names if normalize_name(name) in files}
    # From the strictest spelling to the loosest, so that no loose match takes the file of a strict one
    for spelling in (_with_forward_slashes, _fold_case, _without_suffix, _last_part, _folded_stem):
        taken = set(found.values())
        free = _by_spelling((file for file in files if file not in taken), spelling)
        missing = _by_spelling((name for name in names if name not in found), spelling)
        found |= {name: free[spelt] for spelt, name in missing.items() if spelt in free}
    return found


def _by_spelling(names: Iterable[str], spelling: Callable[[str], str]) -> dict[str, str]:
    """Return the names by their spelling, without those whose spelling is not unique."""
    pairs = [(spelling(name), name) for name in names]
    counts = Counter(spelt for spelt, _ in pairs)
    return {spelt: name for spelt, name in pairs if counts[spelt] == 1}


def _with_forward_slashes(name: str) -> str:
    return str(PurePosixPath(normalize_name(name).replace("\\", "/")))


def _fold_case(name: str) -> str:
    return _with_forward_slashes(name).casefold()


def _without_suffix(name: str) -> str:
    return str(PurePosixPath(_fold_case(name)).with_suffix(""))


def _last_part(name: str) -> str:
    return PurePosixPath(_fold_case(name)).name


def _folded_stem(name: str) -> str:
    return PurePosixPath(_fold_case(name)).stem
