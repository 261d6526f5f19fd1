"""Page that documents the API, from its OpenAPI document."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from fastapi import APIRouter, Request, Response

from octasplat.service.openapi import openapi_document
from octasplat.service.web.routing import PageRoute
from octasplat.service.web.templating import render_page

router = APIRouter(route_class=PageRoute, include_in_schema=False)

_METHODS = ("get", "post", "put", "patch", "delete")


@dataclass(frozen=True)
class Parameter:
    """A parameter: where it goes, its name, what it is and whether it must be given."""

    place: str
    name: str
    kind: str
    text: str
    required: bool


@dataclass(frozen=True)
class ApiOperation:
    """An operation of the API.

    Attributes:
        method: of HTTP.
        path: with its parameters in braces.
        text: what it does.
        parameters: of path, query and header.
        body: media types of what is sent.
        answers: what each status means.
    """

    method: str
    path: str
    text: str
    parameters: list[Parameter]
    body: list[str]
    answers: list[tuple[str, str]]


@dataclass
class OperationGroup:
    """Operations that belong together."""

    name: str
    operations: list[ApiOperation] = field(default_factory=list)


@router.get("/docs")
async def show_api(request: Request) -> Response:
    """Return the page that documents the API."""
    document = await openapi_document(request.app)
    return render_page(request, "api.html", groups=operation_groups(document), info=document["info"])


def operation_groups(document: Mapping[str, Any]) -> list[OperationGroup]:
    """Return all operations of an OpenAPI document, by their first tag."""
    groups: dict[str, OperationGroup] = {}
    for path, item in document["paths"].items():
        for method in _METHODS:
            if method in item:
                operation = item[method]
                name = operation.get("tags", ["other"])[0]
                groups.setdefault(name, OperationGroup(name)).operations.append(
                    _api_operation(method, path, operation)
                )
    return list(groups.values())


def _api_operation(method: str, path: str, operation: Mapping[str, Any]) -> ApiOperation:
    return ApiOperation(
        method=method.upper(),
        path=path,
        text=operation.get("description") or operation.get("summary", ""),
        parameters=[
            Parameter(
                parameter["in"],
                parameter["name"],
                _type_text(parameter.get("schema", {})) + _range_text(parameter.get("schema", {})),
                parameter.get("description", ""),
                parameter.get("required", False),
            )
            for parameter in operation.get("parameters", ())
            # Browsers send it by themselves.
            if parameter["in"] != "cookie"
        ],
        body=list(operation.get("requestBody", {}).get("content", {})),
        answers=[
            (status, answer.get("description", "")) for status, answer in operation["responses"].items()
        ],
    )


def _type_text(schema: Mapping[str, Any]) -> str:
    """Return the type of a parameter in a word or two."""
    if "anyOf" in schema:
        return " or ".join(_type_text(option) for option in schema["anyOf"] if option.get("type") != "null")
    if "enum" in schema:
        return " | ".join(map(str, schema["enum"]))
    if schema.get("type") == "array":
        return f"list of {_type_text(schema.get('items', {}))}"
    return str(schema.get("format") or schema.get("type", "any"))


def _range_text(schema: Mapping[str, Any]) -> str:
    """Return the range of a number and the default of a parameter, behind its type; empty without either."""
    least, most, default = schema.get("minimum"), schema.get("maximum"), schema.get("default")
    text = ""
    if least is not None:
        text = f", {least} to {most}" if most is not None else f", at least {least}"
    return text + ("" if default is None or default in ("", False) else f"; by default {default}")
