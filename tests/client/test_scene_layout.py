"""What of a folder or an archive is a scene: the same at every door."""

import functools
import io
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from PIL import Image

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.events import Event, Warned
from octasplat.engine.core.scene_layout import (
    MIN_PHOTOGRAPHS,
    lay_out_scene,
    left_out_sentences,
    masks_beside,
)
from octasplat.engine.dataset.model_sources import find_model
from octasplat.engine.dataset.photograph_files import image_folder
from octasplat.engine.operations.estimate import EstimateRequest
from octasplat.engine.operations.estimate import run as estimate
from octasplat.engine.poses.photographs import locate_scene, notes_on_files, photographs_of_scene
from octasplat.service.intake.archive import list_archive
from octasplat.service.intake.faults import IntakeError
from octasplat.service.intake.receive import UploadLimits
from octasplat.service.intake.scene_preview import (
    ArchiveEndTooShortError,
    ListedFile,
    ScenePreview,
    preview_archive,
    preview_files,
)
from octasplat.workers.client.api import Api
from octasplat.workers.client.upload import list_scene_files
from tests.support.zip_builder import ZipMember, build_zip

PHOTOGRAPHS = ("a.jpg", "b.JPG", "c.webp")
FOLDERS = {
    "photographs alone": (PHOTOGRAPHS, PHOTOGRAPHS),
    "card": (
        ("DCIM/100MEDIA/a.JPG", "DCIM/100MEDIA/a.MOV", "DCIM/101MEDIA/a.JPG", "DCIM/101MEDIA/b.JPG"),
        ("100MEDIA/a.JPG", "101MEDIA/a.JPG", "101MEDIA/b.JPG"),
    ),
    "formats": ((*PHOTOGRAPHS, "d.HEIC", "e.avif", "f.dng", "Icon\r", ".DS_Store"), PHOTOGRAPHS),
    "drone": ((*PHOTOGRAPHS, "gcp_list.txt", "flight.MRK"), PHOTOGRAPHS),
    "masks": ((*PHOTOGRAPHS, "masks/a.jpg.png"), PHOTOGRAPHS),
    "run": ((*PHOTOGRAPHS, "run/config.json", "run/events.jsonl", "run/renders/x.png"), PHOTOGRAPHS),
    "run around photographs": (
        ("config.json", "events.jsonl", "renders/x.png", *(f"images/{name}" for name in PHOTOGRAPHS)),
        PHOTOGRAPHS,
    ),
    "input": ((*(f"input/{name}" for name in PHOTOGRAPHS), "other/x.jpg"), PHOTOGRAPHS),
    "images without photographs": ((*PHOTOGRAPHS, "images/readme.txt"), PHOTOGRAPHS),
    "scene in a folder": ((*(f"fox/images/{name}" for name in PHOTOGRAPHS), "fox/x.md"), PHOTOGRAPHS),
    "archive inside": ((*PHOTOGRAPHS, "more.zip"), PHOTOGRAPHS),
    "maps of Polycam": (
        (
            *(f"keyframes/images/{name}" for name in PHOTOGRAPHS),
            *(f"keyframes/{maps}/1.png" for maps in ("depth", "confidence")),
            "keyframes/cameras/1.json",
            "mesh_info.json",
        ),
        tuple(f"keyframes/images/{name}" for name in PHOTOGRAPHS),
    ),
    "photographs in a folder called depth": (
        (*(f"trip/depth/{name}" for name in PHOTOGRAPHS), "c.jpg"),
        (*(f"trip/depth/{name}" for name in PHOTOGRAPHS), "c.jpg"),
    ),
}
LIMITS = UploadLimits()


@dataclass(frozen=True)
class Told:
    """What a door says: the photographs that are taken, the notes on the others, and the refusals."""

    photographs: frozenset[str]
    notes: tuple[str, ...]
    refusals: tuple[str, ...]


def by_preview(preview: ScenePreview) -> Told:
    images = {file.name: file.path for file in preview.files if file.name.startswith("images/")}
    masks = masks_beside(images)
    photographs = frozenset(path for name, path in images.items() if name not in masks)
    assert len(photographs) == preview.photographs
    return Told(photographs, preview.notes, tuple(fault.detail for fault in preview.faults))


def by_folder(paths: Sequence[str]) -> Told:
    return by_preview(preview_files([ListedFile(path, 1) for path in paths], LIMITS))


def by_archive(paths: Sequence[str]) -> Told:
    data = build_zip(*(ZipMember(path, b"x") for path in paths))
    preview = preview_archive(data[-20_000:], len(data), LIMITS)
    if not preview.files:
        with pytest.raises(IntakeError, match="no part of a scene"):
            list_archive(io.BytesIO(data))
        return by_preview(preview)
    listing = list_archive(io.BytesIO(data))
    assert {file.name for file in listing.files} == {file.name for file in preview.files}
    assert listing.notes == preview.notes and set(listing.left_out) == set(preview.left_out)
    return by_preview(preview)


def by_run(folder: Path) -> Told:
    """What ``reconstruct`` says before it looks for poses."""
    scene = locate_scene(folder)
    notes = notes_on_files(scene)
    try:
        names = photographs_of_scene(scene)
    except DatasetError as error:
        refusal = str(error).removeprefix(f"{scene}: ").removesuffix(" ".join(("", *notes)))
        return Told(frozenset(), notes, (refusal,))
    paths = (image_folder(scene) / name for name in names)
    return Told(frozenset(path.relative_to(folder).as_posix() for path in paths), notes, ())


def by_estimate(folder: Path) -> Told:
    events: list[Event] = []
    try:
        found = estimate(EstimateRequest(source=folder), progress=events.append)
    except DatasetError as error:
        notes = tuple(event.message for event in events if isinstance(event, Warned))
        refusal = str(error).removeprefix(f"{locate_scene(folder)}: ").removesuffix(" ".join(("", *notes)))
        return Told(frozenset(), notes, (refusal,))
    notes = tuple(event.message for event in events if isinstance(event, Warned))
    count = sum(sizes.count for sizes in found.photographs)
    return Told(frozenset(map(str, range(count))), notes, ())


@functools.cache
def content(suffix: str) -> bytes:
    """Return the bytes of a small image in the format of a suffix; of others, something."""
    kind = {".jpg": "JPEG", ".png": "PNG", ".webp": "WEBP", ".tif": "TIFF"}.get(suffix)
    if kind is None:
        return b"x"
    file = io.BytesIO()
    Image.new("RGB", (8, 6)).save(file, kind)
    return file.getvalue()


def write_files(folder: Path, paths: Sequence[str]) -> None:
    for path in paths:
        place = folder / path
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content(place.suffix.lower()))


@pytest.mark.parametrize("kind", FOLDERS)
def test_folder_archive_and_search_take_the_same_photographs(kind: str, tmp_path: Path) -> None:
    paths, expected = FOLDERS[kind]
    write_files(tmp_path, paths)
    told = by_folder(paths)
    assert told == by_archive(paths) == by_run(tmp_path)
    names = {file.name for file in preview_files([ListedFile(path, 1) for path in paths], LIMITS).files}
    assert {name for name in names if name.startswith("images/")} == {f"images/{name}" for name in expected}


@pytest.mark.parametrize("place", ["images/", "images/left/"])
def test_results_of_a_run_in_the_images_folder_do_not_hide_photographs_beside_it(
    place: str, tmp_path: Path
) -> None:
    paths = [*PHOTOGRAPHS, *(place + name for name in ("render.png", "config.json", "events.jsonl"))]
    write_files(tmp_path, paths)
    told = by_folder(paths)
    assert told == by_archive(paths) == by_run(tmp_path)
    assert told.photographs == frozenset(PHOTOGRAPHS) and not told.refusals


def test_folders_behind_links_belong_to_the_scene(tmp_path: Path) -> None:
    """As a reconstruction here reads them; a link to a folder around it leads nowhere."""
    write_files(tmp_path / "card", PHOTOGRAPHS)
    scene = tmp_path / "scene"
    (scene / "notes").mkdir(parents=True)
    (scene / "images").symlink_to(tmp_path / "card")
    (scene / "notes" / "up").symlink_to(scene)
    (scene / "notes" / "lost").symlink_to(tmp_path / "nothing")
    assert by_run(scene).photographs == {f"images/{name}" for name in PHOTOGRAPHS}

    class Service:
        def post(self, _address: str, body: dict[str, Any]) -> dict[str, Any]:
            listed = [ListedFile(file["path"], file["size_bytes"]) for file in body["files"]]
            preview = preview_files(listed, LIMITS)
            assert not preview.faults
            return {"files": [asdict(file) for file in preview.files], "notes": [], "refusals": []}

    sent = list_scene_files(cast(Api, Service()), scene)
    assert {file.name: file.path for file in sent} == {
        f"images/{name}": scene / "images" / name for name in PHOTOGRAPHS
    }


PICTURES = st.sampled_from(
    ["a.jpg", "b.JPG", "c.png", "d.webp", "e.tif", "a_mask.png", "n ä.jpg", "f.HEIC", "g.dng", "h.gif"]
)
CLUTTER = st.sampled_from(
    ["clip.MOV", "gcp_list.txt", "project.ini", "points3D.ply", "transforms.json", "photos.zip", "x.MRK"]
)
HIDDEN = st.sampled_from([".DS_Store", "Thumbs.db", "Icon\r", "question?.txt", "back\\slash.txt"])
RECORDS = st.sampled_from(
    ["cameras.bin", "images.bin", "points3D.bin", "images.txt", "config.json", "events.jsonl"]
)
NAMES = PICTURES | CLUTTER | HIDDEN | RECORDS
PHOTO_PLACES = st.sampled_from(
    ["", "images/", "images/left/", "images/masks/", "input/", "masks/", "DCIM/100MEDIA/", "fox/images/"]
)
MODEL_PLACES = st.sampled_from(
    ["sparse/", "sparse/0/", "sparse/1/", "colmap/sparse/0/", "distorted/sparse/0/", "dense/0/", "run/"]
)
PLACES = PHOTO_PLACES | MODEL_PLACES | st.sampled_from(["fox/sparse/0/", "photos/"])
PATHS = st.builds(str.__add__, PLACES, NAMES)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    paths=st.lists(PATHS, min_size=1, max_size=14, unique=True),
    photographs=st.sampled_from(["", "images/", "input/", "DCIM/100MEDIA/"]),
    count=st.integers(0, 4),
    outer=st.sampled_from(["", "", "capture/", "a/b/"]),
)
def test_all_doors_take_leave_out_and_refuse_the_same(
    paths: list[str], photographs: str, count: int, outer: str
) -> None:
    paths += [f"{photographs}view_{number}.png" for number in range(count)]
    paths = [outer + path for path in paths]
    # In a ZIP file a backslash ends the name of a folder where no name has a slash.
    assume(any("/" in path for path in paths) or not any("\\" in path for path in paths))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_files(folder, paths)
        told = by_folder(paths)
        assert told == by_archive(paths)
        run, estimated = by_run(folder), by_estimate(folder)
    assert (run.notes, run.refusals) == (told.notes, told.refusals) == (estimated.notes, estimated.refusals)
    assert bool(told.refusals) == (len(told.photographs) < MIN_PHOTOGRAPHS)
    if not told.refusals:
        assert run.photographs == told.photographs and len(estimated.photographs) == len(told.photographs)


def test_files_left_out_are_told_by_kind_with_the_way_out() -> None:
    paths = ["images/a.jpg", "sparse/0/project.ini", "images/b.HEIC", "c.jpg", "v.MOV", "old/transforms.json"]
    layout = lay_out_scene(paths)
    assert layout.files == {"images/a.jpg": "images/a.jpg"} and set(layout.left_out) == set(paths[1:])
    told = left_out_sentences(layout.left_out)
    assert "1 files look like photographs" in told[0] and "images/b.HEIC" in told[0] and "convert" in told[0]
    assert "c.jpg" in told[1] and "v.MOV" in told[2] and "transforms.json" in told[3]
    assert "sparse/0/project.ini" in told[4] and len(told) == 5


def test_poses_of_other_programs_are_told_as_poses() -> None:
    poses = ["bundle.out", "cameras.xml", "keyframes/cameras/1.json", "reconstruction.json", "scene.nvm"]
    told = left_out_sentences([*poses, "notes.json"])
    assert len(told) == 2 and told[0].startswith("5 files hold poses that are not read (bundle.out, ")
    assert "COLMAP model into sparse/0" in told[0] and "(notes.json)" in told[1]


def test_poses_of_reality_scan_are_told_with_the_way_out() -> None:
    paths = ["images/a.jpg", "images/a.xmp", "b.XMP", "registration.csv", "control_points.csv", "notes.json"]
    layout = lay_out_scene(paths)
    assert set(layout.files) == {"images/a.jpg", "control_points.csv"}
    told = left_out_sentences(layout.left_out)
    assert len(told) == 2 and told[0].startswith("3 XMP and CSV files are left out (")
    assert "RealityScan" in told[0] and "COLMAP" in told[0] and "registration.csv" in told[0]
    assert "(notes.json)" in told[1]


LIGHTROOM = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description xmlns:crs="http://ns.adobe.com/camera-raw-settings'
    '/1.0/" crs:Exposure2012="+0.35" crs:Temperature="5200"/></x:xmpmeta>'
)
REALITY_SCAN = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description xcr:Version="3" xcr:PosePrior="initial" '
    'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"><xcr:Rotation>1 0 0 0 1 0 0 0 1</xcr:Rotation>'
    "<xcr:Position>0 0 -2</xcr:Position></rdf:Description></x:xmpmeta>"
)


def test_settings_of_a_photo_editor_beside_photographs_are_not_told_as_poses(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    for name, content in (("a", LIGHTROOM), ("b", LIGHTROOM), ("c", REALITY_SCAN)):
        (tmp_path / "images" / f"{name}.jpg").write_bytes(b"")
        (tmp_path / "images" / f"{name}.xmp").write_text(content)
    poses, other = notes_on_files(tmp_path)
    assert poses.startswith("1 XMP and CSV files are left out (images/c.xmp)") and "RealityScan" in poses
    assert other.startswith("2 files are no part of a scene") and "images/a.xmp, images/b.xmp" in other
    assert "RealityScan" not in other
    (tmp_path / "images" / "c.xmp").unlink()
    assert not any("RealityScan" in sentence for sentence in notes_on_files(tmp_path))


def test_sidecars_named_after_the_whole_name_of_a_photograph_are_not_told_as_poses() -> None:
    layout = lay_out_scene(
        ["images/a.jpg", "images/a.jpg.xmp", "images/b.NEF.xmp"]
    )  # as darktable names them
    assert not any("RealityScan" in sentence for sentence in layout.notes) and len(layout.notes) == 1


@pytest.mark.parametrize("name", ["images/a?.jpg", "images/con.jpg", "images/a.jpg ./b.jpg"])
def test_photographs_of_names_that_not_every_system_takes_are_refused_before_they_are_sent(name: str) -> None:
    paths = [name, "images/b.jpg", "images/c.jpg", "images/d.jpg"]
    told = by_folder(paths)
    data = build_zip(*(ZipMember(path, b"x") for path in paths))
    with pytest.raises(IntakeError) as refused:
        list_archive(io.BytesIO(data))
    assert told.refusals == by_preview(preview_archive(data, len(data), LIMITS)).refusals
    assert told.refusals == (str(refused.value),)


@pytest.mark.parametrize("name", ["a?.jpg", "con.jpg"])
def test_run_takes_names_that_the_service_would_refuse_and_says_so(name: str, tmp_path: Path) -> None:
    paths = [f"images/{name}", "images/b.jpg", "images/c.jpg"]
    write_files(tmp_path, paths)
    told = by_run(tmp_path)
    assert told.photographs == set(paths) and not told.refusals
    (note,) = told.notes
    assert f"'images/{name}'" in note and "service would refuse 1 of these files" in note


def test_ground_truth_of_a_generated_scene_is_left_out_without_a_word(tmp_path: Path) -> None:
    truth = ["mesh.ply", "depth/a.exr", "normals/a.exr", "masks/a.png"]
    paths = [f"images/{name}" for name in PHOTOGRAPHS] + [f"ground_truth/{name}" for name in truth]
    paths.append("generated.json")
    write_files(tmp_path, paths)
    told = by_folder(paths)
    assert told == by_archive(paths) == by_run(tmp_path)
    assert told.notes == () and len(told.photographs) == len(PHOTOGRAPHS)
    (note,) = by_folder([*paths, "ground_truth/b.jpg"]).notes
    assert "ground_truth/b.jpg" in note


def test_files_larger_than_the_service_takes_are_refused_before_they_are_sent() -> None:
    listed = [ListedFile(f"images/{letter}.jpg", 3_000_000) for letter in "abc"]
    faults = preview_files(listed, UploadLimits(max_file_bytes=2_000_000)).faults
    assert [fault.detail for fault in faults] == [
        f"'images/{letter}.jpg' has 3.0 MB; the service takes 2.0 MB." for letter in "abc"
    ]
    (fault,) = preview_archive(b"", 3_000_000, UploadLimits(max_archive_bytes=2_000_000)).faults
    assert fault.detail == "The archive has 3.0 MB; the service takes 2.0 MB."


def test_end_of_an_archive_is_enough_to_tell_what_is_left_out() -> None:
    data = build_zip(*(ZipMember(f"images/{number:04}.jpg", bytes(5000), method=0) for number in range(300)))
    whole = preview_archive(data, len(data), LIMITS)
    sizes, needed = [], 30
    while True:
        try:
            assert preview_archive(data[-needed:], len(data), LIMITS) == whole
            break
        except ArchiveEndTooShortError as error:
            needed = error.needed_bytes
            sizes.append(needed)
    assert whole.photographs == 300 and needed < len(data) / 2 and len(sizes) <= 3


def test_old_windows_archive_with_backslashes_only_is_taken() -> None:
    data = build_zip(ZipMember("fox\\images\\a.jpg", b"x"), ZipMember("fox\\images\\b.jpg", b"x"))
    assert [file.name for file in list_archive(io.BytesIO(data)).files] == ["images/a.jpg", "images/b.jpg"]


@pytest.mark.parametrize("parent", ["sparse", "colmap/sparse", "distorted/sparse"])
def test_largest_of_several_models_is_taken(tmp_path: Path, parent: str) -> None:
    for number, count in ((0, 3), (1, 12), (2, 5)):
        folder = tmp_path / parent / str(number)
        folder.mkdir(parents=True)
        for part in ("cameras", "images", "points3D"):
            (folder / f"{part}.bin").write_bytes(count.to_bytes(8, "little"))
    assert find_model(tmp_path) == tmp_path / parent / "1"


def test_only_model_with_another_number_is_kept_in_an_archive() -> None:
    names = [f"sparse/1/{part}.bin" for part in ("cameras", "images", "points3D")]
    data = build_zip(*(ZipMember(name, b"x") for name in ["images/a.jpg", *names]))
    assert {file.name for file in list_archive(io.BytesIO(data)).files} == {"images/a.jpg", *names}


def test_renders_of_a_run_are_no_photographs_at_any_door(tmp_path: Path) -> None:
    paths = ("config.json", "events.jsonl", *(f"renders/{name}" for name in PHOTOGRAPHS))
    for told in (by_folder(paths), by_folder([f"run/{path}" for path in paths])):
        assert told.photographs == frozenset()
        assert told.refusals[0].startswith("There are 0 photographs")
        assert told.notes[0].startswith("5 files of results among the photographs are left out")
    with pytest.raises(IntakeError, match="no part of a scene"):
        list_archive(io.BytesIO(build_zip(*(ZipMember(path, b"x") for path in paths))))
    write_files(tmp_path, paths)
    with pytest.raises(DatasetError, match="is the folder of a run"):
        locate_scene(tmp_path)
