"""Transforms of a run's world: cameras and learnt light moved along with the scene."""

import json
import shutil
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Float64

from octasplat.engine.core.georeference import similarity_scale
from octasplat.engine.core.local_origin import Origin
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset.views_file import read_views, write_views
from octasplat.engine.render.environment_files import (
    read_background_map,
    read_environment,
    write_background_map,
    write_environment,
)
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.run_folder import (
    BACKGROUND,
    CONFIG,
    ENVIRONMENT_EXR,
    ENVIRONMENT_HDR,
    EVENTS,
    HELD_OUT,
    RESIDUAL_ITERATIONS,
    TRAINING,
    VIEWS,
    dataset_folder_of_run,
)
from octasplat.engine.shading.background import UP_WORLD
from octasplat.engine.shading.environment_frame import environment_frame


def write_transformed_run_files(
    source: Path, target: Path, matrix: Float[np.ndarray, "4 4"], origin_world: Origin
) -> tuple[str, ...]:
    """Write the files of a run that depend on its world, transformed by ``matrix``.

    Poses of COLMAP are left out, as ``views.json`` has them, and so is the way to the photographs, whose
    model is in the old world.

    Args:
        source: folder of the run.
        target: folder to write into.
        matrix: a similarity, see :func:`octasplat.engine.core.georeference.is_similarity`, between points
            about their local origins.
        origin_world: local origin of the result.

    Returns:
        What is not as exact as it was, a sentence each.
    """
    scale, turn = similarity_scale(matrix), _rotation_of(matrix)
    for name in (EVENTS, HELD_OUT):
        if (source / name).exists():
            shutil.copyfile(source / name, target / name)
    if (source / VIEWS).exists():
        moved = read_views(source / VIEWS).transformed(scale, turn, matrix[:3, 3])
        write_views(target / VIEWS, moved.model_copy(update={"origin_world": origin_world}))
    if (source / TRAINING).exists():
        training = json.loads((source / TRAINING).read_text(encoding="utf-8"))
        training.pop(RESIDUAL_ITERATIONS, None)
        if "nearest_world" in training:
            training["nearest_world"] = {
                name: scale * distance for name, distance in training["nearest_world"].items()
            }
        write_json(target / TRAINING, training)
    messages: list[str] = []
    if (source / CONFIG).exists():
        messages += _write_light(source, target, turn)
    return tuple(messages)


def _write_light(source: Path, target: Path, turn: Float64[np.ndarray, "3 3"]) -> list[str]:
    """Write the light's settings and maps; return notes on them."""
    config = read_config(source / CONFIG)
    up = np.array(config.train.materials.up_world, np.float64)
    new_up = turn @ up
    content = json.loads((source / CONFIG).read_text(encoding="utf-8"))
    content["scene"] = dataset_folder_of_run(source).name
    content["reconstruction"]["region"] = None  # a box in the old world, of use to the training alone
    if not _is_identity(turn):
        content["reconstruction"]["train"]["materials"]["up_world"] = new_up.tolist()
    write_json(target / CONFIG, content)
    messages = []
    # The background map has one frame, whatever is up in the scene.
    below = environment_frame(np.array(UP_WORLD))
    for name, old_frame, new_frame in (
        (ENVIRONMENT_EXR, environment_frame(up), environment_frame(new_up)),
        (ENVIRONMENT_HDR, environment_frame(up), environment_frame(new_up)),
        (BACKGROUND, below, below),
    ):
        if not (source / name).exists():
            continue
        if _is_identity(turn):
            shutil.copyfile(source / name, target / name)
            continue
        messages.append(f"{name} was turned with the scene, which makes it a little softer.")
        if name in (ENVIRONMENT_HDR, ENVIRONMENT_EXR):
            radiance = read_environment(source / name)
            write_environment(target / name, rotate_environment(radiance, old_frame, new_frame, turn))
        else:
            rgb_srgb = read_background_map(source / name)
            write_background_map(target / name, rotate_environment(rgb_srgb, old_frame, new_frame, turn))
    return messages


def rotate_environment(
    values: Float32[np.ndarray, "h w 3"],
    old_frame: Float64[np.ndarray, "3 3"],
    new_frame: Float64[np.ndarray, "3 3"],
    turn: Float64[np.ndarray, "3 3"],
) -> Float32[np.ndarray, "h w 3"]:
    """Return an equirectangular map after the environment was rotated; bilinear.

    Args:
        values: the map.
        old_frame: its right, up and forward in the old world, as rows.
        new_frame: those of the result in the new world.
        turn: rotation from the old world to the new one.
    """
    from octasplat.engine.shading.kernels.environment_map import map_colors

    height = len(values)
    # From texels to the new world, and by the inverse rotation to the old one
    directions = _texel_directions(height) @ new_frame @ turn
    turned = np.empty((2 * height * height, 3), np.float32)
    texels = np.ascontiguousarray(values).reshape(-1, 3)
    map_colors(0, len(turned), texels, height, old_frame, directions.astype(np.float32), turned)
    return turned.reshape(height, 2 * height, 3)


def _texel_directions(height: int) -> Float64[np.ndarray, "t 3"]:
    """Return unit directions of the texel centres in the map's right, up and forward axes."""
    down = np.pi * (np.arange(height) + 0.5) / height
    round_ = np.pi * ((np.arange(2 * height) + 0.5) / height - 1.0)
    down, round_ = (part.ravel() for part in np.meshgrid(down, round_, indexing="ij"))
    return np.stack([np.sin(down) * np.sin(round_), np.cos(down), np.sin(down) * np.cos(round_)], axis=1)


def _rotation_of(matrix: Float[np.ndarray, "4 4"]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation of a similarity, without rounding errors."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, np.float64)[:3, :3])
    turn: Float64[np.ndarray, "3 3"] = u @ vt
    near = np.round(turn)
    # Whole numbers are made exact: an identity is told by equality.
    return near if np.allclose(turn, near, rtol=0, atol=1e-12) else turn


def _is_identity(turn: Float64[np.ndarray, "3 3"]) -> bool:
    return bool(np.array_equal(turn, np.eye(3)))
