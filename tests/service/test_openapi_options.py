"""The OpenAPI document says what the options of each kind of job are."""

from typing import Any

import jsonschema
import pytest

from octasplat.service.openapi import add_option_schemas
from octasplat.service.schemas.jobs import NewJob
from octasplat.workers.worker.job_kinds import job_kinds

ID = "5f1d7a52-0b9c-4a8e-9a3e-2f6c0d6f3b11"


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    """The schemas of a document, in which references can be followed."""
    schema = NewJob.model_json_schema(ref_template="#/components/schemas/{model}")
    schemas = {**schema.pop("$defs", {}), "NewJob": schema}
    add_option_schemas(schemas)
    return {"components": {"schemas": schemas}}


def fits(document: dict[str, Any], job: dict[str, Any]) -> bool:
    schema = {**document, "$ref": "#/components/schemas/NewJob"}
    return jsonschema.Draft202012Validator(schema).is_valid(job)


def test_job_kinds_have_own_schemas(document: dict[str, Any]) -> None:
    mapping = document["components"]["schemas"]["NewJob"]["discriminator"]["mapping"]
    assert set(mapping) == {kind.name for kind in job_kinds()}


def test_examples_of_the_document_fit(document: dict[str, Any]) -> None:
    examples = document["components"]["schemas"]["NewJob"]["examples"]
    assert examples and all(fits(document, example) for example in examples)


@pytest.mark.parametrize(
    ("job", "is_valid"),
    [
        ({"dataset_id": ID}, True),
        ({"dataset_id": ID, "options": {"preset": "fast", "train": {"iterations": 300}}}, True),
        ({"dataset_id": ID, "options": {"preset": "quick"}}, False),
        ({"dataset_id": ID, "options": {"train": {"window_ray": 3}}}, False),
        ({"kind": "crop", "source_id": ID, "options": {"where": "z < 0"}}, True),
        ({"kind": "crop", "source_id": ID, "options": {"preset": "fast"}}, False),
        ({"kind": "export", "source_id": ID}, False),
        ({"kind": "export", "source_id": ID, "options": {"files": ["mesh.glb"]}}, True),
        ({"kind": "sing", "source_id": ID}, False),
    ],
)
def test_options_are_those_of_the_kind(document: dict[str, Any], job: dict[str, Any], is_valid: bool) -> None:
    assert fits(document, job) is is_valid


def test_preset_defaults_are_omitted_from_schema(document: dict[str, Any]) -> None:
    schemas = document["components"]["schemas"]
    options = schemas["ReconstructOptions"]["properties"]
    assert "default" not in options["train"]["properties"]["rays_per_batch"]
    assert "default" not in schemas["LearningRates"]["properties"]["quat"]
    assert options["test_every"]["default"] == 8
    assert schemas["McmcConfig"]["properties"]["kind"]["default"] == "mcmc"


def test_openapi_options_have_no_object_defaults(document: dict[str, Any]) -> None:
    schemas = document["components"]["schemas"]
    assert any("properties" in schema for schema in schemas.values())
    for name, schema in schemas.items():
        for field, given in schema.get("properties", {}).items():
            assert not isinstance(given.get("default"), dict) or field == "options", name
