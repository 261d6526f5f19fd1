"""Attacks on a running service from outside, those of the tests and some more; nothing may come of them.

    octasplat serve &
    python -m benchmarks.attacks      # a report as JSON; exit code 1 if something got through

Each attack must be refused with the status that it deserves, as a problem that says why. At the end the
service is ready, and of what was sent nothing is kept.
"""

import io
import json
import os
import pickle
import socket
import sys
import tarfile
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import httpx

from octasplat.workers.client.api import Api, find_address, find_token
from tests.intake.test_archive import NAMES, STRUCTURES, TWINS, linked_kinds
from tests.intake.test_dataset import HORRORS
from tests.intake.test_image_headers import BAD
from tests.service.test_webhook_networks import REFUSED_URLS
from tests.support.model_builder import ColmapModelBuilder, photographs
from tests.support.zip_builder import ZipMember, build_zip

SCENE = {**photographs(), **ColmapModelBuilder().files()}
SLOW_CLIENTS = 60


@dataclass
class Outcome:
    """What came of the attacks of one sort.

    Attributes:
        answers: how often each answer was given, as status and code.
        wrong: attacks that were not answered as they should be.
        slowest_s: the longest that one answer took.
    """

    answers: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    slowest_s: float = 0.0


class Attacker:
    """Somebody with a token.

    Args:
        http: to the service, with the token.
    """

    def __init__(self, http: httpx.Client) -> None:
        self.http = http
        self.outcomes: dict[str, Outcome] = {}

    def ask(self, sort: str, what: str, expected: set[int], method: str, path: str, **given: Any) -> None:
        """Ask for something that must be refused so."""
        outcome = self.outcomes.setdefault(sort, Outcome())
        began = time.monotonic()
        try:
            answer = self.http.request(method, path, **given)
            status, code = answer.status_code, _code(answer)
        except httpx.HTTPError as error:
            status, code = 0, type(error).__name__
        outcome.slowest_s = max(outcome.slowest_s, time.monotonic() - began)
        outcome.answers[f"{status} {code}".strip()] += 1
        if status not in expected:
            outcome.wrong.append(f"{what}: {status} {code}")

    def announce(self, sort: str, what: str, path: str, length: int) -> None:
        """Begin to send something much too long, which must be refused before it comes."""
        outcome = self.outcomes.setdefault(sort, Outcome())
        head = (
            f"PUT {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: {length}\r\n"
            f"Authorization: {self.http.headers['Authorization']}\r\n\r\nx"
        )
        with socket.create_connection((self.http.base_url.host, self.http.base_url.port or 80), 60) as client:
            client.sendall(head.encode())
            status = client.recv(100).split(b" ")[1].decode()
        outcome.answers[status] += 1
        if status not in ("413", "507"):
            outcome.wrong.append(f"{what}: {status}")

    def dataset(self, files: Mapping[str, bytes] = {}) -> str:
        """The address of a new dataset with files."""
        made = self.http.post("/v1/datasets", json={"name": "attack"})
        address = str(made.raise_for_status().headers["Location"])
        for name, content in files.items():
            self.http.put(f"{address}/files/{name}", content=content).raise_for_status()
        return address


def _code(answer: httpx.Response) -> str:
    if answer.headers.get("content-type") != "application/problem+json":
        return ""
    return str(answer.json()["type"]).rpartition(":")[2]


def archives() -> Iterator[tuple[str, str, bytes]]:
    """ZIP files that lie, by sort and name."""
    tar = io.BytesIO()
    with tarfile.open(fileobj=tar, mode="w") as archive:
        for name, target in (("a", "/etc"), ("b", "a/passwd")):
            link = tarfile.TarInfo(f"images/{name}")
            link.type, link.linkname = tarfile.SYMTYPE, target
            archive.addfile(link)
    yield "tar with links", "tar", tar.getvalue()
    for kind, (mode, _) in linked_kinds().items():
        yield "tar with links", kind, build_zip(ZipMember("images/b.jpg", b"/etc/passwd", mode=mode))
    for name in NAMES:
        yield (
            "names in archives",
            ascii(name)[:60],
            build_zip(ZipMember(name, b"" if name == "/" else b"x", mode=0)),
        )
    for pair in TWINS:
        yield "names in archives", ascii(pair), build_zip(*(ZipMember(name, b"x") for name in pair))
    for name, (make, _) in STRUCTURES.items():
        yield "archives that lie", name, make()
    yield "archive bombs", "flat", build_zip(ZipMember("images/a.bmp", bytes(100_000_000)))
    yield (
        "archive bombs",
        "nested",
        build_zip(ZipMember("images/b.zip", build_zip(ZipMember("images/a.jpg", b"x")))),
    )
    many = [ZipMember(f"images/{number}.jpg", b"", method=0) for number in range(60_000)]
    yield "archive bombs", "60,000 entries of nothing", build_zip(*many)


def attack_uploads(attacker: Attacker) -> None:
    """Archives, photographs, models, names and pickles."""
    address = attacker.dataset()
    for sort, what, content in archives():
        attacker.ask(sort, what, {413, 422}, "PUT", f"{address}/archive", content=content)
    for what, (make, _) in BAD.items():
        attacker.ask(
            "photographs that lie", what, {422}, "PUT", f"{address}/files/images/a.png", content=make()
        )
    paths = (
        "images/..%2f..%2fevil.png", "%2fetc%2fpasswd", "images/a%00.png", "images/a%5cb.png", "..%2fevil",
        "images/%2e%2e/%2e%2e/evil.png", "images/CON.png", "images/a.exe", "images/%ff.png",
    )  # fmt: skip
    for path in paths:
        for method, expected in (
            ("PUT", {404, 405, 422}),
            ("GET", {404, 405, 422}),
            ("DELETE", {404, 405, 422}),
        ):
            attacker.ask(
                "names in addresses", f"{method} {path}", expected, method, f"{address}/files/{path}"
            )
    for path in ("/static/..%2f..%2fpyproject.toml", "/static/%2e%2e/%2e%2e/etc/passwd",
                 "/static//etc/passwd", "/v1/jobs/..%2f..%2ftoken",
                 f"/v1/jobs/{uuid.uuid4()}/artifacts/..%2f..%2ftoken"):  # fmt: skip
        attacker.ask("names in addresses", path, {404, 422}, "GET", path)
    for name in ("state.pkl", "model.pt", "checkpoints/iteration_1.npz", "sparse/0/x.pickle"):
        content = pickle.dumps(os.getcwd)
        attacker.ask("pickles", name, {422}, "PUT", f"{address}/files/{name}", content=content)
    kept = attacker.http.get(f"{address}/files").json()["files"]
    if kept:
        attacker.outcomes["archives that lie"].wrong.append(f"kept: {kept}")
    address = attacker.dataset(photographs())
    for what, (make, *_) in HORRORS.items():
        for name in ColmapModelBuilder().files():
            attacker.http.delete(f"{address}/files/{name}")
        for name, content in make().files().items():
            attacker.http.put(f"{address}/files/{name}", content=content).raise_for_status()
        attacker.ask("models that lie", what, {422}, "POST", f"{address}/commit")


def attack_requests(attacker: Attacker) -> None:
    """Webhooks to inner addresses, bodies, options, ranges."""
    for url in REFUSED_URLS:
        attacker.ask("webhooks to inner addresses", url, {422}, "POST", "/v1/webhooks", json={"url": url})

    def endless() -> Iterator[bytes]:
        for _ in range(1 << 10):
            yield b"y" * 65536

    long = {"too long JSON": b"x" * 3_000_000, "endless JSON": endless()}
    for what, body in long.items():
        attacker.ask("bodies", what, {0, 413}, "POST", "/v1/jobs", content=body)
    odd = {
        "deep": b'{"options":' + b"[" * 100_000,
        "half": b'{"kind"',
        "NaN": b'{"priority": NaN}',
        "nothing": b"",
        "number of 10,000 digits": b'{"priority": ' + b"9" * 10_000 + b"}",
        "half a character": b'{"kind":"\xed\xa0"}',
    }
    for what, body in odd.items():
        headers = {"Content-Type": "application/json"}
        attacker.ask("bodies", what, {400, 422}, "POST", "/v1/jobs", content=body, headers=headers)
    address = attacker.dataset()
    attacker.announce("bodies", "10^15 bytes announced", f"{address}/files/images/a.png", 10**15)
    address = attacker.dataset(SCENE)
    attacker.http.post(f"{address}/commit").raise_for_status()
    dataset = address.rpartition("/")[2]
    options: dict[str, Any] = {
        "unknown": {"shell": "; rm -rf /"},
        "text for a number": {"train": {"iterations": "$(id)"}},
        "a path as a file to write": {"exports": ["../../evil.glb"]},
        "an absolute one": {"exports": ["/etc/cron.d/evil.glb"]},
        "no number": {"train": {"iterations": -1}},
        "too much": {"train": {"iterations": 10**12}},
        "prototype": {"__class__": {"__init__": {}}},
    }
    for what, given in options.items():
        body = {"dataset_id": dataset, "options": given}
        attacker.ask("options", what, {422}, "POST", "/v1/jobs", json=body)
    for what, bounds in {
        "5,000 digits": "9" * 5000,
        "backwards": "9-1",
        "many": ",".join(["0-0"] * 2000),
    }.items():
        path = f"{address}/files/images/v0.png"
        headers = {"Range": f"bytes={bounds}" if "-" in bounds else f"bytes={bounds}-"}
        attacker.ask("bodies", f"range, {what}", {200, 206, 400, 416}, "GET", path, headers=headers)


def attack_doors(attacker: Attacker, address: str) -> None:
    """No token, wrong ones, other names of the host, other sites, things of others."""
    document = attacker.http.get("/openapi.json").json()
    with httpx.Client(base_url=address, timeout=60, trust_env=False) as stranger:
        other = Attacker(stranger)
        other.outcomes = attacker.outcomes
        for path, operations in document["paths"].items():
            if path in ("/healthz", "/readyz"):
                continue
            for method in operations:
                there = path.replace("{path}", "images/a.png").replace("{name}", "scene.ply")
                there = "/".join(str(uuid.UUID(int=1)) if "{" in part else part for part in there.split("/"))
                other.ask("no token", f"{method} {path}", {401}, method.upper(), there)
        for given in ("Bearer octa_x", "Basic eDp5", "Bearer " + "x" * 10_000):
            other.ask(
                "wrong tokens", given[:20], {401, 429}, "GET", "/v1/jobs", headers={"Authorization": given}
            )
        other.ask(
            "wrong tokens", "cookie", {401, 429}, "GET", "/v1/jobs", headers={"Cookie": "octasplat_session=x"}
        )
    for host in ("evil.example", "127.0.0.1.evil.example", "[::ffff:1.2.3.4]", ""):
        attacker.ask(
            "other names and sites", f"Host {host}", {400, 421}, "GET", "/v1/jobs", headers={"Host": host}
        )
    for headers in ({"Origin": "https://evil.example"}, {"Origin": "null"}, {"Sec-Fetch-Site": "cross-site"}):
        attacker.ask(
            "other names and sites", str(headers), {403}, "POST", "/v1/datasets", json={}, headers=headers
        )
    for path in ("/v1/jobs/{}", "/v1/datasets/{}", "/v1/jobs/{}/artifacts/scene.ply", "/v1/webhooks/{}"):
        there = path.format(uuid.uuid4())
        attacker.ask("what is not one's own", path, {404, 405}, "GET", there)
        attacker.ask("what is not one's own", f"DELETE {path}", {404, 405}, "DELETE", there)


def attack_slowly(attacker: Attacker, address: str) -> None:
    """Clients that say a byte now and then; somebody else is answered meanwhile. And one that breaks off."""
    outcome = attacker.outcomes.setdefault("slow and broken clients", Outcome())
    where, dataset = urlsplit(address), attacker.dataset()
    assert where.hostname is not None
    token = attacker.http.headers["Authorization"]
    head = f"PUT {dataset}/files/images/a.png HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: {token}\r\n"
    clients = [socket.create_connection((where.hostname, where.port or 80)) for _ in range(SLOW_CLIENTS)]
    for number, client in enumerate(clients):
        client.sendall((head + ("Content-Length: 1000000\r\n\r\n" if number % 2 else "X-Slow: ")).encode())
    for _ in range(5):
        for client in clients:
            client.sendall(b"x")
        began = time.monotonic()
        answer = attacker.http.get("/v1/jobs")
        outcome.slowest_s = max(outcome.slowest_s, time.monotonic() - began)
        outcome.answers[f"{answer.status_code} for somebody else"] += 1
        if answer.status_code != 200:
            outcome.wrong.append(f"nobody else is answered: {answer.status_code}")
        time.sleep(0.5)
    for client in clients:
        client.close()
    time.sleep(1)
    if kept := attacker.http.get(f"{dataset}/files").json()["files"]:
        outcome.wrong.append(f"kept: {kept}")


def main() -> int:
    """Attack the service of this machine or of the environment."""
    address = find_address(os.environ)
    token = find_token(os.environ, address)
    assert token is not None, "a service with tokens is attacked"
    with Api(address, token) as api:
        version = api.get("/v1/info")["version"]
    http = httpx.Client(
        base_url=address, headers={"Authorization": f"Bearer {token}"}, timeout=120, trust_env=False
    )
    attacks: tuple[Callable[[Attacker], None], ...] = (
        attack_uploads,
        attack_requests,
        lambda attacker: attack_doors(attacker, address),
        lambda attacker: attack_slowly(attacker, address),
    )
    with http:
        attacker = Attacker(http)
        for attack in attacks:
            attack(attacker)
            print({sort: outcome.wrong for sort, outcome in attacker.outcomes.items()}, file=sys.stderr)
        ready = http.get("/readyz").status_code
    wrong = [f"{sort}: {what}" for sort, outcome in attacker.outcomes.items() for what in outcome.wrong]
    report = {
        "version": version,
        "attacks": {
            sort: {"answers": dict(outcome.answers), "slowest_s": round(outcome.slowest_s, 1)}
            for sort, outcome in attacker.outcomes.items()
        },
        "ready_afterwards": ready == 200,
        "wrong": wrong,
    }
    print(json.dumps(report, indent=1))
    return 1 if wrong or ready != 200 else 0


if __name__ == "__main__":
    raise SystemExit(main())
