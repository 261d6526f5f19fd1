"""Jobs that change, merge, import and export scenes are refused with reasons, and take files by names."""

from pathlib import Path

import pytest
from test_stage_jobs import HDR, finished, sent

from octasplat.engine.core.errors import ConfigError
from octasplat.workers.cli.named_files import with_named_files
from octasplat.workers.client.submission import Derivation
from tests.support.service_harness import running_service


async def test_scene_job_invalid_options_are_refused_before_queueing(conninfo: str, tmp_path: Path) -> None:
    async with running_service(conninfo, tmp_path) as (http, service):
        source = await finished(http, service, {"scene.ply": b"ply"})
        files = await sent(http, {"a.ply": b"ply\n", "sky.hdr": HDR, "turn.txt": b"1 0 0 0"})
        on = {"source_id": source, "files_id": files}
        for body, pointer, words in (
            ({"kind": "import", "options": {"source": "a.ply"}}, "#/files_id", "works on files_id"),
            ({"kind": "import", "options": {"source": "a.ply"}, **on}, "#/source_id", "files_id alone"),
            (
                {"kind": "import", "options": {"source": "b.ply"}, "files_id": files},
                "#/options/source",
                "there is no file 'b.ply'",
            ),
            ({"kind": "edit", "options": {}, **on}, "#/options/meshes", "required"),
            ({"kind": "edit", "options": {"meshes": ["c.ply"]}, **on}, "#/options/meshes/0", "'c.ply'"),
            ({"kind": "deform", "options": {"proxy": "p.obj", "deformed": ["a.ply"]}, **on},
             "#/options/proxy", "'p.obj'"),
            ({"kind": "merge", "options": {}, **on}, "#/options/", "at least two scenes"),
            ({"kind": "transform", "options": {}, **on}, "#/options/", "Say what to do"),
            ({"kind": "transform", "options": {"matrix": "no.txt"}, **on}, "#/options/matrix", "no.txt"),
            ({"kind": "crop", "options": {}, "source_id": source}, "#/options/", "Say what to keep"),
            ({"kind": "crop", "options": {"where": "x > 0"}, **on}, "#/files_id", "take no files"),
            ({"kind": "export", "options": {"files": ["a.obj"], "opaque": True}, "source_id": source},
             "#/options/", "opaque is for GLB"),
        ):  # fmt: skip
            refused = await http.post("/v1/jobs", json=body)
            assert refused.status_code == 422, (body, refused.text)
            [fault] = refused.json()["errors"]
            assert fault["pointer"] == pointer and words in fault["detail"], fault
        made = await http.post(
            "/v1/jobs", json={"kind": "transform", "options": {"matrix": "turn.txt"}, **on}
        )
        assert made.status_code == 202 and made.json()["dataset_id"] is None
        kinds = {kind["name"]: kind["needs"] for kind in (await http.get("/v1/options")).json()["kinds"]}
        assert kinds["import"] == "files" and kinds["edit"] == "result"


def test_local_files_are_sent_under_option_names(tmp_path: Path) -> None:
    for name in ("f1.ply", "f10.ply", "f2.ply", "p.obj"):
        (tmp_path / name).write_bytes(b"x")
    given = [("deformed", tmp_path / "f*.ply"), ("proxy", tmp_path / "p.obj")]
    what = with_named_files(Derivation("j", "deform"), given)
    assert what.options == {"deformed": ["f1.ply", "f2.ply", "f10.ply"], "proxy": "p.obj"}
    assert set(what.files) == {"f1.ply", "f2.ply", "f10.ply", "p.obj"}
    with pytest.raises(ConfigError, match="proxy: takes one file, and 3 are given"):
        with_named_files(Derivation("j", "deform"), [("proxy", tmp_path / "f*.ply")])
    with pytest.raises(ConfigError, match="no such file"):
        with_named_files(Derivation("j", "merge"), [("scenes", tmp_path / "none.ply")])
