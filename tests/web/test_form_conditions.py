"""Fields that are shown only for some choices name a field of their form and values that it can have."""

import re
import uuid
from types import SimpleNamespace
from typing import Any

import pytest

from octasplat.service.web.templating import render_template

JOB = SimpleNamespace(id=uuid.UUID(int=1), queue="cpu")
LIMITS = {"priority": 1, "max_file_bytes": 1}
VIEW = SimpleNamespace(name="a.jpg", render="renders/a.png", width=4, height=3)
MAP = SimpleNamespace(dataset_id=uuid.UUID(int=2), name="sky.hdr", title="")
FORMS: list[tuple[str, dict[str, Any]]] = [
    ("_light.html", {"light": SimpleNamespace(views=[VIEW], has_learnt_light=False, **LIMITS)}),
    ("_light.html", {"light": SimpleNamespace(views=[VIEW], has_learnt_light=True, **LIMITS)}),
    ("_relight.html", {"relight": SimpleNamespace(views=["a.jpg"], maps=[MAP], learnt=None, **LIMITS)}),
]


@pytest.mark.parametrize(("template", "values"), FORMS, ids=["light", "learnt-light", "relight"])
def test_fields_wait_for_choices_that_there_are(template: str, values: dict[str, Any]) -> None:
    page = render_template(template, job=JOB, base="/v1/jobs/1", **values)
    choices = {
        name: re.findall(r'<option value="([^"]*)"', options)
        for name, options in re.findall(r'<select [^>]*name="(\w+)"[^>]*>(.*?)</select>', page, re.DOTALL)
    }
    others = set(re.findall(r'<input [^>]*name="(\w+)"', page))
    conditions = re.findall(r'data-needs="(\w+)=([^"]*)"', page)
    assert conditions
    for name, values in conditions:
        if name in choices:
            assert set(values.split(" ")) <= set(choices[name]), (name, values)
        else:
            assert name in others and values in ("*", "true"), (name, values)
