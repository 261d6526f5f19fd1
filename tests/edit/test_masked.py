from pathlib import Path

import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.edit.mask_selection import photograph_of_mask

PHOTOGRAPHS = ["0001.jpg", "left/0001.jpg", "right/0001.jpg", "right/0002.jpg", "right/0002.png", "far/9.jpg"]


@pytest.mark.parametrize(
    ("mask", "photograph"),
    [
        ("masks/left/0001.png", "left/0001.jpg"),
        ("masks/right/0001.png", "right/0001.jpg"),
        ("masks/right/0001.jpg.png", "right/0001.jpg"),
        ("masks/0001.png", "0001.jpg"),
        ("masks/0001.jpg.png", "0001.jpg"),
        ("masks/right/0002.jpg.png", "right/0002.jpg"),
        ("masks/right/0002.png.png", "right/0002.png"),
        ("anywhere/9.png", "far/9.jpg"),  # no other has this name
    ],
)
def test_mask_matches_photograph_in_own_folder(mask: str, photograph: str) -> None:
    assert PHOTOGRAPHS[photograph_of_mask(Path(mask), PHOTOGRAPHS)] == photograph
    back = PHOTOGRAPHS[::-1]
    assert back[photograph_of_mask(Path(mask), back)] == photograph


def test_ambiguous_mask_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"may be a mask of left/0001\.jpg and right/0001\.jpg"):
        photograph_of_mask(Path("0001.png"), PHOTOGRAPHS[1:])
    with pytest.raises(ConfigError, match=r"right/0002\.jpg and right/0002\.png"):
        photograph_of_mask(Path("masks/right/0002.png"), PHOTOGRAPHS)
    with pytest.raises(ConfigError, match="no photograph of this name"):
        photograph_of_mask(Path("masks/0003.png"), PHOTOGRAPHS)
