"""Compose limits what each container may use and reach; systemd and nginx accept their files."""

import json
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from urllib.request import Request, urlopen

import compose_spec
import pytest
import yaml

from octasplat.service.serving import SHUTDOWN_SECONDS
from octasplat.workers.serve.local_service import EXTRA_GRACE_SECONDS
from octasplat.workers.settings import WorkerSettings
from tests.docker.test_docker_files import DOCKER, ROOT, compose
from tests.support.http_server import QuietHandler, serve_http

DEPLOY = ROOT / "deploy"


def test_every_container_has_limits() -> None:
    for name, service in compose()["services"].items():
        for limit in ("mem_limit", "cpus", "pids_limit"):
            assert service.get(limit), f"{name} has no {limit}"
        assert service["read_only"] is True, name
        assert service["logging"]["options"].keys() >= {"max-size", "max-file"}, name
        assert "no-new-privileges:true" in service["security_opt"], name


def test_database_and_store_are_reached_from_within_only_and_workers_reach_nothing_else() -> None:
    loaded = compose()
    services = loaded["services"]
    assert loaded["networks"]["inside"] == {"internal": True}
    for name in ("database", "store", "worker", "bucket"):
        assert services[name]["networks"] == ["inside"], name
    subnet = loaded["networks"]["outside"]["ipam"]["config"][0]
    assert subnet["gateway"] in services["front-end"]["environment"]["OCTASPLAT_PROXIES"]


def test_role_of_the_service_is_no_superuser() -> None:
    loaded = compose()
    assert "POSTGRES_USER" not in loaded["services"]["database"]["environment"]
    script = loaded["configs"]["database-role"]["content"]
    assert "CREATE ROLE octasplat LOGIN PASSWORD" in script and "SUPERUSER" not in script
    assert subprocess.run(["sh", "-n"], input=script.replace("$$", "$"), text=True).returncode == 0


def test_kernel_cache_lies_outside_of_the_data_folder() -> None:
    text = (DOCKER / "Dockerfile").read_text()
    worker = compose()["services"]["worker"]
    [folder] = [volume.partition(":")[2] for volume in worker["volumes"] if volume.startswith("kernels:")]
    assert f"NUMBA_CACHE_DIR={folder}" in text and not folder.startswith("/data")
    assert f"-m 0711 /data {folder}" in text  # made for the user of the image


def with_variables(text: str, given: Mapping[str, str]) -> str:
    """A compose file with its variables filled in."""

    def value(found: "re.Match[str]") -> str:
        name, default = found[1], found[3]
        if found[2] == ":?":
            assert name in given, f"{name} is needed and not given"
        return given.get(name, default or "")

    return re.sub(r"(?<!\$)\$\{(\w+)(?:(:[-?])([^}]*))?\}", value, text)


def check_compose(text: str) -> None:
    """Check a compose file by the Compose specification.

    Raises:
        ValueError: it is refused.
    """
    loaded = yaml.safe_load(text)
    for service in loaded["services"].values():
        # The library is stricter than Docker here: a number with a point, and no tag beside a digest.
        service["cpus"] = float(service["cpus"])
        service["image"] = re.sub(r":[^@]+@", "@", service["image"])
    compose_spec.PyCompose.from_json(json.dumps(loaded)).validate()


def test_compose_file_follows_the_specification() -> None:
    given = {"OCTASPLAT_TOKEN": "t" * 40, "OCTASPLAT_PASSWORD": "p" * 40}
    text = with_variables((DOCKER / "compose.yaml").read_text(), given)
    check_compose(text)
    for right, wrong in (
        ("retries: 60", "retires: 60"),
        ("mem_limit: 2g", "mem_limit: lots"),
        ("networks: [inside]  # which", "networks: [nowhere]  # which"),
        ("configs: [{source: s3", "configs: [{source: s4"),
    ):
        assert right in text, right
        with pytest.raises(ValueError, match=r"."):
            check_compose(text.replace(right, wrong))


def test_compose_file_is_accepted() -> None:
    asked = ["docker", "compose", "version"]
    if shutil.which("docker") is None or subprocess.run(asked, capture_output=True).returncode:
        pytest.skip("docker compose is not installed")
    environment = {
        "OCTASPLAT_TOKEN": "t" * 40,
        "OCTASPLAT_PASSWORD": "p",
        "PATH": "/usr/bin:/usr/local/bin:/bin",
    }
    command = ["docker", "compose", "-f", str(DOCKER / "compose.yaml"), "config", "--quiet"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_services_have_longer_to_end_than_they_give_themselves() -> None:
    services = compose()["services"]
    times = {name: services[name].get("stop_grace_period", "10s") for name in ("front-end", "database")}
    assert int(times["front-end"].removesuffix("s")) > SHUTDOWN_SECONDS
    assert int(times["database"].removesuffix("s")) >= 60
    unit = (DEPLOY / "octasplat.service").read_text()
    [stop] = re.findall(r"^TimeoutStopSec=(\d+)$", unit, re.MULTILINE)
    # The database ends after its clients.
    grace_seconds = WorkerSettings.model_fields["grace_seconds"].default
    assert int(stop) > grace_seconds + EXTRA_GRACE_SECONDS + 30


def test_systemd_accepts_the_unit(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    unit = tmp_path / "octasplat.service"
    text = (DEPLOY / "octasplat.service").read_text()
    unit.write_text(text.replace("/opt/octasplat/bin/octasplat", sys.executable))
    done = subprocess.run(["systemd-analyze", "verify", str(unit)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    for setting in ("DynamicUser=yes", "NoNewPrivileges=yes", "ProtectSystem=strict", "LimitNOFILE=65536"):
        assert setting in text.splitlines()


class _Echo(QuietHandler):
    def respond(self) -> None:
        self.answer(str({name.lower(): value for name, value in self.headers.items()}).encode())


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@pytest.fixture
def service() -> Iterator[str]:
    """The address of a service behind nginx, which answers with the headers that reach it."""
    with serve_http(_Echo) as address:
        yield address


def test_nginx_passes_the_address_of_the_client_and_nothing_that_it_claims(
    service: str, tmp_path: Path
) -> None:
    nginx = shutil.which("nginx", path="/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin")
    if nginx is None:
        pytest.skip("nginx is not installed")
    port = free_port()
    site = (DEPLOY / "nginx.conf").read_text().replace("127.0.0.1:8642", service.removeprefix("http://"))
    lines = [line for line in site.splitlines() if "ssl_certificate" not in line]
    site = "\n".join(lines).replace("listen 443 ssl", f"listen 127.0.0.1:{port}")
    folders = "".join(
        f"{name}_temp_path {tmp_path}/{name};"
        for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    (tmp_path / "nginx.conf").write_text(
        f"daemon off; pid {tmp_path}/pid; error_log {tmp_path}/error.log; events {{}}\n"
        f"http {{ access_log off; {folders}\n{site}\n}}\n"
    )
    with subprocess.Popen([nginx, "-p", str(tmp_path), "-c", str(tmp_path / "nginx.conf")]) as process:
        try:
            claims = {
                "X-Forwarded-For": "6.6.6.6",
                "Forwarded": "for=6.6.6.6",
                "Host": "octasplat.example.org",
            }
            request = Request(f"http://127.0.0.1:{port}/v1/info", headers=claims)
            for _ in range(100):
                try:
                    with urlopen(request, timeout=10) as answer:
                        got = answer.read().decode()
                    break
                except OSError:
                    time.sleep(0.1)
            assert "6.6.6.6" not in got
            assert "'x-forwarded-for': '127.0.0.1'" in got and "'x-forwarded-proto': 'http'" in got
            assert "'host': 'octasplat.example.org'" in got
        finally:
            process.terminate()
