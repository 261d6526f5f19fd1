"""Which results the page of a job shows with materials."""

import pytest

from octasplat.service.web import pages


@pytest.mark.parametrize(
    ("materials", "shown"),
    [
        ({"learn": True, "recipe": "split_sum"}, True),
        ({"learn": True}, True),  # of a version with one recipe
        ({"learn": False, "recipe": "split_sum"}, False),
        ({"learn": True, "recipe": "near_field"}, False),
        ({"learn": True, "recipe": "ref_gaussian"}, False),
        ({"learn": True, "recipe": "seed"}, False),  # a former name of the latter
        (None, False),
    ],
)
def test_page_shows_materials_that_light_from_far_away_can_show(
    materials: dict[str, object] | None, shown: bool
) -> None:
    config: dict[str, object] = {"reconstruction": {"train": {"materials": materials}}}
    assert pages._shows_materials(config) == shown
