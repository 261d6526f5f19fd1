"""``octasplat serve`` lets nobody in but its own user, who need not do anything for that."""

import os
import subprocess
import sys
import time
from pathlib import Path

import httpx

from octasplat.workers.client.api import Api, find_token

ROOT = Path(__file__).parents[2]


def start(data: Path) -> "subprocess.Popen[bytes]":
    environment = {**os.environ, "OCTASPLAT_FLOOR_BYTES": "0"}
    command = [sys.executable, "-m", "octasplat", "serve", "--port", "0", "--queues", "", "--data", str(data)]
    process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not (data / "serve.json").exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    return process


def octasplat(data: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    environment = {**os.environ, "OCTASPLAT_DATA": str(data)}
    command = [sys.executable, "-m", "octasplat", *arguments]
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)


def test_serve_creates_private_bootstrap_token(short_root: Path) -> None:
    data = short_root / "own"
    process = start(data)
    try:
        path = data / "token"
        assert path.stat().st_mode & 0o777 == 0o600
        secret = path.read_text().strip()
        with Api.local(data) as api, httpx.Client(base_url=api.address) as anybody:
            for headers in ({}, {"X-Forwarded-For": "203.0.113.9"}, {"Host": "localhost:1"}):
                assert anybody.get("/v1/jobs", headers=headers).status_code == 401
            assert api.get("/v1/info")["owner"] == "local"
            elsewhere = api.address.replace("127.0.0.1", "localhost")
            assert find_token({}, elsewhere, data) is None  # no other address is sent it

            listed = octasplat(data, "jobs")
            assert (listed.returncode, listed.stderr) == (0, "")
            link = octasplat(data, "open", "--print").stdout.strip()
            assert link.startswith(f"{api.address}/sign-in/once?key=") and secret not in link
            assert anybody.get(link).status_code == 200  # which sets the cookie
            assert anybody.get("/v1/jobs").status_code == 200
            assert httpx.get(link).status_code == 403
            made = octasplat(data, "token", "create", "ann", "--days", "2").stdout.strip()
            newest = api.get("/v1/audit", limit=1)["entries"][0]
            assert (newest["action"], newest["address"]) == ("token create", "command line")
            tokens = octasplat(data, "token", "list").stdout
            assert "octasplat serve on" in tokens and "until" in tokens
            assert secret not in tokens and made not in tokens
    finally:
        process.terminate()
        assert process.wait(120) == 0
    path.chmod(0o644)  # somebody may have read it
    process = start(data)
    try:
        with Api.local(data) as api:
            assert path.read_text().strip() != secret and path.stat().st_mode & 0o777 == 0o600
            assert api.get("/v1/jobs")["jobs"] == []
            stale = httpx.get(f"{api.address}/v1/jobs", headers={"Authorization": f"Bearer {secret}"})
            assert stale.status_code == 401
    finally:
        process.terminate()
        assert process.wait(120) == 0
