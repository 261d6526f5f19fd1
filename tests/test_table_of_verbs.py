"""The table of verbs and its page."""

import json
from pathlib import Path

from click.testing import CliRunner

from octasplat.engine.operations.registry import operation_names
from octasplat.workers.cli.main import cli
from octasplat.workers.cli.verbs import verbs, verbs_page

ROOT = Path(__file__).resolve().parents[1]


def test_page_of_verbs_is_up_to_date() -> None:
    written = (ROOT / "docs" / "verbs.md").read_text(encoding="utf-8")
    assert written == verbs_page(), "octasplat verbs --markdown > docs/verbs.md brings it up to date"


def test_operations_have_command_and_python_call() -> None:
    assert tuple(verb.name for verb in verbs()) == operation_names()
    for verb in verbs():
        assert verb.python, verb.name


def test_crop_command_job_and_python_match() -> None:
    listed = json.loads(CliRunner().invoke(cli, ["verbs", "--json"]).stdout)
    crop = next(verb for verb in listed if verb["name"] == "crop")
    assert crop["command"] == "octasplat crop"
    assert crop["http"] == 'POST /v1/jobs {"kind": "crop", ...}' and crop["works_on"] == "result"
