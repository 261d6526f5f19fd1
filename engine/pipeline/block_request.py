"""Request to train a scene in blocks: kept with its run, and resolved to their number."""

import shutil
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from octasplat.engine.blocks.piece_settings import fewest_blocks, require_blocks_possible
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.writing import write_text
from octasplat.engine.dataset import Dataset
from octasplat.engine.runs.config import ReconstructionConfig
from octasplat.engine.runs.run_folder import BLOCKS, VIEWS
from octasplat.engine.train.sampling.pixel_sampler import valid_pixel_fraction

REQUEST = "request.json"


class BlockRequest(BaseModel):
    """How a scene is to be trained in blocks.

    Attributes:
        count: number of blocks; None lets photographs and memory decide.
        most_gaussians: of any block with its margin; None for no such limit.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    count: int | None = Field(None, ge=1)
    most_gaussians: int | None = Field(None, ge=1)

    def resolve(self, config: ReconstructionConfig, dataset: Dataset) -> int:
        """Return the number of blocks: the fewest, 1 for a scene that one training holds.

        Args:
            config: of the run.
            dataset: the photographs.

        Raises:
            ConfigError: settings with which a scene is not trained in blocks.
        """
        count = self.count
        if count is None:
            valid = valid_pixel_fraction(dataset) if self.most_gaussians is not None else 1.0
            views, pixels = len(dataset.train_indices), dataset.train_pixel_count
            count = fewest_blocks(config.train, views, pixels, self.most_gaussians, valid)
        if count > 1:
            require_blocks_possible(config)
        return count


def keep_request(output: Path, request: BlockRequest | None, *, is_new: bool) -> BlockRequest | None:
    """Return the request of a run: the one given, which a new run keeps, or the one that it has kept.

    A run that was stopped before it had opened its photographs may take another one: its disk may have been
    full before the first one was kept.

    Raises:
        ConfigError: the run was begun with another one, or stopped before it had kept one.
    """
    path = output / BLOCKS / REQUEST
    given = None if request is not None and request.count == 1 else request  # one block is an ordinary run
    if is_new or (request is not None and not (output / VIEWS).exists()):
        if given is not None:
            write_text(path, given.model_dump_json(indent=2) + "\n")
        else:
            shutil.rmtree(path.parent, ignore_errors=True)
        return given
    if request is None and path.parent.is_dir() and not path.exists():
        raise ConfigError(
            f"The run in {output} was stopped before it had kept how its blocks are made; repeat --blocks."
        )
    try:
        kept = BlockRequest.model_validate_json(path.read_text(encoding="utf-8")) if path.exists() else None
    except (OSError, ValidationError) as error:
        raise ConfigError(f"{path} cannot be read ({error}); train again without --resume.") from None
    if request is not None and given != kept:
        raise ConfigError(
            f"The run in {output} was begun with other blocks than this command asks for; repeat its "
            "--blocks and --memory, leave them out, or name another folder."
        )
    return kept
