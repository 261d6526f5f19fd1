"""Hosts of their own on this machine: network namespaces on a bridge, and a door to the database for them."""

import asyncio
import contextlib
import fcntl
import os
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

BRIDGE = "octabr0"
GATEWAY = "10.213.77.1"


def missing_requirement() -> str | None:
    """Why there can be no namespaces here, or None."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if shutil.which("ip") is None:
        return "network namespaces need the program ip (iproute2)"
    probe = f"octa{os.getpid()}"
    if _ip("netns", "add", probe, check=False) != 0:
        return "network namespaces cannot be made here"
    _ip("netns", "del", probe)
    if _ip("link", "add", probe, "type", "bridge", check=False) != 0:
        return "network bridges cannot be made here"
    _ip("link", "del", probe)
    return None


@dataclass(frozen=True)
class NamespaceHost:
    """A namespace with one address on the bridge."""

    name: str
    cable: str

    def command(self, *command: str) -> list[str]:
        """That command, run there."""
        return ["ip", "netns", "exec", self.name, *command]

    def disconnect(self) -> None:
        """From here on nothing comes from there any more, not even the end of a connection."""
        _ip("link", "set", self.cable, "down")

    def reconnect(self) -> None:
        """The opposite."""
        _ip("link", "set", self.cable, "up")


@contextlib.contextmanager
def hosts(count: int) -> Iterator[list[NamespaceHost]]:
    """Namespaces that reach this one at :data:`GATEWAY` and see neither its network nor its loopback.

    There is one such bridge at a time; other tests that ask for one wait.
    """
    made = [NamespaceHost(f"octahost{number}", f"octa{number}") for number in range(count)]
    lock = (Path(tempfile.gettempdir()) / "octasplat-tests-bridge.lock").open("w")
    fcntl.flock(lock, fcntl.LOCK_EX)
    try:
        _remove_all(made)  # of a test that was killed
        _ip("link", "add", BRIDGE, "type", "bridge")
        _ip("addr", "add", f"{GATEWAY}/24", "dev", BRIDGE)
        _ip("link", "set", BRIDGE, "up")
        for number, host in enumerate(made):
            _ip("netns", "add", host.name)
            _ip("link", "add", host.cable, "type", "veth", "peer", "name", "eth0", "netns", host.name)
            _ip("link", "set", host.cable, "master", BRIDGE, "up")
            inside = ("-n", host.name)
            _ip(*inside, "link", "set", "lo", "up")
            _ip(*inside, "addr", "add", f"10.213.77.{10 + number}/24", "dev", "eth0")
            _ip(*inside, "link", "set", "eth0", "up")
        yield made
    finally:
        _remove_all(made)
        lock.close()


def _remove_all(hosts: Sequence[NamespaceHost]) -> None:
    for host in hosts:
        _ip("link", "del", host.cable, check=False)
        _ip("netns", "del", host.name, check=False)
    _ip("link", "del", BRIDGE, check=False)


@contextlib.contextmanager
def forward_socket(socket_path: str, address: str = GATEWAY) -> Iterator[int]:
    """A port at that address that leads to a Unix socket."""
    loop = asyncio.new_event_loop()
    tasks: set[asyncio.Task[None]] = set()
    writers: list[asyncio.StreamWriter] = []

    async def copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while piece := await reader.read(1 << 16):
                writer.write(piece)
                await writer.drain()
        writer.close()

    async def let_in(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            inside = await asyncio.open_unix_connection(socket_path)
        except OSError:
            writer.close()
            return
        writers.extend((writer, inside[1]))
        for task in (copy(reader, inside[1]), copy(inside[0], writer)):
            kept = loop.create_task(task)
            tasks.add(kept)
            kept.add_done_callback(tasks.discard)

    async def close(server: asyncio.Server) -> None:
        server.close()
        for writer in writers:
            writer.transport.abort()  # one whose plug was pulled would wait for ever
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    server = loop.run_until_complete(asyncio.start_server(let_in, address, 0))
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    try:
        yield int(server.sockets[0].getsockname()[1])
    finally:
        asyncio.run_coroutine_threadsafe(close(server), loop).result(10)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(10)
        loop.close()


def _ip(*arguments: str, check: bool = True) -> int:
    return subprocess.run(["ip", *arguments], check=check, capture_output=True).returncode
