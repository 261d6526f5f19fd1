"""Base classes of all bodies."""

from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, model_validator
from pydantic_core import PydanticCustomError

EXAMPLE_ID = "01a1fcac-4f59-764b-97e6-1be68502c58f"
EXAMPLE_TIME = "2026-11-21T05:55:13.369313Z"
MAX_VALUES = 50_000
MAX_MEMBERS = 512
MAX_DEPTH = 24


class RequestBody(BaseModel):
    """A request body: unknown names are refused, and so is what has too many values to be validated soon.

    Attributes:
        max_values: most values within it, at any depth.
    """

    model_config = ConfigDict(extra="forbid")

    max_values: ClassVar[int] = MAX_VALUES

    @model_validator(mode="before")
    @classmethod
    def _is_bounded(cls, given: Any) -> Any:
        check_bounds(given, cls.max_values)
        return given


def check_bounds(value: Any, max_values: int = MAX_VALUES) -> None:
    """Refuse a value of JSON with too many members, values or levels, before each of them costs an error.

    Raises:
        PydanticCustomError: it is too large.
    """
    level, seen, depth = [value], 0, 0
    while level:
        below: list[Any] = []
        for each in level:
            if isinstance(each, dict):
                if len(each) > MAX_MEMBERS:
                    raise PydanticCustomError(
                        "too_many_members", "An object has more than {most} members.", {"most": MAX_MEMBERS}
                    )
                inner = list(each.values())
            elif isinstance(each, list):
                inner = each
            else:
                continue
            seen += len(inner)
            if seen > max_values:
                raise PydanticCustomError(
                    "too_many_values", "The request has more than {most} values.", {"most": max_values}
                )
            below += inner
        level, depth = below, depth + 1
        if level and depth > MAX_DEPTH:
            raise PydanticCustomError(
                "too_deep", "The request is nested deeper than {most} levels.", {"most": MAX_DEPTH}
            )
