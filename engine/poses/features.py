"""Features of photographs and matches between them, by COLMAP, the same on any number of threads.

COLMAP numbers photographs in the order in which its threads finish them, and draws a pair's random numbers
from the generator of the thread that happens to take it: photographs are numbered beforehand, and every pair
has the same seed. A call looks at a few photographs or pairs, and what is done is counted between calls; the
database of a call that runs must not be opened by anybody else in the process, as closing any handle on an
SQLite file gives up the locks of all.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.dataset.photograph_gps import read_latitude_longitude
from octasplat.engine.poses.config import (
    MAX_FEATURES,
    MAX_IMAGE_SIDE_PX,
    PRESELECTION_FEATURES,
    PRESELECTION_MATCHES,
    PosesConfig,
)
from octasplat.engine.poses.pair_proposals import propose_pairs
from octasplat.engine.poses.pairs import (
    Pair,
    all_pairs,
    batch_pairs,
    largest_features,
    pair_count,
    select_pairs,
)

OnCount = Callable[[int], None]
"""Told how many are done."""
OnLook = Callable[[int, float], None]
"""Told how many pairs are known to be unlike, and what share of those to be looked at has been."""

_PHOTOGRAPHS_PER_BATCH = 4
_PHOTOGRAPHS_PER_IMPORT = 16
_PAIRS_PER_BATCH = 64
_PRESELECTION_PAIRS_PER_BATCH = 2048
_MIN_PRESELECTION_INLIERS = 4
_RELAXED_MATCH_RATIO = 0.9
"""A match may be so near in distance to the second best one; otherwise 0.8."""


def create_database(
    database: Path,
    photographs: Path,
    names: Sequence[str],
    *,
    one_camera: bool,
    on_count: OnCount = lambda _done: None,
) -> tuple[str, ...]:
    """Make a database of photographs, without features.

    Args:
        database: does not exist yet.
        photographs: folder.
        names: of the photographs in it.
        one_camera: all photographs were taken with one lens.
        on_count: hears of photographs, each of which COLMAP decodes.

    Returns:
        The photographs as the database numbers them, from 1 on. COLMAP leaves out files that it cannot read
        and gives their numbers to those that follow.
    """
    pycolmap.Database.open(database).close()  # COLMAP wants it to exist
    # with one camera for all, it makes no difference in how many calls
    step = _PHOTOGRAPHS_PER_IMPORT if one_camera else max(1, len(names))
    options = pycolmap.ImageReaderOptions()
    for start in range(0, len(names), step):
        some = list(names[start : start + step])
        pycolmap.import_images(database, photographs, _camera_mode(one_camera), some, options)
        if one_camera:
            with pycolmap.Database.open(database) as made:
                options.existing_camera_id = 1 if made.num_cameras() else -1
        on_count(start + len(some))
    _add_gps_without_altitude(database, photographs)
    return photographs_of(database)


def _add_gps_without_altitude(database: Path, photographs: Path) -> None:
    """Add the GPS of photographs without an altitude, which COLMAP leaves out, at an altitude of 0."""
    with pycolmap.Database.open(database) as made:
        located = {prior.corr_data_id.id for prior in made.read_all_pose_priors() if prior.has_position()}
        for image in made.read_all_images():
            place = None
            if image.image_id not in located:
                place = read_latitude_longitude(photographs / image.name)
            if place is not None:
                prior = pycolmap.PosePrior()
                prior.corr_data_id = image.data_id
                prior.position = np.array([*place, 0.0])
                prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.WGS84
                made.write_pose_prior(prior)


def photographs_of(database: Path) -> tuple[str, ...]:
    """Return the photographs of a database in the order of their numbers."""
    with pycolmap.Database.open(database) as made:
        by_number = {image.image_id: image.name for image in made.read_all_images()}
    return tuple(by_number[number] for number in range(1, len(by_number) + 1))


def _camera_mode(one_camera: bool) -> "pycolmap.CameraMode":
    return pycolmap.CameraMode.SINGLE if one_camera else pycolmap.CameraMode.AUTO


def extract_features(
    database: Path,
    photographs: Path,
    names: Sequence[str],
    config: PosesConfig,
    *,
    thorough: bool,
    one_camera: bool,
    threads: int,
    on_count: OnCount,
) -> None:
    """Fill a database with the features of those photographs that it has none of.

    Args:
        database: see :func:`create_database`.
        photographs: folder.
        names: of those of its photographs that are to be looked at.
        config: settings.
        thorough: twice as many features, and fainter ones.
        one_camera: as the database was made.
        threads: to use; -1 means all cores.
        on_count: hears of photographs.
    """
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = threads
    options.max_image_size = MAX_IMAGE_SIDE_PX
    options.use_gpu = False
    options.sift.max_num_features = MAX_FEATURES * (2 if thorough else 1)
    if thorough:  # fainter features, too
        options.sift.peak_threshold /= 3
    elif config.is_large(len(names)):
        options.sift.first_octave = 0  # not in the enlarged photograph: 2.5 times as fast
    with pycolmap.Database.open(database) as found:
        missing = {
            image.name
            for image in found.read_all_images()
            if not (found.exists_keypoints(image.image_id) and found.exists_descriptors(image.image_id))
        }
    wanted = [name for name in names if name in missing]
    there = len(names) - len(wanted)
    if there:
        on_count(there)
    for start in range(0, len(wanted), _PHOTOGRAPHS_PER_BATCH):
        some = wanted[start : start + _PHOTOGRAPHS_PER_BATCH]
        pycolmap.extract_features(
            database,
            photographs,
            image_names=some,
            camera_mode=_camera_mode(one_camera),
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        on_count(there + start + len(some))


def feature_counts(database: Path, photographs: int) -> list[int]:
    """Return the number of features of each photograph of a database, in the order of their numbers."""
    with pycolmap.Database.open(database) as found:
        return [found.num_keypoints_for_image(number + 1) for number in range(photographs)]


def match_pairs(
    database: Path,
    names: Sequence[str],
    pairs: Sequence[Pair],
    config: PosesConfig,
    *,
    thorough: bool,
    threads: int,
    on_count: OnCount,
) -> None:
    """Match the features of those pairs that are not matched yet, and keep what one geometry explains.

    Args:
        database: with features.
        names: of the photographs, as they are numbered.
        pairs: indices into ``names``.
        config: settings.
        thorough: take matches that are less clear.
        threads: to use; -1 means all cores.
        on_count: hears of pairs.
    """
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = threads
    options.use_gpu = False
    if thorough:
        options.sift.max_ratio = _RELAXED_MATCH_RATIO
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = config.seed
    with pycolmap.Database.open(database) as found:
        # a search that was stopped has some already
        wanted = [(a, b) for a, b in pairs if not found.exists_two_view_geometry(a + 1, b + 1)]
    done = len(pairs) - len(wanted)
    if done:
        on_count(done)
    for some in batch_pairs(wanted, _PAIRS_PER_BATCH):
        _match_pairs(database, names, some, options, verification)
        done += len(some)
        on_count(done)


def preselect_pairs(
    database: Path, names: Sequence[str], config: PosesConfig, *, threads: int, on_look: OnLook
) -> list[Pair]:
    """Return pairs worth matching, by matching only the largest features of photographs.

    All pairs are looked at so, or in a large capture those that something proposes, see
    :mod:`octasplat.engine.poses.pair_proposals`.

    Args:
        database: with features; is only read.
        names: of the photographs, as they are numbered.
        config: settings.
        threads: to use; -1 means all cores.
        on_look: hears of pairs that are not alike.
    """
    small = database.with_name("quick.db")
    small.unlink(missing_ok=True)
    copy_largest_features(database, small, len(names), PRESELECTION_FEATURES)
    count = len(names)
    if config.is_large(count):
        proposed, partners = (
            propose_pairs(database, small, count, seed=config.seed, threads=threads),
            config.large_partners,
        )
    else:
        proposed, partners = all_pairs(count), config.partners
    unlikely = pair_count(count) - len(proposed)
    on_look(unlikely, 0.0)

    def tell(looked: int, found: int) -> None:
        on_look(unlikely + looked - found, looked / len(proposed))

    alike = look_at_pairs(small, names, proposed, threads=threads, on_looked=tell)
    small.unlink()
    return select_pairs(
        alike,
        count,
        min_matches=PRESELECTION_MATCHES,
        partners=partners,
        neighbours=config.neighbours,
    )


def look_at_pairs(
    small: Path,
    names: Sequence[str],
    pairs: Sequence[Pair],
    *,
    threads: int,
    on_looked: Callable[[int, int], None] = lambda _looked, _alike: None,
) -> dict[Pair, int]:
    """Return the matches of pairs of photographs of which only the largest features are known.

    Args:
        small: database of these features; has no matches before and after.
        names: of the photographs, as they are numbered.
        pairs: indices into ``names``.
        threads: to use; -1 means all cores.
        on_looked: hears of pairs that were looked at, and how many of them are alike.

    Returns:
        The number of matches of pairs that have any.
    """
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = threads
    options.use_gpu = False
    options.skip_geometric_verification = True
    # the quick look needs no geometry, only counts
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = _MIN_PRESELECTION_INLIERS
    matches_of: dict[Pair, int] = {}
    looked = alike = 0
    for some in batch_pairs(pairs, _PRESELECTION_PAIRS_PER_BATCH):
        _match_pairs(small, names, some, options, verification)
        with pycolmap.Database.open(small) as found:
            ids, counts = found.read_num_matches()
            found.clear_matches()
        for pair_id, matches in zip(ids, counts, strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            matches_of[first - 1, second - 1] = matches
            alike += matches >= PRESELECTION_MATCHES
        looked += len(some)
        on_looked(looked, alike)
    return matches_of


def _match_pairs(
    database: Path,
    names: Sequence[str],
    pairs: Sequence[Pair],
    options: "pycolmap.FeatureMatchingOptions",
    verification: "pycolmap.TwoViewGeometryOptions",
) -> None:
    listed = database.with_name("pairs.txt")
    listed.write_text("\n".join(f"{names[a]} {names[b]}" for a, b in pairs), encoding="utf-8")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listed
    pycolmap.match_image_pairs(
        database,
        matching_options=options,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def copy_largest_features(database: Path, small: Path, photographs: int, count: int) -> None:
    """Make a database of so many photographs with the ``count`` largest features of each."""
    with pycolmap.Database.open(database) as source, pycolmap.Database.open(small) as target:
        for camera in source.read_all_cameras():
            target.write_camera(camera, use_camera_id=True)
        for rig in source.read_all_rigs():
            target.write_rig(rig, use_rig_id=True)
        for frame in source.read_all_frames():
            target.write_frame(frame, use_frame_id=True)
        for image in source.read_all_images():
            target.write_image(image, use_image_id=True)
        for number in range(1, photographs + 1):
            if not source.exists_keypoints(number):
                continue  # the photograph could not be read
            keypoints = source.read_keypoints(number)
            descriptors = source.read_descriptors(number)
            kept = largest_features(keypoints, count)
            descriptors.data = descriptors.data[kept]
            target.write_keypoints(number, keypoints[kept])
            target.write_descriptors(number, descriptors)
