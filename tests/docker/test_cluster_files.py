"""Files that start workers on a cluster: Kubernetes takes the manifest, and Slurm ends workers as told."""

import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from octasplat.workers.settings import WorkerSettings
from tests.docker.test_docker_files import ROOT

MANIFEST = ROOT / "deploy" / "kubernetes.yaml"
SCRIPT = ROOT / "deploy" / "workers.sbatch"


def documents() -> list[dict[str, Any]]:
    return list(yaml.safe_load_all(MANIFEST.read_text()))


def pod() -> dict[str, Any]:
    [deployment] = [found for found in documents() if found["kind"] == "Deployment"]
    spec: dict[str, Any] = deployment["spec"]["template"]["spec"]
    return spec


def test_manifest_fits_the_schemas_of_kubernetes() -> None:
    newest = kubernetes_validate.latest_version()
    for document in documents():
        kubernetes_validate.validate(document, newest, strict=True)
    broken = next(found for found in documents() if found["kind"] == "Deployment")
    broken["spec"]["template"]["spec"]["containers"][0]["unheard_of"] = ["x"]
    with pytest.raises(kubernetes_validate.ValidationError, match="unheard_of"):
        kubernetes_validate.validate(broken, newest, strict=True)


def test_pods_have_limits_and_time_to_hand_back_their_jobs() -> None:
    [container] = pod()["containers"]
    grace_seconds = WorkerSettings.model_fields["grace_seconds"].default
    assert pod()["terminationGracePeriodSeconds"] > grace_seconds
    assert container["resources"]["limits"].keys() == {"cpu", "memory", "ephemeral-storage"}
    assert container["securityContext"]["readOnlyRootFilesystem"] is True
    assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
    assert pod()["securityContext"]["runAsNonRoot"] is True
    # The folders that the image writes to, and no others.
    mounts = {mount["mountPath"] for mount in container["volumeMounts"]}
    assert mounts == {"/data", "/var/cache/octasplat", "/tmp"}
    text = (ROOT / "docker" / "Dockerfile").read_text()
    assert str(pod()["securityContext"]["runAsUser"]) in re.findall(r"USER (\d+)", text)


def test_jobs_end_before_their_volume_evicts_the_pod() -> None:
    """A worker sees the room of the node, not the limit of its volume."""
    [config] = [found for found in documents() if found["kind"] == "ConfigMap"]
    [size] = [volume["emptyDir"]["sizeLimit"] for volume in pod()["volumes"] if volume["name"] == "work"]
    most = int(config["data"].get("OCTASPLAT_MAX_WORKSPACE_BYTES", 64 << 30))
    assert most < int(size.removesuffix("Gi")) << 30


def test_selectors_choose_the_pods() -> None:
    labels = {"app.kubernetes.io/name": "octasplat", "app.kubernetes.io/component": "worker"}
    for document in documents():
        selector = document.get("spec", {}).get("selector") or document.get("spec", {}).get("podSelector")
        assert selector is None or selector["matchLabels"] == labels


def test_slurm_script_hands_the_signal_to_the_worker(tmp_path: Path) -> None:
    """The script becomes the worker, so that SIGTERM reaches that, on the threads of its allocation."""
    (tmp_path / "worker.env").write_text("DATABASE_URL='postgresql:///x y'\n")
    stub = tmp_path / "octasplat"
    stub.write_text(
        '#!/bin/sh\ntrap "echo handed back; exit 0" TERM\n'
        'echo "$@ $OCTASPLAT_THREADS $DATABASE_URL $OCTASPLAT_WORK"\nwhile :; do sleep 0.1; done\n'
    )
    stub.chmod(0o755)
    environment = {
        "PATH": os.environ["PATH"],
        "SLURM_JOB_ID": "71",
        "SLURM_CPUS_PER_TASK": "8",
        "SLURM_TMPDIR": str(tmp_path / "node"),
        "OCTASPLAT_ENVIRONMENT": str(tmp_path / "worker.env"),
        "OCTASPLAT_COMMAND": str(stub),
    }
    output = tmp_path / "log"
    with output.open("wb") as log:
        process = subprocess.Popen(["bash", str(SCRIPT)], env=environment, stdout=log)
    deadline = time.monotonic() + 60
    while not output.read_text() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 0
    # No folder of this job alone: no other worker would sweep it.
    work = tmp_path / "node" / f"octasplat-{os.getuid()}"
    assert output.read_text().splitlines() == [
        f"worker --queues cpu --name slurm-71 8 postgresql:///x y {work}",
        "handed back",
    ]
    assert work.stat().st_mode & 0o777 == 0o700


@pytest.mark.skipif(shutil.which("sbatch") is None, reason="there is no Slurm")
def test_slurm_knows_all_directives() -> None:
    done = subprocess.run(["sbatch", "--test-only", str(SCRIPT)], capture_output=True, text=True)
    assert not re.search(r"(?i)invalid|unrecogni[sz]ed|unknown option", done.stderr), done.stderr


def test_slurm_asks_for_time_to_hand_back() -> None:
    [signal_option] = re.findall(r"^#SBATCH --signal=(.*)$", SCRIPT.read_text(), re.MULTILINE)
    found = re.fullmatch(r"B:TERM@(\d+)", signal_option)
    assert found is not None and int(found[1]) > WorkerSettings.model_fields["grace_seconds"].default
