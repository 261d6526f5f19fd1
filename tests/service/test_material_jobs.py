"""Jobs on results with materials: what cannot be done is refused before it is queued."""

from pathlib import Path

import pytest
from test_stage_jobs import HDR, finished, sent

from octasplat.engine.core.errors import ConfigError
from octasplat.workers.client.submission import Derivation, with_environments
from tests.support.service_harness import committed_dataset, running_service

SHINY = {"environment.hdr": HDR, "scene.ply": b"ply"}


async def test_materials_and_relight_jobs_over_http(conninfo: str, tmp_path: Path) -> None:
    async with running_service(conninfo, tmp_path) as (http, service):
        plain = await finished(http, service, {"scene.ply": b"ply"})
        shiny = await finished(http, service, SHINY)
        change = {"set": {"roughness": 0.3, "albedo": "#ff8000"}, "where": "metallic > 0.5"}
        made = await http.post("/v1/jobs", json={"kind": "material", "source_id": shiny, "options": change})
        assert made.status_code == 202, made.text
        assert made.json()["options"]["set"]["albedo"][0] == 1.0  # linear from here on
        for source, options, pointer, words in (
            (plain, change, "#/source_id", "has no environment.hdr"),
            (shiny, {**change, "where": "metallic >"}, "#/options/where", "is no expression"),
            (shiny, {"set": {"roughness": 3}}, "#/options/set/roughness", "less than or equal to 1"),
            (shiny, {}, "#/options/", "nothing is changed"),
        ):
            body = {"kind": "material", "source_id": source, "options": options}
            refused = await http.post("/v1/jobs", json=body)
            assert refused.status_code == 422, refused.text
            [fault] = refused.json()["errors"]
            assert fault["pointer"] == pointer and words in fault["detail"], fault

        files = await sent(http, {"studio.hdr": HDR})
        relit = {"environments": ["studio.hdr"], "mode": "views", "format": "png"}
        body = {"kind": "relight", "source_id": shiny, "files_id": files, "options": relit}
        assert (await http.post("/v1/jobs", json=body)).status_code == 202
        missing = await http.post("/v1/jobs", json={**body, "options": {"environments": ["a.hdr"]}})
        assert missing.json()["errors"][0]["pointer"] == "#/options/environments/0"
        refused = await http.post("/v1/jobs", json={**body, "source_id": plain})
        assert "has no environment.hdr" in refused.json()["errors"][0]["detail"]


async def test_evaluate_job_measures_other_dataset(conninfo: str, tmp_path: Path) -> None:
    async with running_service(conninfo, tmp_path) as (http, service):
        source = await finished(http, service, SHINY)
        others, bare = [await committed_dataset(service, has_poses=posed) for posed in (True, False)]
        body = {"kind": "evaluate", "source_id": source}
        own = (await http.post("/v1/jobs", json=body)).json()
        assert own["options"] == {"all_views": False} and own["dataset_id"] not in (None, others)
        made = (await http.post("/v1/jobs", json={**body, "dataset_id": others})).json()
        assert made["options"] == {"all_views": True} and made["dataset_id"] == others
        files = await sent(http, {"studio.hdr": HDR})
        for dataset, words in ((bare, "no COLMAP model"), (files, "no photographs"), (source, "no such")):
            refused = await http.post("/v1/jobs", json={**body, "dataset_id": dataset})
            [fault] = refused.json()["errors"]
            assert refused.status_code == 422 and words in fault["detail"], fault
            assert fault["pointer"] == "#/dataset_id"
        refused = await http.post("/v1/jobs", json={**body, "kind": "render", "dataset_id": others})
        assert refused.json()["errors"][0]["pointer"] == "#/dataset_id"


def test_maps_are_named_and_sent(tmp_path: Path) -> None:
    for name in ("a.hdr", "\u00e4.exr"):
        (tmp_path / name).write_bytes(HDR)
    what = with_environments(Derivation("j", "relight", {"spin": True}), list(tmp_path.iterdir()))
    assert what.options["environments"] == list(what.files) and len(what.files) == 2
    with pytest.raises(ConfigError, match="no such file"):
        with_environments(what, [tmp_path / "b.hdr"])
