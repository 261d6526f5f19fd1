"""Jobs that mesh, measure and look at a scene: options are refused with the sentences of the commands."""

from pathlib import Path

from click.testing import CliRunner
from test_stage_jobs import finished

from octasplat.workers.cli.main import cli
from tests.support.service_harness import running_service


async def test_options_are_refused_with_the_sentence_of_the_command(conninfo: str, tmp_path: Path) -> None:
    cases = (
        ("surface", "fill_holes", "--fill-holes", "some"),
        ("surface", "max_triangles", "--max-triangles", "5k,5000"),
        ("evaluate", "scales", "--scales", "2,zero"),
        ("material", "where", "--where", "metallic >"),
        ("material", "set", "--set", "roughness"),
        ("material", "set/rough", "--set", "rough=1"),
    )

    (tmp_path / "none.ply").touch()
    async with running_service(conninfo, tmp_path) as (http, service):
        source = await finished(http, service, {"scene.ply": b"ply", "environment.hdr": b"hdr"})
        for kind, path, flag, text in cases:
            name, _, part = path.partition("/")
            value: object = {part: text.partition("=")[2]} if part else text
            body = {"kind": kind, "source_id": source, "options": {name: value}}
            refused = await http.post("/v1/jobs", json=body)
            assert refused.status_code == 422, refused.text
            [fault] = refused.json()["errors"]
            assert fault["pointer"] == f"#/options/{path}"
            arguments = [kind, str(tmp_path / "none.ply"), flag, text]
            output = [] if kind == "evaluate" else ["-o", str(tmp_path / "a.glb")]
            done = CliRunner().invoke(cli, [*arguments, *output])
            assert done.exit_code in (1, 2) and flag in done.stderr
            assert fault["detail"].rstrip(".") in done.stderr, (fault, done.stderr)
        made = await http.post(
            "/v1/jobs",
            json={
                "kind": "surface",
                "source_id": source,
                "options": {"room": True, "max_triangles": 5000},
            },
        )
        assert made.status_code == 202, made.text
        options = made.json()["options"]
        assert options["unseen"] == "solid" and options["max_triangles"] == ["5000"]
        for kind in ("info", "evaluate"):
            made = await http.post("/v1/jobs", json={"kind": kind, "source_id": source})
            assert made.status_code == 202, made.text
