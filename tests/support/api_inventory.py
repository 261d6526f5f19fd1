"""Every route of the service with a request that fits it, from the OpenAPI document and the route tables."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from fastapi import FastAPI
from starlette.routing import Route


@dataclass(frozen=True)
class Operation:
    """A method of an address, as the OpenAPI document describes it."""

    method: str
    path: str
    described: dict[str, Any]
    document: dict[str, Any]

    @property
    def name(self) -> str:
        return f"{self.method} {self.path}"

    @property
    def changes(self) -> bool:
        """Whether it is more than reading."""
        return self.method not in ("GET", "HEAD")

    def body(self) -> dict[str, Any]:
        """Arguments of a request: the example of its schema, or the least that the schema asks for."""
        content = self.described.get("requestBody", {}).get("content", {})
        if "application/json" in content:
            return {"json": self._example(content["application/json"].get("schema", {}))}
        return {"content": b"x"} if content else {}

    def needed_headers(self) -> dict[str, str]:
        """Headers without which the request is refused, and the type of a body that is not JSON."""
        headers = {
            parameter["name"]: str(self._example(parameter["schema"]))
            for parameter in self.described.get("parameters", ())
            if parameter["in"] == "header" and parameter.get("required")
        }
        content = self.described.get("requestBody", {}).get("content", {})
        return headers if not content or "application/json" in content else {
            **headers, "Content-Type": next(iter(content)),
        }  # fmt: skip

    def _example(self, schema: dict[str, Any]) -> Any:
        while "$ref" in schema:
            schema = self.document["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
        if schema.get("examples"):
            return schema["examples"][0]
        if "default" in schema:
            return schema["default"]
        if "enum" in schema or "const" in schema:
            return schema.get("const", schema.get("enum", [None])[0])
        for choice in schema.get("anyOf", []):
            return self._example(choice)
        kind = schema.get("type", "object")
        if kind == "object":
            fields = schema.get("properties", {})
            return {name: self._example(fields[name]) for name in schema.get("required", [])}
        if kind == "array":
            return [self._example(schema["items"])] * schema.get("minItems", 0)
        plain = {"string": "x", "integer": 1, "number": 1.0, "boolean": True, "null": None}
        return plain[kind]


def operations(app: FastAPI) -> list[Operation]:
    """All that the OpenAPI document describes."""
    document = app.openapi()
    methods = {"get", "put", "post", "patch", "delete", "head"}
    return [
        Operation(method.upper(), path, described, document)
        for path, item in document["paths"].items()
        for method, described in item.items()
        if method in methods
    ]


def undescribed(app: FastAPI) -> list[tuple[str, str]]:
    """Method and path of the routes that the document leaves out: pages, HEAD, the document itself."""
    known = {(operation.method, operation.path) for operation in operations(app)}
    found = {
        (method, route.path.replace(":path}", "}"))
        for route in _flat(app.routes)
        for method in route.methods or ()
    }
    return sorted(found - known)


def _flat(routes: Any) -> Iterator[Route]:
    for route in routes:
        inner = getattr(route, "original_router", None)
        if inner is not None:
            yield from _flat(inner.routes)
        elif isinstance(route, Route) or hasattr(route, "methods"):
            yield route
