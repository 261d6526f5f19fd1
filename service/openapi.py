"""OpenAPI document: that of the routes, with problems and the options of each kind of job."""

import threading
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute
from pydantic.json_schema import models_json_schema

from octasplat.service.problems import ProblemDocument
from octasplat.service.request_id import HEADER
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.workers.worker.job_kinds import JobKind, job_kinds

_REF = "#/components/schemas/"
_DEFAULT_KIND = "reconstruct"


def operation_id(route: APIRoute) -> str:
    """Return the operation id of a route: its function's name in camel case, as ``createJob``."""
    first, *others = route.name.split("_")
    return first + "".join(word.title() for word in others)


def extend_openapi(app: FastAPI) -> None:
    """Add the problem document and the options of jobs to the schemas of ``app``, and an address for all."""
    original, lock = app.openapi, threading.Lock()

    def openapi() -> dict[str, Any]:
        with lock:  # the document is not complete once it is there
            if app.openapi_schema is None:
                document = original()
                schemas = document["components"]["schemas"]
                schemas["ProblemDocument"] = ProblemDocument.model_json_schema()
                # Those that FastAPI answers with by itself, which no route of this service does.
                for name in ("HTTPValidationError", "ValidationError"):
                    schemas.pop(name, None)
                add_option_schemas(schemas)
                _add_request_ids(document)
                app.openapi_schema = document
            return app.openapi_schema

    async def read_document(_request: Request) -> JSONResponse:
        return JSONResponse(await openapi_document(app))

    app.openapi = openapi  # type: ignore[method-assign]
    app.add_route("/openapi.json", read_document, include_in_schema=False)


async def openapi_document(app: FastAPI) -> dict[str, Any]:
    """Return the document, which takes most of a second when it is asked for first, made in a thread."""
    return await run_in_pool(ThreadPurpose.OPTIONS, app.openapi)


def _add_request_ids(document: dict[str, Any]) -> None:
    """Declare the header that every answer has."""
    header = {
        "description": "Id of the request, that of its client where it sends one; see the service's log.",
        "schema": {"type": "string"},
    }
    for item in document["paths"].values():
        for operation in item.values():
            for answer in operation["responses"].values():
                answer.setdefault("headers", {})[HEADER] = header


def add_option_schemas(schemas: dict[str, Any]) -> None:
    """Make ``NewJob`` a union of one schema for each kind of job, discriminated by ``kind``.

    Args:
        schemas: of the document, by name; changed in place.

    Raises:
        ValueError: a model of the options has the name of another schema.
    """
    kinds = job_kinds()
    references, models = models_json_schema(
        [(kind.user_options, "validation") for kind in kinds], ref_template=_REF + "{model}"
    )
    definitions: dict[str, Any] = models.get("$defs", {})
    by_preset = _schemas_with_presets(definitions)
    for name, found in definitions.items():
        schema = _without_client_defaults(found, keeps_defaults=name not in by_preset)
        if schemas.setdefault(name, schema) != schema:
            raise ValueError(f"two schemas are called {name}; give the model of the options another name")
    plain = schemas["NewJob"]
    mapping: dict[str, str] = {}
    for kind in kinds:
        name = f"New{kind.name.title().replace('_', '').replace('-', '')}Job"
        schemas[name] = _new_job_schema(name, plain, kind, references[kind.user_options, "validation"])
        mapping[kind.name] = _REF + name
    schemas["NewJob"] = {
        "title": plain["title"],
        "description": plain["description"],
        "oneOf": [{"$ref": reference} for reference in mapping.values()],
        "discriminator": {"propertyName": "kind", "mapping": mapping},
        "examples": plain["examples"],
    }


def _new_job_schema(
    name: str, plain: dict[str, Any], kind: JobKind[Any], options: dict[str, Any]
) -> dict[str, Any]:
    """Return the schema of a new job of one kind."""
    properties = dict(plain["properties"])
    properties["kind"] = {"type": "string", "const": kind.name, "title": "Kind", "default": kind.name}
    properties["options"] = {**options, "description": f"See GET /v1/options/{kind.name}."}
    # The kind that is meant where none is named need not be.
    required = [] if kind.name == _DEFAULT_KIND else ["kind"]
    if kind.user_options.model_json_schema().get("required"):
        required.append("options")
    schema = {key: value for key, value in plain.items() if key not in ("examples", "required")}
    return {
        **schema,
        "title": name,
        "description": f"{kind.title}.",
        "properties": properties,
        **({"required": required} if required else {}),
    }


def _schemas_with_presets(definitions: dict[str, Any]) -> set[str]:
    """Return the names of the schemas below options that have a preset: their defaults are the preset's."""
    found: set[str] = set()
    waiting = [
        reference
        for schema in definitions.values()
        if "preset" in schema.get("properties", {})
        for reference in _schema_references(schema)
    ]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += _schema_references(definitions[name])
    return found


def _schema_references(schema: object) -> list[str]:
    if isinstance(schema, dict):
        own = [schema["$ref"].removeprefix(_REF)] if isinstance(schema.get("$ref"), str) else []
        return own + [name for value in schema.values() for name in _schema_references(value)]
    return [name for item in schema for name in _schema_references(item)] if isinstance(schema, list) else []


def _without_client_defaults(schema: dict[str, Any], *, keeps_defaults: bool) -> dict[str, Any]:
    """Return the schema without defaults that generated clients would take for what the user wants.

    They send the defaults that they know. Those that a preset decides must stay away, and generators refuse
    defaults that are objects, whose fields have their own.
    """
    has_preset = "preset" in schema.get("properties", {})
    properties = {}
    for name, given in schema.get("properties", {}).items():
        properties[name] = {
            key: value
            for key, value in given.items()
            if key != "default" or "const" in given or (keeps_defaults and not isinstance(value, dict))
        }
        if "properties" in given:
            inner = _without_client_defaults(
                properties[name], keeps_defaults=keeps_defaults and not has_preset
            )
            properties[name] = inner
    return {**schema, "properties": properties} if properties else schema
