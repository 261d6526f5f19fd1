"""What a command needs and is not given is asked for by the name of its option."""

import pytest


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (("crop", "pyproject.toml", "--inverse"), "--output"),
        (("simplify", "pyproject.toml", "-o", "less.ply"), "--count"),
        (("reconstruct", "tests"), "--output"),
        (("deform", "pyproject.toml", "-o", "other.ply", "--proxy", "pyproject.toml"), "--deformed"),
    ],
)
def test_missing_option_is_wrong_usage(octasplat, arguments: tuple[str, ...], option: str) -> None:
    result = octasplat(*arguments)
    assert result.exit_code == 2, result.output
    assert f"Missing option '{option}'" in result.stderr
    assert f"Usage: octasplat {arguments[0]}" in result.stderr.replace("cli", "octasplat")
