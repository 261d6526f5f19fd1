"""Exceptions for users: each message is one sentence that names the file and what to do."""

import re
from pathlib import Path
from typing import Any, ClassVar


class OctasplatError(Exception):
    """Base of every error that the user can correct; its text is one sentence fit to print as it is.

    Attributes:
        error_type: what a job that fails so publishes as its ``error.type``, in snake case. It is part of the
            API: a class whose name changes keeps it. A subclass without its own takes it from its name.
    """

    error_type: ClassVar[str] = "octasplat_error"

    def __init_subclass__(cls, **options: Any) -> None:
        """Derive ``error_type`` from the class name where a class does not set its own."""
        super().__init_subclass__(**options)
        if "error_type" not in vars(cls):
            cls.error_type = re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()


class DatasetError(OctasplatError):
    """The photographs, masks or the COLMAP model cannot be used."""

    error_type = "dataset_error"


class DamagedImageError(DatasetError):
    """A photograph or mask is no image, or ends before all of it was read.

    Attributes:
        path: the file.
    """

    error_type = "dataset_error"

    def __init__(self, message: str, path: Path) -> None:
        super().__init__(message)
        self.path = path


class ColmapCrashError(OctasplatError):
    """COLMAP crashed during pose estimation."""

    error_type = "poses_crashed"


class SceneFileError(OctasplatError):
    """A file of Gaussians or of a mesh cannot be read or written."""

    error_type = "scene_file_error"


class ExportError(OctasplatError):
    """Some of the requested files could not be written; the others were."""

    error_type = "export_failed"


class ConfigError(OctasplatError):
    """A setting is unknown, out of range or contradicts another."""

    error_type = "config_error"


class OutputError(OctasplatError):
    """The output folder cannot be used: it holds another run, or cannot be written."""

    error_type = "output_error"


class DiskFullError(OutputError):
    """A file cannot be written because its disk is full; its former version is unchanged."""

    error_type = "no_space_left"


class CheckpointError(OctasplatError):
    """A checkpoint is missing, damaged or belongs to another configuration."""

    error_type = "checkpoint_error"


class DamagedCheckpointError(CheckpointError):
    """A checkpoint file cannot be read; the one before it may be sound."""

    error_type = "damaged_checkpoint"


class TrainingError(OctasplatError):
    """Training failed (not-a-number, an empty scene, a scene that covers nothing); nothing is exported."""

    error_type = "training_failure"


class CancelledError(OctasplatError):
    """The run was asked to stop; a checkpoint was written and ``--resume`` continues from it."""

    error_type = "cancelled"
