"""Short ids: the last characters of an id, as commands and the page show them."""

import uuid
from collections.abc import Callable, Iterator
from typing import Any

from octasplat.engine.core.errors import ConfigError
from octasplat.workers.client.api import Api

SHOWN_CHARACTERS = 8
_LEAST_CHARACTERS = 4
_PAGE_ROWS = 200


def short_id(full: object) -> str:
    """Return the end of an id; its beginning is the time, which neighbours share."""
    return str(full)[-SHOWN_CHARACTERS:]


def is_full_id(text: str) -> bool:
    """Return whether a text is a whole id."""
    try:
        return str(uuid.UUID(text)) == text.lower()
    except ValueError:
        return False


def find_job(api: Api, text: str) -> dict[str, Any]:
    """Return the job that is meant by its id, the last characters of it, or ``last``, the newest.

    Raises:
        ConfigError: there is none, or several have that end.
        ServiceError: the service has no job of that id.
    """
    return _find(api, text, "jobs", "job")


def find_dataset(api: Api, text: str) -> dict[str, Any]:
    """Return the dataset that is meant by its id, the last characters of it, or ``last``.

    Raises:
        ConfigError: there is none, or several have that end.
        ServiceError: the service has no dataset of that id.
    """
    return _find(api, text, "datasets", "dataset")


def _find(api: Api, text: str, collection: str, noun: str) -> dict[str, Any]:
    if is_full_id(text):
        row: dict[str, Any] = api.get(f"/v1/{collection}/{text}")
        return row
    if text == "last":
        newest = api.get(f"/v1/{collection}", limit=1)[collection]
        if not newest:
            raise ConfigError(f"There are no {collection}.")
        return _whole_row(api, collection, newest[0])
    if len(text) < _LEAST_CHARACTERS:
        raise ConfigError(
            f"{text}: write at least the last {_LEAST_CHARACTERS} characters of the {noun}'s id."
        )
    found = _ending_with(list_rows(api, collection), text.lower())
    if not found:
        raise ConfigError(f"There is no {noun} whose id ends in {text}; octasplat {collection} lists them.")
    if len(found) > 1:
        raise ConfigError(f"Several {collection} have ids that end in {text}; write more characters.")
    return _whole_row(api, collection, found[0])


def _whole_row(api: Api, collection: str, listed: dict[str, Any]) -> dict[str, Any]:
    """Return a listed row with what lists leave out, such as notes and the place in the queue."""
    row: dict[str, Any] = api.get(f"/v1/{collection}/{listed['id']}")
    return row


def _ending_with(rows: Iterator[dict[str, Any]], ending: str) -> list[dict[str, Any]]:
    return [row for row in rows if str(row["id"]).endswith(ending)]


def list_rows(
    api: Api, collection: str, *, limit: int | None = None, **query: Any
) -> Iterator[dict[str, Any]]:
    """Yield the rows of a collection, the newest first, by as many requests as it takes."""
    get: Callable[..., Any] = api.get
    cursor: dict[str, str] = {}
    left = limit
    while left is None or left > 0:
        rows = _PAGE_ROWS if left is None else min(left, _PAGE_ROWS)
        page = get(f"/v1/{collection}", limit=rows, **query, **cursor)
        yield from page[collection]
        if not page.get("next"):
            return
        cursor = {"cursor": page["next"]}
        left = None if left is None else left - rows
