"""How long photographs take to a service far away: over a link of a given latency and bandwidth.

    octasplat serve --queues "" &
    python -m benchmarks.slow_link http://127.0.0.1:8642 --connections 1 4 8

A proxy in this process stands for the link: the bytes of all connections share its bandwidth and arrive so
much later, and of each connection no more than ``--window-kib`` are under way, as without window scaling. Two
datasets of random bytes are sent by the client's own functions: many small files, and few large ones that go
in parts. Prints seconds for each number of connections.
"""

import argparse
import asyncio
import os
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import OpenImageIO as oiio

from octasplat.workers.client import dataset_files, resumable_upload
from octasplat.workers.client.api import Api, find_token
from octasplat.workers.client.dataset_files import LocalFile, send_files

CHUNK_BYTES = 16 << 10


@dataclass(frozen=True)
class Link:
    """A link between two machines.

    Attributes:
        latency_s: one way, seconds.
        bandwidth: each way, bytes a second.
        window_bytes: of one connection under way at once.
    """

    latency_s: float
    bandwidth: float
    window_bytes: int


class _Direction:
    """One way of the link; connections wait for each other."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self._free_at = 0.0

    def arrival(self, size_bytes: int) -> float:
        """Return when so many bytes that are sent now arrive, by the monotonic clock."""
        self._free_at = max(self._free_at, time.monotonic()) + size_bytes / self.link.bandwidth
        return self._free_at + self.link.latency_s

    async def carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Carry all bytes of one connection to its other end."""
        under_way: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(self.link.window_bytes // CHUNK_BYTES)

        async def deliver() -> None:
            while True:
                at, data = await under_way.get()
                await asyncio.sleep(max(0.0, at - time.monotonic()))
                if not data:
                    writer.write_eof()
                    return
                writer.write(data)
                await writer.drain()

        delivery = asyncio.create_task(deliver())
        with suppress(ConnectionError, OSError):
            while data := await reader.read(CHUNK_BYTES):
                await under_way.put((self.arrival(len(data)), data))
        await under_way.put((self.arrival(0), b""))
        with suppress(ConnectionError, OSError):
            await delivery


def start_proxy(host: str, port: int, link: Link) -> int:
    """Start a proxy to an address in a thread of its own and return its port."""
    listening: list[int] = []
    is_ready = threading.Event()

    async def serve() -> None:
        there, back = _Direction(link), _Direction(link)

        async def connect(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await asyncio.sleep(2 * link.latency_s)  # the handshake
            far_reader, far_writer = await asyncio.open_connection(host, port)
            await asyncio.gather(there.carry(reader, far_writer), back.carry(far_reader, writer))
            writer.close()
            far_writer.close()

        server = await asyncio.start_server(connect, "127.0.0.1", 0)
        listening.append(server.sockets[0].getsockname()[1])
        is_ready.set()
        await server.serve_forever()

    threading.Thread(target=lambda: asyncio.run(serve()), daemon=True).start()
    is_ready.wait()
    return listening[0]


def write_photograph(path: Path, size_bytes: int) -> None:
    """Write a gray photograph, and random bytes behind it."""
    picture = oiio.ImageBuf(oiio.ImageSpec(16, 16, 3, "uint8"))
    picture.write(str(path))
    with path.open("ab") as file:
        file.write(os.urandom(size_bytes - path.stat().st_size))


def send_random_files(api: Api, folder: Path, count: int, size_bytes: int, connections: int) -> float:
    """Send so many new files to a new dataset and return the seconds that took."""
    files = []
    for number in range(count):
        path = folder / f"{number:04}.jpg"
        write_photograph(path, size_bytes)
        files.append(LocalFile(f"images/{path.name}", path, size_bytes))
    dataset_files.PARALLEL_UPLOADS = connections
    resumable_upload.PARALLEL_PARTS = connections
    dataset = api.post("/v1/datasets", {"name": "slow link"})
    began = time.monotonic()
    send_files(api, dataset["id"], files, lambda _done, _total: None)
    seconds = time.monotonic() - began
    api.request("DELETE", f"/v1/datasets/{dataset['id']}")
    return seconds


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("address", help="of a running service, whose token is found as by the commands")
    parser.add_argument("--latency-ms", type=float, default=50, help="one way")
    parser.add_argument("--mbit", type=float, default=200)
    parser.add_argument("--window-kib", type=int, default=256)
    parser.add_argument("--connections", type=int, nargs="+", default=[1, 4, 8])
    options = parser.parse_args()
    link = Link(options.latency_ms / 1000, options.mbit * 1e6 / 8, options.window_kib << 10)
    near = urlsplit(options.address)
    port = start_proxy(near.hostname or "127.0.0.1", near.port or 80, link)
    token = find_token(os.environ, options.address)
    print("connections, 320 files of 34 kB, 3 files of 40 MB, seconds")
    for connections in options.connections:
        seconds = []
        for count, size_bytes in ((320, 34_000), (3, 40_000_000)):
            with Api(f"http://127.0.0.1:{port}", token) as api, tempfile.TemporaryDirectory() as folder:
                seconds.append(send_random_files(api, Path(folder), count, size_bytes, connections))
        print(f"{connections}, " + ", ".join(f"{each:.1f}" for each in seconds))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
