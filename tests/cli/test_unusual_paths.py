"""Paths of another kind than a command expects, and names that are no text, in the commands that read them."""

from pathlib import Path

import pytest


@pytest.mark.parametrize("command", ["estimate", "plan", "reconstruct"])
@pytest.mark.parametrize("name", ["photograph.png", "missing[1]"])
def test_dataset_that_is_no_folder_is_refused_in_a_sentence(octasplat, tmp_path: Path, command, name) -> None:
    (tmp_path / "photograph.png").write_bytes(b"")
    output = ("-o", tmp_path / "run") if command == "reconstruct" else ()
    result = octasplat(command, tmp_path / name, *output)
    assert result.exit_code == 1, result.output
    assert result.stderr == (
        f"Error: {tmp_path / name} is not a folder; name the folder that holds the photographs.\n"
    )
    assert not (tmp_path / "run").exists()
