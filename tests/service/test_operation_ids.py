"""Clients that are generated from the OpenAPI document name their methods by its operation ids."""

import re

from octasplat.service.app import create_app


def test_operation_ids_are_unique_and_in_camel_case() -> None:
    paths = create_app().openapi()["paths"]
    found = [operation["operationId"] for path in paths.values() for operation in path.values()]
    assert len(found) == len(set(found))
    assert {"createJob", "cancelJob", "createDataset", "commitDataset", "createToken"} <= set(found)
    assert [name for name in found if not re.fullmatch(r"[a-z]+([A-Z][a-z]*)*", name)] == []
