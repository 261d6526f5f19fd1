"""Options of the commands that talk to a service: what is asked for arrives, and nothing more is replaced."""

import json
from collections.abc import Iterator

import pytest

from octasplat.engine.core.events import PhaseFinished
from octasplat.workers.client import submission
from octasplat.workers.client.submission import Derivation, with_camera_path, with_stage
from tests.support.http_server import QuietHandler, serve_http

JOB = {
    "id": "01999999-0000-7000-8000-000000004711", "kind": "render", "label": None, "state": "failed",
    "psnr": None, "error": None,
    "options": {"frames": 9, "stage": {"meshes": [{"shape": "sphere"}], "integrator": {"samples": 2}}},
}  # fmt: skip


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[dict]]:
    """What is posted to a service with one job."""
    posted: list[dict] = []

    class Service(QuietHandler):
        def respond(self) -> None:
            if self.command == "POST":
                posted.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.answer(json.dumps(JOB).encode())

    with serve_http(Service) as address:
        monkeypatch.setenv("OCTASPLAT_SERVER", address)
        monkeypatch.setenv("OCTASPLAT_TOKEN", "a-token")
        yield posted


def test_nested_assignment_keeps_other_values(octasplat, asked: list[dict]) -> None:
    done = octasplat("retry", JOB["id"], "--set", "stage.integrator.samples=16", "--set", "frames=3")
    assert done.exit_code == 0, done.output
    stage = {"meshes": [{"shape": "sphere"}], "integrator": {"samples": 16}}
    assert asked[0]["options"] == {"frames": 3, "stage": stage}


def test_assignments_win_over_the_files_of_a_stage_and_a_path(tmp_path) -> None:
    stage = tmp_path / "stage.toml"
    stage.write_text("[[meshes]]\nshape = 'sphere'\n[integrator]\nsamples = 2\n")
    given = {"stage": {"integrator": {"samples": 16}}, "camera_path": {"fps": 7}}
    read = with_stage(Derivation("4711", "render", given), stage).options["stage"]
    assert read["integrator"]["samples"] == 16 and read["meshes"][0]["shape"] == "sphere"
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    path = tmp_path / "path.json"
    frame = {"camera_to_world": pose, "fov_y_degrees": 40}
    path.write_text(json.dumps({"width": 32, "height": 24, "fps": 5, "frames": [frame]}))
    options = with_camera_path(Derivation("4711", "render", given), path).options
    assert options["camera_path"]["fps"] == 7 and options["camera_path"]["width"] == 32


def test_open_glass_is_refused_before_it_is_sent(tmp_path, octasplat, asked: list[dict]) -> None:
    stage = tmp_path / "stage.toml"
    stage.write_text("[[meshes]]\nfile = 'leaf.obj'\nmaterial = { kind = 'glass' }\n")
    (tmp_path / "leaf.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    done = octasplat("derive", "render", JOB["id"], "--stage", str(stage))
    assert done.exit_code != 0 and "leaf.obj is not closed (3 edges" in done.stderr and not asked
    tetrahedron = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "leaf.obj").write_text(tetrahedron)
    assert list(with_stage(Derivation(JOB["id"], "render"), stage).files) == ["leaf.obj"]


def test_submit_names_the_job_that_it_begins_with(octasplat, asked: list[dict]) -> None:
    done = octasplat("submit", "--start-from", JOB["id"], "--preset", "high")
    assert done.exit_code == 0, done.output
    dataset = "01999999-0000-7000-8000-000000000815"
    done = octasplat("submit", dataset, "--start-from", JOB["id"])
    assert done.exit_code == 0, done.output
    first, checked, second = asked  # options are checked before photographs would be sent
    assert checked == {"kind": "reconstruct", "options": {}, "queue": "cpu"}
    assert first["source_id"] == second["source_id"] == JOB["id"]
    assert first["options"] == {"preset": "high"} and "dataset_id" not in first
    assert second["dataset_id"] == dataset
    refused = octasplat("submit", "--preset", "high")
    assert refused.exit_code == 2 and "--start-from" in refused.stderr and len(asked) == 3


@pytest.mark.parametrize("command", [("submit", "photos"), ("derive", "render", JOB["id"])])
def test_output_folder_requires_wait(octasplat, asked: list[dict], command) -> None:
    refused = octasplat(*command, "-o", "out")
    assert refused.exit_code == 2 and "--wait" in refused.stderr
    assert asked == []


def test_json_output_contains_only_job(octasplat, asked: list[dict], monkeypatch) -> None:
    def wait_for(_api, _job_id, listener, _on_note):
        listener(PhaseFinished("render", 1.0))
        return JOB

    monkeypatch.setattr(submission, "wait_for_job", wait_for)
    assert json.loads(octasplat("status", JOB["id"], "--wait", "--json").stdout) == JOB
