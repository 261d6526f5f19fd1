"""The exceptions that users see: one clear sentence each, naming the file and what to do."""


class OctasplatError(Exception):
    """Base of every error that is the user's to mend; its text is one sentence fit to print as it is."""


class DatasetError(OctasplatError):
    """The photographs, masks or the COLMAP model cannot be used."""


class PosesCrashed(OctasplatError):
    """COLMAP died while it looked for poses."""


class SceneFileError(OctasplatError):
    """A file of Gaussians or of a mesh cannot be read or written."""


class ExportFailed(OctasplatError):
    """Some of the files that were asked for could not be written; everything else is there."""


class ConfigError(OctasplatError):
    """A setting is unknown, out of range or contradicts another."""


class OutputError(OctasplatError):
    """The output folder cannot be used as asked (it holds another run, or cannot be written)."""


class NoSpaceLeft(OutputError):
    """A file cannot be written because its disk is full; what was there before is whole."""


class CheckpointError(OctasplatError):
    """A checkpoint is missing, damaged or belongs to another configuration."""


class DamagedCheckpoint(CheckpointError):
    """A checkpoint file cannot be read; the one before it may be sound."""


class TrainingFailure(OctasplatError):
    """Training collapsed (not-a-number, an empty scene, a scene that covers nothing); nothing is exported."""


class Cancelled(OctasplatError):
    """The run was asked to stop; a checkpoint was written and ``--resume`` goes on from it."""
