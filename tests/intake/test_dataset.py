"""Whole datasets: what is wrong is listed, whatever the model's files contain."""

import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from octasplat.engine.core.scene_layout import FileRole
from octasplat.service.intake.dataset import DatasetFile, DatasetLimits, DatasetSummary, check_dataset
from octasplat.service.intake.faults import IntakeError, IntakeFault
from octasplat.service.intake.model_check import ModelLimits, check_model
from octasplat.service.intake.parser_process import parser_environment
from octasplat.service.intake.upload_names import check_file_name
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.storage.trees import TreeFile
from tests.support.daily import some_daily
from tests.support.model_builder import (
    CameraRecord,
    ColmapModelBuilder,
    ImageRecord,
    PointRecord,
    photograph,
    photographs,
    rotated_pose,
    store_model,
)

NAN, INF = float("nan"), float("inf")


def faults_of(storage: LocalStorage, files: dict[str, bytes], **limits: int) -> Sequence[IntakeFault]:
    with pytest.raises(IntakeError) as caught:
        check_dataset(storage, store_model(storage, files), DatasetLimits(model=ModelLimits(**limits)))
    for fault in caught.value.faults:
        assert fault.detail.endswith(".") and "\n" not in fault.detail and "/tmp" not in fault.detail
    return caught.value.faults


def test_dataset_summary_counts_files_and_pixels(local_storage: LocalStorage) -> None:
    files = {**photographs(), **ColmapModelBuilder().files(), "masks/v1.png.png": photograph()}
    summary = check_dataset(local_storage, store_model(local_storage, files))
    assert summary == DatasetSummary(
        photographs=4, pixels=4 * 32 * 24, size_bytes=sum(map(len, files.values())), masks=1, has_model=True,
        views=4, cameras=1, camera_models=("PINHOLE",), points=5,
    )  # fmt: skip


def test_dataset_without_model_has_no_poses(local_storage: LocalStorage) -> None:
    summary = check_dataset(local_storage, store_model(local_storage, photographs()))
    assert not summary.has_model and summary.photographs == 4 and summary.views == 0


def test_dataset_uses_recorded_image_sizes(local_storage: LocalStorage) -> None:
    files = [
        replace(file, width_px=32, height_px=24, sha256="0" * 64, warning="odd")
        for file in store_model(local_storage, photographs())
    ]
    summary = check_dataset(local_storage, files)
    assert summary.pixels == 4 * 32 * 24 and summary.warnings == ("odd",) * 4


def test_dataset_with_reduced_photographs_is_accepted(local_storage: LocalStorage) -> None:
    model = ColmapModelBuilder().with_camera(width=64, height=48)
    summary = check_dataset(local_storage, store_model(local_storage, {**photographs(), **model.files()}))
    assert summary.views == 4


def test_oddities_are_warned_of(local_storage: LocalStorage) -> None:
    files = {
        **photographs(["v0.png", "v1.png", "v2.png", "v3.png", "more.png"]),
        **replace(
            ColmapModelBuilder(),
            cameras=(CameraRecord(), CameraRecord(2)),
            points=(PointRecord(1), PointRecord(2, (NAN, 0.0, 0.0))),
        ).files(),
        "masks/of_nobody.png": photograph(),
        "images/v0.png": photograph(),
    }
    warnings = check_dataset(local_storage, store_model(local_storage, files)).warnings
    for part in ("1 photographs have no pose", "1 points", "1 cameras", "1 masks belong to no photograph"):
        assert any(part in warning for warning in warnings), part
    assert not any("/tmp" in warning for warning in warnings)


def test_dataset_text_model_is_accepted(local_storage: LocalStorage) -> None:
    lines = "\n".join(f"{i + 1} 1 0 0 0 {i} 0 4 1 v{i}.png\n" for i in range(4))
    files = {
        "sparse/cameras.txt": b"1 PINHOLE 32 24 30 31 16 12\n",
        "sparse/images.txt": lines.encode() + b"\n",
        "sparse/points3D.txt": b"1 0 0 1 9 9 9 0.5\n",
    }
    assert check_dataset(local_storage, store_model(local_storage, {**photographs(), **files})).views == 4
    hostile = {**files, "sparse/images.txt": lines.replace("v0.png", "/etc/passwd").encode() + b"\n"}
    (fault,) = faults_of(local_storage, {**photographs(), **hostile})
    assert (fault.code, fault.file) == ("name-absolute", "sparse/images.txt")


SOUND = ColmapModelBuilder()
BAD_NAMES: dict[str, tuple[str | bytes, str]] = {
    "traversal": ("../../../../etc/passwd", "name-traversal"),
    "absolute": ("/etc/passwd", "name-absolute"),
    "windows": ("..\\..\\evil.png", "name-backslash"),
    "line break": ("v0.png\nv1.png", "name-control"),
    "name not in utf-8": (b"\xff\xfe.png", "name-not-text"),
    "no name": ("", "name-empty"),
    "not uploaded": ("v9.png", "model-image-missing"),
    "twice": ("v1.png", "model-image-twice"),
}
BAD_POSES: dict[str, dict[str, tuple[float, ...]]] = {
    "zero quaternion": {"quat_wxyz": (0, 0, 0, 0)},
    "long quaternion": {"quat_wxyz": (0, 2, 0, 0)},
    "no number in quaternion": {"quat_wxyz": (NAN, 0, 0, 0)},
    "infinite quaternion": {"quat_wxyz": (INF, 0, 0, 0)},
    "no number in translation": {"translation": (NAN, 0, 0)},
    "infinite translation": {"translation": (0, -INF, 0)},
    "absurd translation": {"translation": (0, 1e300, 0)},
}
BAD_CAMERAS: dict[str, CameraRecord] = {
    "no focal length": CameraRecord(params=(0, 31, 16, 12)),
    "negative focal length": CameraRecord(params=(-3, 31, 16, 12)),
    "nan focal length": CameraRecord(params=(NAN, 31, 16, 12)),
    "infinite centre": CameraRecord(params=(30, 31, INF, 12)),
    "without size": CameraRecord(width=0, height=0),
}
CAMERAS_OF_OTHER_SIZE: dict[str, CameraRecord] = {
    "turned": CameraRecord(width=24, height=32),
    "2^60": CameraRecord(width=2**60),
}
IMAGES, CAMERAS, POINTS = "sparse/0/images.bin", "sparse/0/cameras.bin", "sparse/0/points3D.bin"
HORRORS: dict[str, tuple[Callable[[], ColmapModelBuilder], str, str | None]] = {
    "name of 50 MB": (lambda: SOUND.with_image(name="a" * 50_000_000), "name-too-long", IMAGES),
    "unknown camera model": (lambda: SOUND.with_camera(model=77), "model-damaged", CAMERAS),
    "unknown camera": (lambda: SOUND.with_image(camera_id=9), "model-damaged", None),
    "camera twice": (lambda: replace(SOUND, cameras=(CameraRecord(), CameraRecord())), "model-damaged", None),
    "image id twice": (
        lambda: replace(SOUND, images=[ImageRecord(1, f"v{i}.png", rotated_pose(i)) for i in range(4)]),
        "model-damaged", None,
    ),
    "2^40 points": (lambda: replace(SOUND, counts={"points3D": 2**40}), "model-damaged", POINTS),
    "2^63 images": (lambda: replace(SOUND, counts={"images": 2**63}), "model-damaged", IMAGES),
    "2^64 cameras": (lambda: replace(SOUND, counts={"cameras": 2**64 - 1}), "model-damaged", CAMERAS),
    "one point too many": (lambda: replace(SOUND, counts={"points3D": 6}), "model-damaged", POINTS),
    "one point too few": (lambda: replace(SOUND, counts={"points3D": 4}), "model-damaged", POINTS),
    "empty file": (lambda: replace(SOUND, raw={"images.bin": b""}), "model-damaged", IMAGES),
    "text as binary": (
        lambda: replace(SOUND, raw={"images.bin": b"# text\n" * 9}), "model-damaged", IMAGES,
    ),
    "file missing": (lambda: replace(SOUND, raw={"points3D.bin": b"absent"}), "model-damaged", None),
    "no views": (lambda: replace(SOUND, images=()), "model-too-few-views", IMAGES),
    "two views": (lambda: replace(SOUND, images=SOUND.images[:2]), "model-too-few-views", IMAGES),
    "damaged rigs": (lambda: replace(SOUND, raw={"rigs.bin": b"\xff" * 40}), "model-damaged", None),
}  # fmt: skip


ALWAYS = {"unknown camera", "2^63 images", "one point too few", "two views"}
"""One of each sort; the other models are exhaustive."""


@pytest.mark.parametrize("case", some_daily(HORRORS, ALWAYS))
def test_dataset_inconsistent_model_is_refused(local_storage: LocalStorage, case: str) -> None:
    make, code, file = HORRORS[case]
    began = time.perf_counter()
    faults = faults_of(local_storage, {**photographs(), **make().files()})
    assert code in {fault.code for fault in faults}
    assert any(fault.code == code and (file is None or fault.file == file) for fault in faults)
    assert time.perf_counter() - began < 60


def test_bad_names_poses_and_cameras_are_all_listed(local_storage: LocalStorage) -> None:
    bad_cameras = [*BAD_CAMERAS.values(), *CAMERAS_OF_OTHER_SIZE.values()]
    cameras = [replace(camera, camera_id=2 + number) for number, camera in enumerate(bad_cameras)]
    named = [ImageRecord(10 + number, name) for number, (name, _) in enumerate(BAD_NAMES.values())]
    posed = [
        ImageRecord(30 + number, f"pose{number}.png", **changes)
        for number, changes in enumerate(BAD_POSES.values())
    ]
    taken = [
        ImageRecord(50 + number, f"camera{number}.png", camera_id=camera.camera_id)
        for number, camera in enumerate(cameras)
    ]
    model = replace(SOUND, images=[*SOUND.images, *named, *posed, *taken], cameras=[CameraRecord(), *cameras])
    sound = [str(image.name) for image in (*SOUND.images, *posed, *taken)]
    faults = faults_of(local_storage, {**photographs(sound), **model.files()})
    found = [(fault.code, fault.file) for fault in faults]
    in_cameras = len(BAD_CAMERAS), len(CAMERAS_OF_OTHER_SIZE)
    assert found == [
        *((code, IMAGES) for _, code in BAD_NAMES.values()),
        *[("model-pose", IMAGES)] * len(BAD_POSES),
        *[("model-camera", CAMERAS)] * in_cameras[0],
        *[("model-size", CAMERAS)] * in_cameras[1],
    ]
    details = [fault.detail for fault in faults[len(BAD_NAMES) :]]
    poses, cameras_, sizes = (
        details[: len(posed)],
        details[len(posed) : -in_cameras[1]],
        details[-in_cameras[1] :],
    )
    assert all(image.name in detail for image, detail in zip(posed, poses, strict=True))
    assert all(f"Camera {2 + number} " in detail for number, detail in enumerate(cameras_))
    assert all(image.name in detail for image, detail in zip(taken[-2:], sizes, strict=True))


def test_dataset_faults_have_json_pointers(local_storage: LocalStorage) -> None:
    images = [ImageRecord(i + 1, f"../{i}.png") for i in range(3)] + [
        ImageRecord(9, "v0.png", (0, 0, 0, 0), (NAN, 0, 0))
    ]
    faults = faults_of(
        local_storage, {**photographs(), **replace(ColmapModelBuilder(), images=images).files()}
    )
    codes = [fault.code for fault in faults]
    assert codes.count("name-traversal") == 3 and codes.count("model-pose") == 2
    assert faults[0].as_dict() == {
        "code": "name-traversal",
        "detail": faults[0].detail,
        "file": IMAGES,
        "pointer": "#/files/sparse~10~1images.bin",
    }


def test_dataset_fault_list_is_bounded(local_storage: LocalStorage) -> None:
    images = [ImageRecord(i + 1, f"../{i}.png") for i in range(5000)]
    assert (
        len(
            faults_of(
                local_storage, {**photographs(), **replace(ColmapModelBuilder(), images=images).files()}
            )
        )
        == 100
    )


def test_dataset_inconsistent_files_are_refused(local_storage: LocalStorage) -> None:
    small = {**photographs(), "masks/v0.png.png": photograph(9, 9), **ColmapModelBuilder().files()}
    (fault,) = faults_of(local_storage, small)
    assert (fault.code, fault.file) == ("mask-size", "masks/v0.png.png")
    (fault,) = faults_of(local_storage, photographs(["v0.png", "v1.png"]))
    assert fault.code == "dataset-photographs"
    broken = {**photographs(), "images/v1.png": b"no image at all", "images/v2.png": photograph()[:20]}
    assert [(f.code, f.file) for f in faults_of(local_storage, broken)] == [
        ("image-kind", "images/v1.png"),
        ("image-damaged", "images/v2.png"),
    ]
    twins = {**photographs(), "images/V0.PNG": photograph(), "README.md": b"hello", "images/../x.png": b""}
    assert [f.code for f in faults_of(local_storage, twins)] == [
        "name-twin", "name-unexpected", "name-traversal",
    ]  # fmt: skip


def test_names_of_single_files() -> None:
    assert check_file_name("images/a b/ü.jpg") is FileRole.IMAGE
    assert check_file_name("masks/a.jpg.png") is FileRole.MASK
    assert check_file_name("depths/a.exr") is FileRole.DEPTH
    assert check_file_name("sparse/0/points3D.bin") is FileRole.MODEL
    assert check_file_name("sparse/1/cameras.bin") is FileRole.MODEL
    for name, code in (
        ("images/a.jpg/../../x", "name-traversal"),
        ("images/a.exe", "name-unexpected"),
        ("images", "name-unexpected"),
        ("sparse/x/cameras.bin", "name-unexpected"),
        ("checkpoint.pkl", "name-unexpected"),
        ("../evil.png", "name-traversal"),
        ("images/evil.sh", "name-unexpected"),
        ("images/.hidden.jpg", "name-unexpected"),
    ):
        with pytest.raises(IntakeError) as caught:
            check_file_name(name)
        assert caught.value.code == code


def test_model_child_respects_resource_limits(local_storage: LocalStorage) -> None:
    files = {**photographs(), **ColmapModelBuilder().files()}
    assert faults_of(local_storage, files, max_model_bytes=100)[0].code == "model-too-large"
    (fault,) = faults_of(local_storage, files, memory_bytes=100 << 20)
    assert fault.code in ("model-memory", "model-crash")


@pytest.mark.exhaustive
def test_model_child_timeout_is_reported(local_storage: LocalStorage) -> None:
    line = b"1 1 0 0 0 0 0 4 1 v0.png\n\n"
    slow = {
        "sparse/cameras.txt": b"1 PINHOLE 32 24 30 31 16 12\n",
        "sparse/images.txt": line + b"# nothing\n" * 8_000_000,
        "sparse/points3D.txt": b"1 0 0 1 9 9 9 0.5\n" + b"# nothing\n" * 8_000_000,
    }
    began = time.perf_counter()
    faults = faults_of(local_storage, {**photographs(), **slow}, seconds=1)
    assert time.perf_counter() - began < 40
    assert faults[0].code in ("model-timeout", "model-too-few-views", "model-damaged")


def test_model_child_environment_has_no_secrets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DATABASE_URL", "postgresql://user:password@host/db")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("OCTASPLAT_TOKEN", "secret")
    assert not {"password", "secret"} & set(" ".join(parser_environment().values()).split())
    assert set(parser_environment()) <= {
        "PATH", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "NUMBA_CACHE_DIR", "SYSTEMROOT",
        "OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "PYTHONDONTWRITEBYTECODE",
    }  # fmt: skip


def test_intake_loads_no_heavy_modules() -> None:
    code = (
        "import sys, pkgutil, importlib, octasplat.service.intake as p\n"
        "for m in pkgutil.iter_modules(p.__path__):\n"
        "    importlib.import_module(p.__name__ + '.' + m.name)\n"
        "import octasplat.workers.storage\n"
        "heavy = {'pycolmap', 'torch', 'numba', 'OpenImageIO', 'boto3', 'scipy'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


VALID = ColmapModelBuilder().files()


@st.composite
def damaged_models(draw: st.DrawFn) -> dict[str, bytes]:
    """A good model with changed bytes, numbers, lengths or ends."""
    files = dict(VALID)
    for _ in range(draw(st.integers(1, 3))):
        name = draw(st.sampled_from(sorted(files)))
        data = bytearray(files[name])
        kind = draw(st.sampled_from(["byte", "number", "count", "cut", "more"]))
        where = draw(st.integers(0, max(0, len(data) - 9)))
        if kind == "byte" and data:
            data[where] = draw(st.integers(0, 255))
        elif kind == "number" and len(data) > 8:
            special = [
                b"\0" * 8,
                b"\xff" * 8,
                bytes(6) + b"\xf0\x7f",
                bytes(6) + b"\xf8\x7f",
                b"\xff" * 7 + b"\x7f",
            ]
            data[where : where + 8] = draw(st.sampled_from(special))
        elif kind == "count" and len(data) > 8:
            data[:8] = draw(st.integers(0, 2**64 - 1)).to_bytes(8, "little")
        elif kind == "cut":
            del data[where:]
        else:
            data += draw(st.binary(min_size=1, max_size=30))
        files[name] = bytes(data)
    return files


@pytest.mark.exhaustive
@pytest.mark.heavy
@settings(
    deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], database=None, max_examples=15
)
@given(files=damaged_models())
def test_dataset_damaged_model_is_refused(local_storage: LocalStorage, files: dict[str, bytes]) -> None:
    found = store_model(local_storage, files)
    model = [TreeFile(path=f.path, sha256=f.sha256, size_bytes=f.size_bytes) for f in found]
    sizes = {f"v{i}.png": (32, 24) for i in range(4)}
    answer = check_model(local_storage, model, sizes, ModelLimits(seconds=20))
    if answer.faults:
        assert all(fault.code and fault.detail.endswith(".") for fault in answer.faults)
    else:
        assert answer.views >= 3


@pytest.mark.exhaustive
@pytest.mark.real
def test_dataset_of_real_scene_is_accepted(scenes_root: Path, local_storage: LocalStorage) -> None:
    checked = 0
    for scene in sorted(path for path in scenes_root.iterdir() if (path / "images").is_dir()):
        files: list[DatasetFile] = []
        for path in sorted(scene.rglob("*")):
            name = path.relative_to(scene).as_posix()
            try:
                check_file_name(name)
            except IntakeError:
                continue
            files += store_model(local_storage, {name: path.read_bytes()})
        if not any(file.path.startswith(("sparse/", "colmap/")) for file in files):
            continue
        summary = check_dataset(local_storage, files)
        assert summary.views >= 3 and summary.points > 0, scene
        checked += 1
    assert checked > 0
