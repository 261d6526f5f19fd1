"""Commands around a service: queues, and a browser that may not be there."""

import webbrowser

import pytest
from click import UsageError

from octasplat.workers.cli import browser
from octasplat.workers.cli.commands import open as open_command
from octasplat.workers.cli.commands.worker import parse_queues


@pytest.mark.parametrize("text", ["cpu=0", "cpu=00", "long,cpu=000", "cpu=", "cpu,cpu=2", "2"])
def test_queues_without_a_slot_or_named_twice_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--queues"):
        parse_queues(text)


def test_queues_are_read_with_their_slots() -> None:
    assert parse_queues("cpu=02, long") == {"cpu": 2, "long": 1}
    assert parse_queues("") == {}


class FakeApi:
    """A service that makes links to sign in."""

    address = "http://127.0.0.1:8642"

    def __init__(self) -> None:
        self.links = 0

    def __enter__(self) -> "FakeApi":
        return self

    def __exit__(self, *_error: object) -> None:
        pass

    def post(self, _path: str) -> dict[str, str]:
        self.links += 1
        return {"path": f"/sign-in/{self.links}"}


def test_open_prints_a_link_where_no_browser_starts(octasplat, monkeypatch) -> None:
    monkeypatch.setattr(open_command, "connected", lambda _server: FakeApi())
    monkeypatch.setattr(browser, "has_display", lambda: True)
    monkeypatch.setattr(webbrowser, "open", lambda _link: False)
    result = octasplat("open")
    assert result.exit_code == 0, result.output
    assert result.stdout == "http://127.0.0.1:8642/sign-in/2\n"
