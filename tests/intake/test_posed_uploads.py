"""Poses of all kinds at the door of the service, where only the names and sizes of photographs are known."""

import json
import math

import pytest

from octasplat.service.intake.dataset import check_dataset
from octasplat.service.intake.faults import IntakeError
from octasplat.workers.storage.local import LocalStorage
from tests.support.daily import some_daily
from tests.support.model_builder import ColmapModelBuilder, photographs, store_model


def _transforms(*names: str, **values: object) -> bytes:
    matrices = [[[1, 0, 0, k], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]] for k in range(len(names))]
    frames = [{"file_path": n, "transform_matrix": m} for n, m in zip(names, matrices, strict=True)]
    return json.dumps({"camera_angle_x": 2 * math.atan(16 / 30), **values, "frames": frames}).encode()


def _text_model(*names: str, mark: str = "") -> dict[str, bytes]:
    poses = "".join(
        f"{k} {math.cos(0.1 * k)} 0 {math.sin(0.1 * k)} 0 0 0 4 1 {n}\n" for k, n in enumerate(names, 1)
    )
    parts = {"cameras": "1 PINHOLE 32 24 30 31 16 12\n", "images": poses, "points3D": "1 0 0 0 9 9 9 0.5\n"}
    return {f"sparse/0/{part}.txt": (mark + text).encode() for part, text in parts.items()}


NAMES = ("v0.png", "v1.png", "v2.png", "v3.png")
SCENES = {
    "nerfstudio": {"transforms.json": _transforms(*(f"images/{name}" for name in NAMES))},
    "without suffixes": {"transforms.json": _transforms("./v0", "./v1", "./v2", "./v3")},
    "Blender": {
        "transforms_train.json": _transforms("./v0", "./v2", "./v3"),
        "transforms_test.json": _transforms("./v1"),
    },
    "at the top": {name.removeprefix("sparse/0/"): data for name, data in _text_model(*NAMES).items()},
    "no lines of observations": _text_model(*NAMES),
    "byte order mark": _text_model(*NAMES, mark="\ufeff"),
    "other case": _text_model(*(name.upper() for name in NAMES)),
    "backslashes": _text_model(*(f"C:\\my photos\\{name}" for name in NAMES)),
    "other suffix": _text_model(*(name.replace("png", "tif") for name in NAMES)),
    "labels": _text_model(*(name.removesuffix(".png") for name in NAMES)),
    "binary, other case": ColmapModelBuilder().with_image(name="V0.PNG").files(),
}


ALWAYS = {"nerfstudio", "Blender", "at the top", "backslashes"}
"""One of each sort; the other scenes are exhaustive."""


@pytest.mark.parametrize("kind", some_daily(SCENES, ALWAYS))
def test_poses_are_taken(local_storage: LocalStorage, kind: str) -> None:
    summary = check_dataset(local_storage, store_model(local_storage, {**photographs(NAMES), **SCENES[kind]}))
    assert (summary.views, summary.has_model, summary.camera_models) == (4, True, ("PINHOLE",))


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"transforms.json": b"{"}, "transforms.json is no JSON"),
        ({"transforms.json": _transforms(*NAMES, camera_angle_x=7)}, "camera_angle_x"),
        ({"transforms.json": _transforms(*NAMES, "v9.png", w=32, h=24)}, "v9.png"),
        (_text_model(*NAMES[:3], "v9.png"), "v9.png"),
    ],
)
def test_poses_that_fit_nothing_are_refused_by_name(
    local_storage: LocalStorage, files: dict[str, bytes], said: str
) -> None:
    with pytest.raises(IntakeError) as refusal:
        check_dataset(local_storage, store_model(local_storage, {**photographs(NAMES), **files}))
    assert said in refusal.value.faults[0].detail and "/tmp" not in refusal.value.faults[0].detail
