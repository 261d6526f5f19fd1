"""Queues are paused from the command line of an administrator."""

import json

from click.testing import CliRunner, Result

from octasplat.workers.cli.main import cli
from tests.support.service_harness import TOKEN
from tests.support.web_harness import RunningService


def octasplat(service: RunningService, *words: str) -> Result:
    arguments = [*words, "--server", service.url]
    return CliRunner().invoke(cli, arguments, env={"OCTASPLAT_TOKEN": TOKEN})


def test_queue_is_paused_and_goes_on(service: RunningService) -> None:
    paused = octasplat(service, "pause", "night")
    assert (paused.exit_code, paused.stdout) == (0, "The queue night is paused; 0 jobs wait.\n")
    [row] = [line for line in octasplat(service, "workers").stdout.splitlines() if line.startswith("night")]
    assert row.split() == ["night", "0", "0", "0", "paused"]
    on = octasplat(service, "unpause", "night", "--json")
    assert on.exit_code == 0 and json.loads(on.stdout)["paused"] is False
    assert "paused" not in octasplat(service, "workers").stdout
    gone = octasplat(service, "drain", "nobody")
    assert gone.exit_code == 1 and "There is no such live worker" in gone.stderr
    wrong = octasplat(service, "pause", "Not A Queue")
    assert wrong.exit_code == 1
