"""The container files fit the project: linted, as pyproject.toml says, closed where they should be."""

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from octasplat.service.settings import ServiceSettings

ROOT = Path(__file__).parents[2]
DOCKER = ROOT / "docker"
PINNED = r"[a-z/]+:[0-9][\w.-]*@sha256:[0-9a-f]{64}"


def instructions() -> list[tuple[str, str, str]]:
    """Stage, instruction and arguments of every line, continued lines joined."""
    text = (DOCKER / "Dockerfile").read_text()
    found, stage = [], ""
    for line in re.sub(r"\\\n\s*", "", text).splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        word, _, rest = line.partition(" ")
        if word == "FROM":
            stage = rest.rpartition(" AS ")[2]
        found.append((stage, word, rest))
    return found


def compose() -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load((DOCKER / "compose.yaml").read_text())
    return loaded


def test_base_image_is_named_by_its_digest() -> None:
    arguments = dict(rest.split("=", 1) for _, word, rest in instructions() if word == "ARG")
    bases = [rest.partition(" AS ")[0] for _, word, rest in instructions() if word == "FROM"]
    stages = {stage for stage, _, _ in instructions()}
    outside = [base for base in bases if base not in stages]
    assert outside == ["${PYTHON_IMAGE}"] and re.fullmatch(PINNED, arguments["PYTHON_IMAGE"])


def test_dockerfile_is_linted() -> None:
    hadolint = shutil.which("hadolint", path=str(Path(sys.executable).parent)) or shutil.which("hadolint")
    if hadolint is None:
        pytest.skip("hadolint is not installed")
    done = subprocess.run(
        [hadolint, "--no-color", str(DOCKER / "Dockerfile")], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "")


def test_front_end_requirements_match_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    known = {*project["dependencies"], *project["optional-dependencies"]["s3"]}
    lines = (DOCKER / "front-end.txt").read_text().splitlines()
    listed = [line for line in lines if line and not line.startswith("#")]
    assert set(listed) <= known
    names = {re.split(r"[\[<>=~;]", line)[0] for line in listed}
    assert not names & {"torch", "numba", "scipy", "embreex", "OpenImageIO"}


def test_dockerfile_copies_existing_unignored_files() -> None:
    ignored = (DOCKER / "Dockerfile.dockerignore").read_text().splitlines()
    assert ignored[0] == "*"
    let_in = {line[1:] for line in ignored if line.startswith("!")}
    copied = {
        source for _, word, rest in instructions() if word == "COPY" for source in rest.split()[:-1]
    }  # fmt: skip
    assert copied == let_in
    assert all((ROOT / source).exists() for source in copied)
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    for source in copied:
        assert source in tracked.stdout, source


def test_images_do_not_run_as_root_and_hold_no_secret() -> None:
    stages = {stage for stage, _, _ in instructions()} - {"", "base"}
    assert stages == {"front-end", "worker-cpu"}
    for stage in stages:
        users = [rest for s, word, rest in instructions() if s == stage and word == "USER"]
        assert users == ["10001"], stage
        last = [word for s, word, _ in instructions() if s == stage][-1]
        assert last == "CMD"
    text = (DOCKER / "Dockerfile").read_text() + (DOCKER / "compose.yaml").read_text()
    assert not re.search(r"(?i)(password|secret|token)\w*[:=] *['\"]?[a-z0-9]{6,}", text.replace("${", "\0"))


def test_compose_images_exist_in_dockerfile() -> None:
    stages = {stage for stage, _, _ in instructions()}
    services = compose()["services"]
    for name, service in services.items():
        if "build" in service:
            build = service["build"]
            assert build["target"] in stages and (DOCKER / build["context"]).resolve() == ROOT, name
            assert (ROOT / build["dockerfile"]).is_file()
            assert service["image"] == f"octasplat/{build['target']}"
        else:
            assert re.fullmatch(PINNED, service["image"]), f"{name}: name the version and the digest"
        for needed in service.get("depends_on", {}):
            assert needed in services
        for volume in service.get("volumes", []):
            assert volume.partition(":")[0] in compose()["volumes"]
        for config in service.get("configs", []):
            assert config["source"] in compose()["configs"]
    for name in ("front-end", "worker", "maintenance"):
        service = services[name]
        assert service["cap_drop"] == ["ALL"] and "no-new-privileges:true" in service["security_opt"]
        assert service["depends_on"]["database"]["condition"] == "service_healthy"


def test_compose_publishes_front_end_on_localhost_only() -> None:
    published = {
        name: service["ports"] for name, service in compose()["services"].items() if "ports" in service
    }
    assert list(published) == ["front-end"]
    assert all(port.startswith("127.0.0.1:") for port in published["front-end"])


def test_compose_settings_exist() -> None:
    known = {f"OCTASPLAT_{name.upper()}" for name in ServiceSettings.model_fields}
    used = {
        name
        for service in compose()["services"].values()
        for name in service.get("environment", {})
        if name.startswith("OCTASPLAT_")
    }
    used |= {
        pair.partition("=")[0]
        for _, word, rest in instructions()
        if word == "ENV"
        for pair in rest.split()
        if pair.startswith("OCTASPLAT_")
    }
    assert used and used <= known
    commands = [rest for _, word, rest in instructions() if word == "CMD"]
    assert '["octasplat", "worker", "--queues", "cpu"]' in commands


def test_workers_get_longer_to_stop_than_they_take() -> None:
    grace = ServiceSettings.model_fields["grace_seconds"].default
    for name in ("worker", "maintenance"):
        assert int(compose()["services"][name]["stop_grace_period"].removesuffix("s")) > grace


def test_scripts_in_compose_are_python_and_json() -> None:
    import json

    configs = compose()["configs"]
    compile(configs["bucket"]["content"], "bucket.py", "exec")
    filled = configs["s3"]["content"].replace("${OCTASPLAT_PASSWORD}", "x")
    assert json.loads(filled)["identities"][0]["credentials"][0]["secretKey"] == "x"
    assert "$" not in configs["bucket"]["content"]
