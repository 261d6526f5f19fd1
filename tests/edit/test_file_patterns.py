"""Meshes of a sequence, given by a pattern."""

from pathlib import Path

import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.operations.file_patterns import expand_patterns


def test_matches_are_in_the_order_of_their_numbers_whatever_signs_stand_between(tmp_path: Path) -> None:
    # a superscript is a digit that int() does not take
    names = ["f9.ply", "f10.ply", "1\u00b22.ply", "1\u00b210.ply", "\u00e410.ply"]
    for name in names:
        (tmp_path / name).touch()
    found = [path.name for path in expand_patterns([tmp_path / "*.ply"])]
    assert sorted(found) == sorted(names)
    assert found.index("f9.ply") < found.index("f10.ply")
    assert found.index("1\u00b22.ply") < found.index("1\u00b210.ply")
    with pytest.raises(ConfigError, match="no file matches"):
        expand_patterns([tmp_path / "*.obj"])
