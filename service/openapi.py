"""The OpenAPI document: that of the routes, with problems and the options of each kind of job."""

from typing import Any

from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from octasplat.service.problems import ProblemDocument
from octasplat.workers.work.kinds import JobKind, job_kinds

_REF = "#/components/schemas/"
_DEFAULT_KIND = "reconstruct"


def describe_fully(app: FastAPI) -> None:
    """Put the problem document and the options of jobs into the schemas of ``app``."""
    original = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = original()
            schemas = document["components"]["schemas"]
            schemas["ProblemDocument"] = ProblemDocument.model_json_schema()
            for name in ("HTTPValidationError", "ValidationError"):
                schemas.pop(name, None)
            type_options(schemas)
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def type_options(schemas: dict[str, Any]) -> None:
    """Make ``NewJob`` one schema for each kind of job, told apart by ``kind``, with the options of that kind.

    Args:
        schemas: of the document, by name; changed in place.

    Raises:
        ValueError: a model of the options has the name of another schema.
    """
    kinds = job_kinds()
    references, models = models_json_schema(
        [(kind.options, "validation") for kind in kinds], ref_template=_REF + "{model}"
    )
    for name, schema in models.get("$defs", {}).items():
        if schemas.setdefault(name, schema) != schema:
            raise ValueError(f"two schemas are called {name}; give the model of the options another name")
    plain = schemas["NewJob"]
    mapping: dict[str, str] = {}
    for kind in kinds:
        name = f"New{kind.name.title().replace('_', '').replace('-', '')}Job"
        schemas[name] = _new_job(plain, kind, references[kind.options, "validation"])
        mapping[kind.name] = _REF + name
    schemas["NewJob"] = {
        "title": plain["title"],
        "description": plain["description"],
        "oneOf": [{"$ref": reference} for reference in mapping.values()],
        "discriminator": {"propertyName": "kind", "mapping": mapping},
        "examples": plain["examples"],
    }


def _new_job(plain: dict[str, Any], kind: JobKind[Any], options: dict[str, Any]) -> dict[str, Any]:
    """The schema of a new job of one kind."""
    properties = dict(plain["properties"])
    properties["kind"] = {"type": "string", "const": kind.name, "title": "Kind", "default": kind.name}
    properties["options"] = {**options, "description": f"See GET /v1/options/{kind.name}."}
    required = [] if kind.name == _DEFAULT_KIND else ["kind"]
    if kind.options.model_json_schema().get("required"):
        required.append("options")
    schema = {key: value for key, value in plain.items() if key not in ("examples", "required")}
    return {
        **schema,
        "title": f"New job: {kind.name}",
        "description": f"{kind.title}.",
        "properties": properties,
        **({"required": required} if required else {}),
    }
