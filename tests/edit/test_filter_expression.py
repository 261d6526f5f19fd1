"""Gaussians chosen by comparisons of their numbers."""

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.edit.filter_expression import filter_mask


@pytest.fixture
def scene(make_scene):
    g = make_scene(60)
    values = np.random.default_rng(1).random((60, 5)).astype(np.float32)
    return g.with_channels(
        {"albedo": values[:, :3], "metallic": values[:, 3:4], "label": np.repeat(values[:, 4:], 2, axis=1)}
    )


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("metallic > 0.5", lambda g: g.channels["metallic"][:, 0] > 0.5),
        (
            "0.2 <= albedo.g < .6",
            lambda g: (g.channels["albedo"][:, 1] >= 0.2) & (g.channels["albedo"][:, 1] < 0.6),
        ),
        (
            "x < -0.1 or not (z < 0 and opacity >= 0.8)",
            lambda g: (g.means_world[:, 0] < -0.1) | ~((g.means_world[:, 2] < 0) & (g.opacities >= 0.8)),
        ),
        ("label_1 != y", lambda g: g.channels["label"][:, 1] != g.means_world[:, 1]),
        ("1 < 2", lambda g: np.ones(60, bool)),
        (f"x < 1{400 * '0'} and x > -1e400 and z < 1e39", lambda g: np.ones(60, bool)),
    ],
)
def test_filter_expression_comparisons_select_expected(scene, text, wanted):
    assert (filter_mask(scene, text) == wanted(scene)).all()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("roughness > 0.5", "has no roughness; it has x, y, z, opacity, albedo.r"),
        ("albedo > 0.5", "has no albedo"),
        ("metallic >", "is no expression"),
        ("", "is no expression"),
        ("metallic", "metallic is no comparison"),
        ("metallic > 0.5 < __import__('os').name", "cannot be compared"),
        ("open('x') > 1", "cannot be compared"),
        ("metallic in (1, 2)", "is no comparison"),
        ("(lambda: 1)() or x > 1", "is no comparison"),
        ("metallic > 9**9**9", "cannot be compared"),
        ("x > True", "cannot be compared"),
        ("(" * 400 + "x > 1" + ")" * 400, "is no expression"),
        ("x > 1 or " * 200 + "x > 1", "1000 characters"),
    ],
)
def test_filter_expression_invalid_syntax_is_refused(scene, text, told):
    with pytest.raises(ConfigError, match=r"\.$") as caught:
        filter_mask(scene, text)
    assert told in str(caught.value)
