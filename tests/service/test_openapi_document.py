"""Clients are generated from the OpenAPI document: operation ids, descriptions, headers, what lists carry."""

import functools
import json
import re
from typing import Any

import pytest
from openapi_spec_validator import OpenAPIV31SpecValidator

from octasplat.service.app import create_app
from tests.support.service_harness import ConnectService, committed_dataset


@functools.cache
def document() -> dict[str, Any]:
    """The document of a front end."""
    return create_app().openapi()


def test_document_is_valid_by_the_schema_of_its_own_version() -> None:
    served = json.loads(json.dumps(document()))
    assert served["openapi"].startswith("3.1.")
    assert [error.message for error in OpenAPIV31SpecValidator(served).iter_errors()] == []


def test_operation_ids_are_unique_and_in_camel_case() -> None:
    paths = document()["paths"]
    found = [operation["operationId"] for path in paths.values() for operation in path.values()]
    assert len(found) == len(set(found))
    assert {"createJob", "cancelJob", "createDataset", "commitDataset", "createToken"} <= set(found)
    assert [name for name in found if not re.fullmatch(r"[a-z]+([A-Z][a-z]*)*", name)] == []


def test_every_parameter_is_described_and_a_server_is_named() -> None:
    assert [server["url"] for server in document()["servers"]] == ["/"]
    nameless = [
        (path, parameter["name"])
        for path, item in document()["paths"].items()
        for operation in item.values()
        for parameter in operation.get("parameters", ())
        if not parameter.get("description")
    ]
    assert nameless == []
    headers = {
        parameter["name"]
        for item in document()["paths"].values()
        for operation in item.values()
        for parameter in operation.get("parameters", ())
        if parameter["in"] == "header"
    }
    assert {"Range", "Prefer", "Last-Event-ID"} <= headers
    assert [name for name in headers if not re.fullmatch(r"[A-Z][A-Za-z]*(-[A-Z][A-Za-z]*)*", name)] == []


@pytest.mark.parametrize(
    ("operation_id", "status", "names"),
    [
        ("createJob", "202", {"Location", "Retry-After"}),
        ("createDataset", "201", {"Location"}),
        ("createToken", "201", {"Location"}),
        ("createWebhook", "201", {"Location"}),
        ("getJob", "200", {"ETag", "Retry-After"}),
        ("getJob", "304", {"ETag"}),
        ("changeDataset", "200", {"ETag"}),
        ("listJobs", "200", {"Link"}),
        ("listJobs", "401", {"WWW-Authenticate"}),
        ("listJobs", "429", {"Retry-After"}),
        ("getArtifactContent", "206", {"ETag", "Content-Range", "Repr-Digest"}),
        ("getArtifactContent", "416", {"Content-Range"}),
    ],
)
def test_headers_of_answers_are_declared(operation_id: str, status: str, names: set[str]) -> None:
    operations = [o for item in document()["paths"].values() for o in item.values()]
    [operation] = [o for o in operations if o["operationId"] == operation_id]
    assert names <= set(operation["responses"][status]["headers"])


async def test_lists_of_jobs_leave_the_options_to_each_job(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = await committed_dataset(service)
        made = (await http.post("/v1/jobs", json={"dataset_id": dataset})).json()
        [listed] = (await http.get("/v1/jobs")).json()["jobs"]
        full = (await http.get(f"/v1/jobs/{listed['id']}")).json()
        assert "options" not in listed and full["options"] == made["options"]
        assert set(full) - set(listed) == {"blocks", "options", "requested", "view_notes"}
        assert len(json.dumps(listed)) < len(json.dumps(full)) / 2
