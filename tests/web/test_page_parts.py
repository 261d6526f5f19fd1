"""Pages without a browser: headers, errors as pages, owners, escaping, words."""

import datetime
import html
import re
import subprocess
import sys
import urllib.parse
import uuid

import pytest

from octasplat.engine.render.file_names import unique_render_names
from octasplat.service.web import formatting
from octasplat.service.web.results import download_groups, read_measurements, viewable_mesh
from octasplat.service.web.routing import safe_local_path
from octasplat.workers.db.connections import open_pool
from octasplat.workers.db.events_and_logs import add_event
from octasplat.workers.db.rows import Artifact, DatasetFile
from octasplat.workers.db.tokens import add_token
from octasplat.workers.queue.jobs import NewJob, create_job
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue
from tests.support.service_harness import ConnectService
from tests.support.web_harness import ROOT

HOSTILE = '"><img src=x onerror=alert(1)>'


async def make_job(database: str, **values: object) -> uuid.UUID:
    async with open_pool(database, max_size=1, wait_seconds=10) as pool, pool.connection() as connection:
        fields = {"owner": "local", "kind": "reconstruct", "options": {}, "queue": "nobody", **values}
        return (await create_job(connection, ProcrastinateQueue(), NewJob(**fields))).id


async def test_unexpected_stages_are_inserted_in_order(
    connect_service: ConnectService, database: str
) -> None:
    async with connect_service() as (http, _):
        job_id = await make_job(database, options={"poses": "given"})
        async with open_pool(database, max_size=1, wait_seconds=10) as pool, pool.connection() as connection:
            await connection.execute(
                "UPDATE jobs SET state = 'running', attempt = 1, stage = 'matches' WHERE id = %s", [job_id]
            )
            for name in ("load", "check", "features"):
                await add_event(connection, job_id, 1, "stage_finished", {"stage": name, "seconds": 2.0})
        page = (await http.get(f"/jobs/{job_id}")).text
        listed = re.search(r'<ol class="stages".*?</ol>', page, re.DOTALL)
        assert listed is not None
        stages = re.findall(r'<li class="(\w+)"[^>]*>(\w+)', listed[0])
        done, later = (("load", "check", "features"), ("train", "evaluate", "export"))
        wanted = [*(("done", name) for name in done), ("now", "matches"), *(("later", n) for n in later)]
        assert stages == wanted


async def test_content_policy_allows_only_own_scripts(connect_service: ConnectService) -> None:
    async with connect_service() as (http, _):
        for path in ("/", "/new", "/sign-in", "/docs", f"/jobs/{uuid.uuid4()}"):
            answer = await http.get(path)
            assert answer.headers["content-type"].startswith("text/html")
            policy = answer.headers["content-security-policy"]
            assert (
                "unsafe" not in policy
                and "default-src 'none'" in policy
                and "frame-ancestors 'none'" in policy
            )
            assert answer.headers["cache-control"] == "no-store"
            # Nothing in the page would need more than that.
            assert not re.search(r"<script(?![^>]*\ssrc=)", answer.text)
            assert not re.search(r"\s(style|on[a-z]+)=", answer.text)
            assert not re.search(r'(src|href)="(https?:)?//', answer.text)


async def test_static_files_are_served_with_headers(connect_service: ConnectService) -> None:
    async with connect_service() as (http, _):
        page = (await http.get("/")).text
        paths = re.findall(r'(?:src|href)="(/static/[^"]+)"', page)
        assert paths
        for path in paths:
            assert (await http.get(path)).status_code == 200, path
        answer = await http.get("/static/vendor/three.js")
        assert answer.headers["content-type"].startswith("text/javascript")
        again = await http.get("/static/vendor/three.js", headers={"If-None-Match": answer.headers["etag"]})
        assert again.status_code == 304
        licences = (await http.get("/static/vendor/LICENSES.txt")).text
        for name in ("three", "uplot", "htmx.org", "@noble/hashes"):
            assert re.search(rf"^{name} \d", licences, re.MULTILINE), name
        for path in ("/static/../pages.py", "/static/%2e%2e/pages.py", "/static/nothing.js"):
            assert (await http.get(path)).status_code == 404


async def test_page_links_api_description(connect_service: ConnectService) -> None:
    async with connect_service() as (http, _):
        document = (await http.get("/openapi.json")).json()
        page = (await http.get("/docs")).text
        assert document["paths"]
        for path, item in document["paths"].items():
            assert f"<code>{path}</code>" in page, path
            assert "/docs" not in path and item


async def test_errors_are_pages_or_notices(connect_service: ConnectService, database: str) -> None:
    async with connect_service() as (http, _):
        for path in (f"/jobs/{uuid.uuid4()}", "/jobs/nonsense", f"/jobs/{uuid.uuid4()}/report"):
            answer = await http.get(path)
            assert answer.status_code == 404 and "There is no such" in answer.text
        job = await make_job(database)
        part = {"HX-Request": "true"}
        refused = await http.post(f"/jobs/{job}/retry", headers=part)
        assert refused.status_code == 409 and refused.text == ""
        assert "Only failed and canceled jobs" in refused.headers["hx-trigger"]
        assert refused.headers["hx-reswap"] == "none"
        done = await http.post(f"/jobs/{job}/cancel", headers=part)
        assert done.status_code == 200 and 'data-state="canceled"' in done.text
        plain = await http.post(f"/jobs/{job}/retry")  # a form without scripts
        assert plain.status_code == 303 and plain.headers["location"] == f"/jobs/{job}"
        foreign = await http.post(f"/jobs/{job}/cancel", headers={"Origin": "https://evil.example"})
        assert foreign.status_code == 403


async def test_names_of_users_are_text(connect_service: ConnectService, database: str) -> None:
    async with connect_service() as (http, _):
        job = await make_job(database, label=HOSTILE)
        for path in ("/", f"/jobs/{job}", f"/parts/jobs/{job}", "/parts/jobs"):
            text = (await http.get(path)).text
            assert HOSTILE not in text and "&#34;&gt;&lt;img" in text


async def test_job_that_is_run_again_keeps_its_queue(connect_service: ConnectService, database: str) -> None:
    async with connect_service() as (http, _):
        job = await make_job(database, queue="night")
        page = (await http.get("/new", params={"like": str(job)})).text
        queues = re.search(r'<select id="queue">(.*?)</select>', page)
        assert queues is not None
        options = re.findall(r'<option value="(\w+)"( selected)?>', queues[1])
        assert options == [("cpu", ""), ("night", " selected")]


async def test_job_list_shows_own_jobs_only(connect_service: ConnectService, database: str) -> None:
    async with connect_service(signed_in=False) as (http, _):
        job = await make_job(database, owner="ann", label="of ann")
        async with open_pool(database, max_size=1, wait_seconds=10) as pool, pool.connection() as connection:
            for owner, scope in (("ann", "write"), ("bob", "write"), ("eve", "read")):
                await add_token(connection, f"octa_{owner}", owner=owner, name=owner, scopes=[scope])
        as_user = {}
        for name in ("ann", "bob", "eve"):
            entered = await http.post("/sign-in", data={"token": f"octa_{name}"})
            as_user[name] = {"Cookie": entered.headers["set-cookie"].partition(";")[0]}
            http.cookies.clear()
        assert "of ann" in (await http.get("/", headers=as_user["ann"])).text
        for path in (
            f"/jobs/{job}",
            f"/parts/jobs/{job}",
            f"/jobs/{job}/cameras.json",
            f"/jobs/{job}/report",
        ):
            assert (await http.get(path, headers=as_user["bob"])).status_code == 404
        assert "of ann" not in (await http.get("/", headers=as_user["bob"])).text
        assert (await http.post(f"/jobs/{job}/cancel", headers=as_user["bob"])).status_code == 404
        page = await http.get("/", headers=as_user["eve"])
        assert page.status_code == 200 and 'href="/new">New job' not in page.text.partition("<main")[2]
        assert (await http.get("/new", headers=as_user["eve"])).status_code == 403
        unknown = await http.get("/new")
        assert unknown.status_code == 303 and unknown.headers["location"] == "/sign-in?next=/new"
        asked = await http.get("/compare", params={"job": ["1", "2"], "view": "a b.png"})
        following = "/compare?job=1&job=2&view=a+b.png"
        wanted = "/sign-in?next=" + urllib.parse.quote(following, safe="/")
        assert asked.status_code == 303 and asked.headers["location"] == wanted
        assert f'value="{html.escape(following)}"' in (await http.get(wanted)).text
        long = await http.get("/compare", params={"job": ["1" * 40] * 60})
        assert long.headers["location"] == "/sign-in?next=/compare"
        part = await http.get("/parts/jobs", headers={"HX-Request": "true"})
        assert part.status_code == 200 and part.headers["hx-redirect"].startswith("/sign-in")


def test_pages_do_not_slow_down_start() -> None:
    code = "import octasplat.service.app, sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {"torch", "numba", "pycolmap", "jinja2", "scipy", "embreex"}


@pytest.mark.parametrize(
    "address", ["//evil.example", "/\\evil.example", "https://evil.example", "", None, "x", "/a\nb"]
)
def test_sign_in_redirects_to_own_site_only(address: str | None) -> None:
    assert safe_local_path(address) == "/"
    assert safe_local_path("/jobs/1") == "/jobs/1"


def test_formatting_of_sizes_and_durations() -> None:
    assert [formatting.format_size(n) for n in (0, 999, 1000, 123456, 99_950_000, 5 << 30)] == [
        "0 B", "999 B", "1.0 kB", "123 kB", "100 MB", "5.4 GB",
    ]  # fmt: skip
    assert [formatting.format_duration(s) for s in (0.4, 59.6, 61, 3599, 3600, 9000, 200_000)] == [
        "0 s", "1 min", "1 min 1 s", "59 min", "1 h", "2 h 30 min", "2 d 7 h",
    ]  # fmt: skip
    now = datetime.datetime(2026, 1, 2, tzinfo=datetime.UTC)
    spans = (3, 120, 7200, 86_400, 400_000)
    assert [formatting.format_age(now - datetime.timedelta(seconds=s), now) for s in spans] == [
        "just now", "2 min ago", "2 h ago", "yesterday", "5 days ago",
    ]  # fmt: skip


def artifact(name: str) -> Artifact:
    return Artifact(uuid.uuid4(), name, "0" * 64, 10, "application/octet-stream")


def test_downloads_name_programs_that_open_them() -> None:
    names = [
        "scene.ply",
        "mesh.glb",
        "viewer.glb",
        "octagons.glb",
        "scene.splats.glb",
        "mesh.obj",
        "x.spz",
        "report.html",
        "renders/a.png",
        "poses/images.bin",
        "odd",
    ]
    groups = download_groups([artifact(name) for name in names])
    found = {file.name: file.opens_in for group in groups for file in group.files}
    assert set(found) == set(names) and all(found.values())
    assert "KHR_gaussian_splatting" in found["scene.splats.glb"] and "Blender" in found["mesh.glb"]
    assert "any glTF viewer" in found["viewer.glb"]
    assert "haze" in found["mesh.glb"] and found["mesh.glb"] == found["octagons.glb"]
    assert groups[0].files[0].name == "scene.ply"
    assert [group.title for group in groups if group.folded] == ["Images", "Records of the run"]


def test_tiles_are_parts_of_what_opens_them_and_no_meshes() -> None:
    rows = [artifact(name) for name in ("tileset.json", "tiles/0_0.glb", "lod-meta.json", "0_0/meta.json")]
    groups = {group.title: [file.name for file in group.files] for group in download_groups(rows)}
    assert groups == {
        "Scene and meshes": ["lod-meta.json", "tileset.json"],
        "Parts of levels of detail": ["0_0/meta.json", "tiles/0_0.glb"],
    }
    assert viewable_mesh(rows) is None


def test_views_are_worst_first_and_odd_figures_do_no_harm() -> None:
    metrics = {
        "mean": {"psnr": 25.0, "ssim": 0.8, "ms_ssim": None, "flip": "x"},
        "mean_psnr_ci95": [24, None],
        "views": {
            "b.jpg": {"psnr": 30.0, "width": 4, "height": 3},
            "a.tif": {"psnr": 20.0},
            "c.jpg": {"psnr": None},
        },
    }
    photographs = [
        DatasetFile(uuid.uuid4(), f"images/{n}", "", 1, {}, datetime.datetime.now(datetime.UTC))
        for n in ("a.tif", "b.jpg")
    ]
    found = read_measurements(metrics, [artifact("renders/a.png"), artifact("renders/b.png")], photographs)
    assert found is not None
    assert [view.name for view in found.views] == ["a.tif", "b.jpg", "c.jpg"]
    assert [view.photograph for view in found.views] == [None, "images/b.jpg", None]  # no browser shows TIFF
    assert [view.render for view in found.views] == ["renders/a.png", "renders/b.png", None]
    assert [metric.key for metric in found.columns] == ["psnr", "ssim"] and found.interval is None
    assert (
        read_measurements({}, [], []) is None and read_measurements({"mean": [1], "views": 3}, [], []) is None
    )


def test_view_with_the_stem_of_a_trained_one_has_its_render() -> None:
    assert unique_render_names(["s/a.jpg", "s/a.png", "b.jpg"]) == ("s/a.jpg", "s/a.png", "b")
    metrics = {"mean": {"psnr": 25.0}, "views": {"s/a.jpg": {"psnr": 1.0}, "b.jpg": {"psnr": 2.0}}}
    names = ["renders/s/a.jpg.png", "renders/b.png", "layers/normal/s/a.jpg.png"]
    found = read_measurements(metrics, [artifact(name) for name in names], [])
    assert found is not None
    assert [view.render for view in found.views] == names[:2]
    assert found.views[0].layers == {"normal": names[2]}


def test_same_stem_views_have_own_renders() -> None:
    metrics = {"mean": {"psnr": 25.0}, "views": {"s/a.jpg": {"psnr": 1.0}, "s/a.png": {"psnr": 2.0}}}
    names = ["renders/s/a.jpg.png", "renders/s/a.png.png"]
    found = read_measurements(metrics, [artifact(name) for name in names], [])
    assert found is not None
    assert [view.render for view in found.views] == names
