"""What a failed job publishes as its error's type stays as it is, whatever the classes are called."""

from octasplat.engine.core import errors as engine_errors
from octasplat.engine.core.errors import OctasplatError
from octasplat.engine.core.portable_names import FileNameError
from octasplat.engine.operations.base import ContradictoryRequestError
from octasplat.engine.settings.refusals import InvalidSettingsError
from octasplat.workers.db.datasets import create_dataset, put_file
from octasplat.workers.db.quotas import QuotaExceededError
from octasplat.workers.storage import errors as storage_errors
from tests.support.worker_harness import WorkerHarness

ENGINE_TYPES = {
    "octasplat_error",
    "dataset_error",
    "poses_crashed",
    "scene_file_error",
    "export_failed",
    "config_error",
    "output_error",
    "no_space_left",
    "checkpoint_error",
    "damaged_checkpoint",
    "training_failure",
    "cancelled",
}
STORAGE_TYPES = {
    "storage_error",
    "storage_full",
    "storage_unavailable",
    "digest_mismatch",
    "too_large",
    "blob_missing",
    "not_a_file",
}


def types_in(module: object) -> set[str]:
    found = [value for value in vars(module).values() if isinstance(value, type)]
    return {kind.error_type for kind in found if issubclass(kind, OctasplatError)}


def test_published_error_types_are_those_of_the_previous_release() -> None:
    assert types_in(engine_errors) == ENGINE_TYPES
    assert types_in(storage_errors) == STORAGE_TYPES | {"octasplat_error"}
    others = (ContradictoryRequestError, InvalidSettingsError, QuotaExceededError, FileNameError)
    published = ["contradictory_request", "settings_refused", "quota_exceeded", "name_refused"]
    assert [kind.error_type for kind in others] == published


def test_error_type_of_a_new_class_is_its_name_in_snake_case() -> None:
    class LensNotKnownError(OctasplatError):
        pass

    assert LensNotKnownError.error_type == "lens_not_known_error"


def test_worker_and_child_spell_error_types_alike(bench: WorkerHarness) -> None:
    """The worker's own errors were published in another spelling until 0.1."""
    dataset = bench.run_query(lambda connection: create_dataset(connection, "me", "a")).id
    bench.run_query(lambda connection: put_file(connection, dataset, "images/a.jpg", "ab" * 32, 9))
    bench.worker()
    lost = bench.wait_until_finished(bench.submit(dataset_id=dataset))
    refused = bench.wait_until_finished(bench.submit(options={"refuse": True}))
    assert [job.error["type"] for job in (lost, refused) if job.error] == ["blob_missing", "dataset_error"]
    assert (lost.state, lost.attempt) == ("failed", 1)
