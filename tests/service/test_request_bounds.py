"""Requests that are small to send and long to read: refused at once, while everybody else is answered."""

import asyncio
import re
import time
from typing import Any

import httpx
import pytest

from octasplat.engine.operations.render import parse_stage_text
from octasplat.engine.pathtracing.stage.model import Stage
from octasplat.engine.pathtracing.stage.text_bounds import check_stage_text
from tests.support.daily import some_daily
from tests.support.documentation import ROOT
from tests.support.service_harness import ConnectService, new_job

LONGEST_SECONDS = 6.0
"""Within which `/healthz` answers, on a machine that does much else besides."""

UNKNOWN = {f"{number}{'n' * 2000}": 1 for number in range(500)}
ATTACKS: dict[str, dict[str, Any]] = {
    "a key of 20,000 parts": {"stage": ".".join("a" * 20_000) + " = 1"},
    "a table of 10,000 parts": {"stage": f"[{'.'.join(['a'] * 10_000)}]"},
    "quoted parts": {"stage": ".".join(['"a.b"'] * 4000) + " = 1"},
    "nested brackets": {"stage": "a = " + "[" * 400 + "]" * 400},
    "80,000 tables": {"stage": "[[meshes]]\n" * 80_000},
    "20,000 tables": {"stage": "[[meshes]]\n" * 20_000},
    "strings that nothing closes": {"stage": '"""\\' * 50_000},
    "200,000 blanks and dots": {"stage": "a . " * 50_000},
    "50,000 unknown keys": {f"key_{number}": 1 for number in range(50_000)},
    "a list of 200,000 values": {"stage": {"meshes": [1] * 200_000}},
    "1 MB of unknown options": UNKNOWN,
    "1 MB of unknown settings of the training": {"train": UNKNOWN},
}


ALWAYS = {"50,000 unknown keys", "1 MB of unknown settings of the training"}
"""The slowest ones; the others are exhaustive."""


async def answer_beside_healthz(
    http: httpx.AsyncClient, path: str, body: dict[str, Any]
) -> tuple[httpx.Response, float, float]:
    """The answer, the seconds that it took, and the slowest answer of `/healthz` meanwhile."""
    begun = time.monotonic()
    post = asyncio.create_task(http.post(path, json=body, timeout=120))
    slowest = 0.0
    while not post.done():
        asked = time.monotonic()
        await asyncio.sleep(0.005)  # the loop may be held here as well, which a client would wait for
        assert (await http.get("/healthz")).status_code == 200
        slowest = max(slowest, time.monotonic() - asked)
    return await post, time.monotonic() - begun, slowest


@pytest.mark.parametrize("kind", ["render", "reconstruct"])
@pytest.mark.parametrize("name", some_daily(ATTACKS, ALWAYS))
async def test_costly_options_are_refused_while_others_are_answered(
    connect_service: ConnectService, name: str, kind: str
) -> None:
    async with connect_service() as (http, service):
        options = ATTACKS[name]
        job = await new_job(http, service)
        await http.post("/v1/estimates", json={"kind": kind, "options": {"unknown": 1}})  # what loads once
        for path, body in (
            ("/v1/jobs", {"kind": kind, "options": options}),
            ("/v1/estimates", {"kind": kind, "options": options}),
            (f"/v1/jobs/{job['id']}/retry", {"options": options}),
        ):
            answer, seconds, slowest = await answer_beside_healthz(http, path, body)
            assert answer.status_code == 422, (path, answer.text[:300])
            problem = answer.json()
            assert answer.headers["content-type"] == "application/problem+json"
            assert len(answer.content) < 500_000
            # Of the training only the kind reconstruct knows; the job that is tried again is of another kind.
            is_known = "train" not in options or (kind == "reconstruct" and not path.endswith("retry"))
            if name.startswith("1 MB") and is_known:
                assert len(problem["errors"]) == 50 and problem["detail"].endswith("450 more are not listed.")
            else:
                assert len(problem["errors"]) == 1
            assert seconds < 5 * LONGEST_SECONDS and slowest < LONGEST_SECONDS, (path, seconds, slowest)


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/v1/webhooks", {f"key_{number}": 1 for number in range(50_000)}),
        ("/v1/datasets", {f"key_{number}": 1 for number in range(50_000)}),
        ("/v1/estimates", {"photographs": [{f"k{n}": 1 for n in range(100)}] * 900}),
    ],
)
async def test_other_bodies_with_many_faults_are_refused_shortly(
    connect_service: ConnectService, path: str, body: dict[str, Any]
) -> None:
    async with connect_service() as (http, _):
        answer, seconds, slowest = await answer_beside_healthz(http, path, body)
        assert answer.status_code == 422 and len(answer.json()["errors"]) == 1, answer.text[:300]
        assert seconds < 5 * LONGEST_SECONDS and slowest < LONGEST_SECONDS, (seconds, slowest)


def test_stages_of_documents_and_examples_are_within_bounds() -> None:
    documents = [*ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/**/*.md")]
    texts = [
        text
        for path in documents
        for text in re.findall(r"```toml\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)
    ]
    texts += [path.read_text(encoding="utf-8") for path in ROOT.glob("examples/**/*.toml")]
    staged = [text for text in texts if "[[meshes]]" in text or "[[lights]]" in text]
    assert staged
    for text in staged:
        Stage.model_validate(parse_stage_text(text))


def test_text_within_strings_and_comments_is_not_structure() -> None:
    check_stage_text("# " + "a." * 1000 + "[" * 1000 + "\nname = 'a.b.c.d.e.f.g.h.i.j' # [[[[\n")
    check_stage_text('name = """' + "a.[" * 1000 + '\\""" ' + '"""\n')
    check_stage_text("x = [\n" + "  [1.5, -2.25, 3e-4],\n" * 1000 + "]\n")
    mesh = "[[meshes]]\nshape = 'cube'\nposition = [1, 2, 3]\nscale = 0.5\n"
    check_stage_text(mesh * 1000)
    for text, words in (
        ("a.b.c.d.e.f.g.h.i = 1", "parts"),
        ("x = " + "{a=" * 25, "deeper"),
        ("# " + "a" * (256 << 10), "characters"),
        ("a = 1\n" * 20_001, "keys, values and tables"),
    ):
        with pytest.raises(ValueError, match=words):
            check_stage_text(text)
