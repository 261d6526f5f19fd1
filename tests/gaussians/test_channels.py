from collections.abc import Callable

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.gaussians.channels import (
    Channels,
    column_names,
    group_columns,
    merge_widths,
    stack_channels,
)
from octasplat.engine.gaussians.model import FlatGaussians, concatenate

Make = Callable[..., FlatGaussians]


def some(count: int = 4, **widths: int) -> Channels:
    return Channels(
        {name: np.random.default_rng(len(name)).random((count, w), np.float32) for name, w in widths.items()}
    )


def test_columns_of_a_channel_and_back() -> None:
    widths = {"metallic": 1, "albedo": 3, "f_semantic": 12}
    columns = [column for name, width in widths.items() for column in column_names(name, width)]
    assert columns[:4] == ["metallic", "albedo_0", "albedo_1", "albedo_2"]
    assert group_columns(reversed(columns)) == {
        name: column_names(name, width) for name, width in widths.items()
    }


def test_numbers_with_a_gap_or_alone_are_names() -> None:
    found = group_columns(["a_0", "b_1", "b_2", "c_00", "c_1", "d_0", "d_1"])
    assert list(found) == ["a_0", "b_1", "b_2", "c_00", "c_1", "d"]
    assert found["d"] == ("d_0", "d_1") and found["a_0"] == ("a_0",)


@pytest.mark.parametrize(
    "widths",
    [
        {"3d": 1}, {"a-b": 1}, {"": 1}, {"opacity": 1}, {"scale": 3}, {"scale_9": 1}, {"GID": 1}, {"red": 1},
        {"f_rest": 45}, {"a_0": 1, "a_1": 1}, {"a": 2, "a_2": 1}, {"a": 2, "a_0": 1}, {"b": 1, "B": 1},
        {"filter_3D": 1}, {"f_rest_weight": 1}, {"f_offset": 3}, {"f_anchor_feat": 32},
    ],
)  # fmt: skip
def test_ambiguous_channel_names_are_refused(widths: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=r"cannot name a channel|cannot be told apart"):
        some(**widths)


@pytest.mark.parametrize(
    "array", [np.zeros(4, np.float32), np.zeros((4, 0), np.float32), np.zeros((4, 1), np.float64)]
)
def test_arrays_of_other_shapes_and_types_are_refused(array: np.ndarray) -> None:
    with pytest.raises(ValueError, match="'label' should be float32"):
        Channels({"label": array})


def test_rows_must_be_as_many_as_gaussians(make_gaussians: Make) -> None:
    with pytest.raises(ValueError, match="'label' has 3 rows for 5 Gaussians"):
        make_gaussians(5).with_channels(some(3, label=1))


def test_stacked_channels_are_side_by_side_in_order() -> None:
    channels = some(albedo=3, metallic=1, label=2)
    features = stack_channels(channels)
    assert features.shape == (4, 6)
    np.testing.assert_array_equal(
        features, np.hstack([channels["albedo"], channels["metallic"], channels["label"]])
    )
    np.testing.assert_array_equal(
        stack_channels(channels, ["metallic", "albedo"]),
        np.hstack([channels["metallic"], channels["albedo"]]),
    )


def test_channels_are_set_replaced_and_taken_away(make_gaussians: Make) -> None:
    scene = make_gaussians(4).with_channels(some(albedo=3)).with_channels(some(metallic=1, albedo=2))
    assert scene.channels.widths == {"albedo": 2, "metallic": 1}
    assert scene.without_channels(["albedo"]).channels.widths == {"metallic": 1}
    assert scene.with_base_color_only().channels.widths == {}


def test_is_finite_includes_channels(make_gaussians: Make) -> None:
    scene = make_gaussians(4).with_channels(some(label=1))
    assert scene.is_finite()
    scene.channels["label"][2] = np.nan
    assert not scene.is_finite()


def test_parts_with_other_channels_do_not_join_unasked(make_gaussians: Make) -> None:
    with pytest.raises(ValueError, match=r"channels\.label"):
        concatenate([make_gaussians(4).with_channels(some(label=1)), make_gaussians(4)])


def test_widths_of_several_scenes() -> None:
    assert merge_widths([some(a=1), some(), some(b=2, a=1)]) == {"a": 1, "b": 2}
    with pytest.raises(ConfigError, match="'a' has 1 numbers in one scene and 3 in another"):
        merge_widths([some(a=1), some(a=3)])
