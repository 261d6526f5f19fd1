"""``octasplat plan``: blocks, time and memory from the sparse points, before anything starts."""

import errno
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from click.testing import CliRunner

from octasplat.__main__ import cli
from octasplat.engine.blocks import piece_settings
from octasplat.engine.blocks.block_map import SIDE_PX, draw_block_map
from octasplat.engine.blocks.block_plan import Block
from octasplat.engine.blocks.partition import Box
from octasplat.engine.blocks.piece_settings import (
    block_iterations,
    block_margin,
    block_settings,
    fewest_blocks,
    finish_iterations,
    finish_settings,
    fits_together,
    polish_settings,
)
from octasplat.engine.blocks.scene_plan import ScenePlan, save_plan
from octasplat.engine.blocks.sparse_plan import plan_from_points
from octasplat.engine.core.errors import ConfigError, DiskFullError
from octasplat.engine.core.events import ignore_events
from octasplat.engine.dataset import SparsePoints, load_dataset_model
from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.dataset.view_tiles import Rectangles
from octasplat.engine.operations.block_cost import BlockShare, estimate_blocks, estimate_with_blocks
from octasplat.engine.operations.block_options import BlockOptions, parse_memory
from octasplat.engine.operations.cost_model import estimate_reconstruction, gaussians_within
from octasplat.engine.operations.plan import PlanRequest, run
from octasplat.engine.pipeline import BlockRequest, output_folder, reconstruct
from octasplat.engine.pipeline.block_request import keep_request
from octasplat.engine.pipeline.block_steps import count_blocks
from octasplat.engine.pipeline.run import ReconstructionRun
from octasplat.engine.runs.config import resolve_config
from octasplat.engine.train.config import McmcConfig, TrainConfig
from tests.support.tiny_dataset import make_tiny_dataset


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, views=12, width_px=96, height_px=64)


def test_plan_of_two_blocks_covers_the_photographs(scene: Path, tmp_path: Path) -> None:
    picture = tmp_path / "map.png"
    found = run(PlanRequest(source=scene, blocks=2, cores=2, picture=picture))
    assert len(found.blocks) == 2 and found.photographs == 10 and found.cores == 2
    assert all(0 < block.pixels <= 10 * 96 * 64 and 0 < block.photographs <= 10 for block in found.blocks)
    assert sum(block.pixels for block in found.blocks) >= 10 * 96 * 64
    assert found.seconds > sum(block.seconds for block in found.blocks) > 0
    assert found.files == (picture,)
    colors = np.unique(oiio.ImageBuf(str(picture)).get_pixels(oiio.UINT8).reshape(-1, 3), axis=0)
    assert len(colors) == 4  # two blocks, cameras, nothing
    assert found.lines()[0].startswith("2 blocks of 10 photographs: about ")


def test_small_scene_stays_one_block_at_the_cost_of_an_ordinary_run(scene: Path) -> None:
    found = run(PlanRequest(source=scene, cores=1))
    config = resolve_config("standard").with_poses_decided(True)
    ordinary = estimate_reconstruction(config, [ImageSizes(96, 64, 12)], 1)
    assert len(found.blocks) == 1 and found.seconds == ordinary.seconds
    assert found.memory_bytes == ordinary.memory_bytes
    assert found.lines()[0].startswith("One block, an ordinary run, of 10 photographs")


def test_shares_of_blocks_add_up_to_the_whole_and_their_margins(scene: Path) -> None:
    model = load_dataset_model(scene)
    blocks = plan_from_points(model, np.arange(12), 4)
    assert 1 <= sum(block.share for block in blocks) < 2


def test_map_has_a_color_at_the_middle_of_each_block(scene: Path) -> None:
    model = load_dataset_model(scene)
    blocks = plan_from_points(model, np.arange(12), 4)
    drawn = draw_block_map(model, [block.core for block in blocks])
    assert drawn.image_srgb.shape == (SIDE_PX, SIDE_PX, 3) and drawn.middles.shape == (4, 2)
    colors = []
    for column, row in np.round(drawn.middles * SIDE_PX).astype(int):
        near = drawn.image_srgb[row - 60 : row + 61, column - 60 : column + 61].reshape(-1, 3)
        found, counts = np.unique(near[near.min(axis=1) < 0.9], axis=0, return_counts=True)
        colors.append(tuple(found[counts.argmax()]))
    assert len(set(colors)) == 4


def test_planned_run_has_the_blocks_of_its_plan(scene: Path, tmp_path: Path) -> None:
    """Also where a later version would make another number of blocks of the same photographs."""
    found = plan_from_points(load_dataset_model(scene), np.arange(12), 3)
    none = Rectangles(np.zeros(0, np.int64), *np.zeros((2, 0, 2), np.int64))
    blocks = tuple(Block(block.core, np.zeros(3), block.share, none) for block in found)
    (tmp_path / "blocks").mkdir()
    save_plan(ScenePlan(blocks, (0, 0, 0), 10, 10, None, True), tmp_path / "blocks")
    planned = ReconstructionRun(
        scene, tmp_path, resolve_config("standard"), 1, ignore_events, lambda: False, blocks=BlockRequest()
    )
    assert count_blocks(planned) == 3


EAST, NORTH, UP = np.eye(3)


@pytest.mark.parametrize(
    "world", [[EAST, NORTH, UP], [EAST, -UP, NORTH], [NORTH, UP, EAST], [UP, EAST, NORTH]]
)
@pytest.mark.parametrize(("other", "viewer"), [(NORTH, UP), (UP, -NORTH)])
def test_map_is_seen_from_above_or_as_by_the_cameras(
    scene: Path, world: Any, other: np.ndarray, viewer: np.ndarray
) -> None:
    """Ground, or a wall seen from the south, in worlds whose axes are these."""
    turn, model = np.array(world), load_dataset_model(scene)
    middles = np.stack([0 * EAST, 3 * EAST, 2 * other]) @ turn.T
    places = np.concatenate(
        [middle + np.random.default_rng(0).normal(0, 0.02, (20, 3)) for middle in middles]
    )
    points = SparsePoints(
        places.astype(np.float32), np.zeros((60, 3), np.float32), np.ones(60, np.int32),
        np.zeros(60, np.float32), np.arange(60),
    )  # fmt: skip
    rotation = np.stack([EAST, -UP, NORTH]) @ turn.T
    position = turn @ (5 * viewer + EAST)
    views = tuple(
        replace(view, rotation_cam_from_world=rotation, translation_cam_from_world=-rotation @ position)
        for view in model.views
    )
    drawn = draw_block_map(
        replace(model, points=points, views=views), [Box(middle - 1, middle + 1) for middle in middles]
    )
    east, above = drawn.middles[1:] - drawn.middles[0]
    assert east[0] * above[1] - east[1] * above[0] < -0.01  # counterclockwise, where y is down
    assert other is NORTH or (east[0] > 0.1 and above[1] < -0.1)


def test_number_of_blocks_grows_with_photographs_and_with_gaussians_that_do_not_fit() -> None:
    config = resolve_config("standard", assignments=["max_gaussians=1000000"]).train
    assert [fewest_blocks(config, views, 10**9, None) for views in (10, 500, 501, 2000)] == [1, 1, 2, 4]
    assert fewest_blocks(config, 100, 10**9, 1_000_000) == 1
    assert fewest_blocks(config, 100, 10**9, 300_000) == 4


@pytest.mark.parametrize("length", [5_000, 20_000])
def test_finish_takes_the_last_steps_of_the_blocks_first(length: int) -> None:
    config = TrainConfig()
    block = block_settings(config, 0.5, None, is_finished_later=True).lr.scaled_for(length)
    finish = finish_settings(config, length, (length, 0, length)).lr.scaled_for(length)
    assert finish.mean == pytest.approx(block.mean_final)
    for name in ("quat", "log_scale", "opacity", "color"):
        assert getattr(finish, name) == pytest.approx(block.decay * getattr(block, name)), name
    whole = block_settings(config, 0.5, None, is_finished_later=False).lr.scaled_for(length)
    polish = polish_settings(config, length, (length, 0, length)).lr.scaled_for(length)
    assert (polish.mean, polish.decay) == (whole.mean_final, 1)
    for name in ("quat", "log_scale", "opacity", "color"):
        assert getattr(polish, name) == pytest.approx(whole.decay * getattr(whole, name)), name


def test_blocks_finished_later_move_gaussians_as_far_apart_as_the_whole_schedule() -> None:
    """Of rounds over all of the schedule, blocks have those of their part."""
    rounds = {}
    for given in (1, 16, 40):
        config = TrainConfig(densify=McmcConfig(relocate_low_weight_rounds=given))
        for is_finished_later in (False, True):
            densify = block_settings(config, 0.5, None, is_finished_later=is_finished_later).densify
            assert isinstance(densify, McmcConfig)
            rounds[given, is_finished_later] = densify.relocate_low_weight_rounds
    assert [rounds[given, False] for given in (1, 16, 40)] == [1, 16, 40]
    assert [rounds[given, True] for given in (1, 16, 40)] == [1, 6, 14]
    rest = finish_settings(config, 100).densify  # the others, as far as the whole schedule moves any
    assert isinstance(rest, McmcConfig) and rest.relocate_low_weight_rounds == 40 - 14
    assert 0.35 + 0.65 * rest.stop_fraction == pytest.approx(config.densify.stop_fraction)


def test_blocks_finished_later_and_the_finish_take_as_long_as_blocks_and_a_third() -> None:
    config = TrainConfig(iterations=1000)
    alone = block_iterations(config, 10**6, is_finished_later=False)
    first = block_iterations(config, 10**6, is_finished_later=True)
    assert (alone, first) == (1000, 500)
    assert 2 * first + finish_iterations([first, first]) == pytest.approx(4 / 3 * 2 * alone, abs=1)


@pytest.mark.parametrize(
    ("settings", "pixels", "most", "expected"),
    [
        ({"max_gaussians": 1000}, 10**9, None, True),
        ({"max_gaussians": 1000}, 10**9, 999, False),
        ({}, 30 * 400_000, None, True),
        ({}, 31 * 400_000, None, False),  # more than the settings allow any scene
        ({}, 30 * 50_000, 49_999, False),
    ],
)
def test_blocks_are_finished_together_where_one_training_holds_what_pixels_ask_for(
    settings: dict[str, Any], pixels: int, most: int | None, expected: bool
) -> None:
    assert fits_together(TrainConfig(**settings), pixels, most) is expected


def test_blocks_share_less_with_narrower_margins_and_nothing_without(scene: Path) -> None:
    model = load_dataset_model(scene)
    shared = []
    for margin in (0.0, block_margin(is_finished_later=True), block_margin(is_finished_later=False)):
        blocks = plan_from_points(model, np.arange(12), 4, margin)
        shared.append(sum(block.share for block in blocks) - 1)
    assert shared[0] == pytest.approx(0) and shared[0] < shared[1] < shared[2]


def test_finish_averages_states_unless_the_settings_forbid_it() -> None:
    default, last_state = TrainConfig(), TrainConfig(weight_averaging_start=1)
    start = finish_settings(default, 100).weight_averaging_start
    assert 0.35 + 0.65 * start == pytest.approx(default.weight_averaging_start)
    fading = default.model_copy(update={"opacity_decay": 0.99})  # which is for the first half alone
    assert finish_settings(fading, 100).opacity_decay is polish_settings(fading, 100).opacity_decay is None
    for settings in (
        block_settings(last_state, 0.5, None, is_finished_later=True),
        polish_settings(last_state, 100),
        finish_settings(last_state, 100),
    ):
        assert settings.weight_averaging_start == 1.0


def test_gaussians_within_memory_are_those_of_its_estimate() -> None:
    sizes = [ImageSizes(800, 600, 100)]
    for memory_bytes in (1_000_000_000, 4_000_000_000):
        config = resolve_config("standard")
        most = gaussians_within(config, sizes, memory_bytes)
        train = config.train.model_copy(update={"max_gaussians": most})
        found = estimate_reconstruction(config.model_copy(update={"train": train}), sizes, 1)
        assert found.memory_bytes == pytest.approx(memory_bytes, rel=0.01)
    assert gaussians_within(resolve_config("standard"), sizes, 100_000_000) == 0


@pytest.mark.parametrize(
    ("text", "size"), [("8G", 8 * 10**9), ("1.5 gb", 1_500_000_000), ("500M", 500_000_000), ("77", 77)]
)
def test_sizes_of_memory(text: str, size: int) -> None:
    assert parse_memory(text) == size


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"memory": "8G"}, "--blocks auto"),
        ({"memory": "much", "blocks": "auto"}, "no size of memory"),
        ({"memory": "10M", "blocks": "auto"}, "holds no block"),
        ({"blocks": 2, "materials": True}, "materials"),
        ({"blocks": 5000}, "fewer blocks"),
    ],
)
def test_what_cannot_be_planned_is_refused_in_a_sentence(
    scene: Path, options: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ConfigError, match=sentence):
        run(PlanRequest(source=scene, **options))


def test_refused_plan_leaves_no_picture(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an automatic number it shows late whether there are several blocks."""
    monkeypatch.setattr(piece_settings, "AUTO_VIEWS", 5)
    picture = tmp_path / "map.png"
    with pytest.raises(ConfigError, match="materials"):
        run(PlanRequest(source=scene, blocks="auto", materials=True, picture=picture))
    assert not picture.exists()


def test_command_prints_the_plan(scene: Path) -> None:
    done = CliRunner().invoke(cli, ["plan", str(scene), "--blocks", "3", "--cores", "4"])
    assert done.exit_code == 0 and "3 blocks of 10 photographs" in done.stdout
    assert "block 3:" in done.stdout
    refused = CliRunner().invoke(cli, ["plan", str(scene), "--blocks", "none"])
    assert refused.exit_code != 0 and "--blocks: 'none' is neither auto nor a number" in refused.stderr


def test_estimate_before_there_is_a_plan_counts_all_blocks() -> None:
    config = resolve_config("fast").with_poses_decided(True)
    photographs = [ImageSizes(800, 600, 900)]
    whole = estimate_reconstruction(config, photographs, 2)
    assert estimate_with_blocks(config, BlockOptions(), photographs, 2) == whole
    assert estimate_with_blocks(config, BlockOptions(blocks=1), photographs, 2) == whole
    nothing = estimate_with_blocks(config, BlockOptions(blocks="auto"), [], 2)
    assert nothing == estimate_reconstruction(config, [], 2)
    assert estimate_with_blocks(config, BlockOptions(blocks=3), [], 2).seconds > nothing.seconds
    two = estimate_with_blocks(config, BlockOptions(blocks="auto"), photographs, 2)
    assert two == estimate_with_blocks(config, BlockOptions(blocks=2), photographs, 2)
    many = estimate_with_blocks(config, BlockOptions(blocks=10_000), photographs, 2)
    # A training of the preset is as long whatever its photographs show; these are decoded once more.
    trained = two.stage_seconds["train"] - whole.stage_seconds["load"]
    assert 2 < trained / whole.stage_seconds["train"] < 3.2
    assert many.stage_seconds["train"] > 1000 * two.stage_seconds["train"]
    assert two.seconds - two.stage_seconds["train"] == pytest.approx(
        whole.seconds - whole.stage_seconds["train"], abs=1
    )
    bounded = estimate_with_blocks(config, BlockOptions(blocks=2, memory="1.2G"), photographs, 2)
    assert bounded.memory_bytes <= 1_200_000_000


def test_block_that_fills_the_memory_is_estimated_to_take_it() -> None:
    config = resolve_config("standard", assignments=["max_gaussians=20000000"]).with_poses_decided(True)
    photographs = [ImageSizes(800, 600, 5000)]
    most = gaussians_within(config, photographs, 4_000_000_000)
    costs = estimate_blocks(config, photographs, [BlockShare(0.2, 900, 400_000_000)] * 6, most, 2)
    # each block reads the model of all photographs
    assert [cost.memory_bytes for cost in costs.blocks] == pytest.approx([4_000_000_000] * 6, rel=0.01)
    assert costs.total.memory_bytes == pytest.approx(4_000_000_000, rel=0.01)


def test_estimate_without_a_plan_is_near_that_of_the_plan(scene: Path) -> None:
    options = {"preset": "fast", "blocks": 3, "cores": 2}
    planned = run(PlanRequest.model_validate({"source": scene, **options}))
    config = resolve_config("fast").with_poses_decided(True)
    guessed = estimate_with_blocks(config, BlockOptions(blocks=3), [ImageSizes(96, 64, 12)], 2)
    assert 0.5 < guessed.seconds / planned.seconds < 2


def test_rays_of_a_block_take_longer_for_what_is_around_it() -> None:
    # Measured in blocks of 250 photographs of 320 x 240 pixels: 1.4 times as long as by themselves.
    config = resolve_config("fast").with_poses_decided(True)
    photographs = [ImageSizes(320, 240, 1000)]
    quarter = BlockShare(0.3, 450, 20_000_000)
    alone = estimate_blocks(config, photographs, [replace(quarter, share=1.0)] * 4, None, 1)
    among = estimate_blocks(config, photographs, [quarter] * 4, None, 1)
    growth = among.blocks[0].stage_seconds["train"] / alone.blocks[0].stage_seconds["train"]
    assert 1.2 < growth < 1.8


def test_command_is_repeated_where_the_disk_was_full_before_its_blocks_were_kept(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output, config, blocks = tmp_path / "run", resolve_config("fast"), BlockRequest(count=2)

    def find_no_room(*_arguments: object, **_named: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_text", find_no_room)
        patched.setattr(output_folder, "write_json", write_config_alone)
        with pytest.raises(DiskFullError):
            reconstruct(scene, output, config, blocks=blocks)
    assert (output / "config.json").exists()
    with pytest.raises(ConfigError, match="repeat --blocks"):  # else it would be trained in one
        reconstruct(scene, output, config, resume=True)
    assert keep_request(output, blocks, is_new=False) == blocks == keep_request(output, None, is_new=False)
    assert keep_request(output, BlockRequest(count=1), is_new=False) is None
    assert keep_request(output, None, is_new=False) is None
    keep_request(output, blocks, is_new=False)
    (output / "views.json").touch()
    with pytest.raises(ConfigError, match="begun with other blocks"):
        keep_request(output, BlockRequest(count=3), is_new=False)


def write_config_alone(path: Path, value: object) -> None:
    path.write_bytes(json.dumps(value).encode())
