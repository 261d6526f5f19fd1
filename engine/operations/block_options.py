"""Options of scenes that are trained in blocks, and the request that they mean."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import BeforeValidator, ByteSize, Field, TypeAdapter, ValidationError

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.base import Options
from octasplat.engine.settings.fields import Spelling
from octasplat.engine.settings.refusals import InvalidSettingsError, Refusal

if TYPE_CHECKING:
    from octasplat.engine.pipeline import BlockRequest
    from octasplat.engine.runs.config import ReconstructionConfig

MIN_GAUSSIANS = 5_000
"""Fewer in a block are not worth one."""


MAX_BLOCKS = 10_000
"""As many as may be asked for."""
_Count = Annotated[int, Field(ge=1, le=MAX_BLOCKS)] | Literal["auto"] | None


def _read_count(value: object) -> object:
    """Return the number of blocks, ``auto`` or None.

    Raises:
        ValueError: the value is none of them.
    """
    if value is None or value == "auto":
        return value
    try:
        count = TypeAdapter(int).validate_python(value)
    except ValidationError:
        count = 0
    if not 1 <= count <= MAX_BLOCKS:
        raise ValueError(f"{value!r} is neither auto nor a number of blocks from 1 to {MAX_BLOCKS:,}")
    return count


class BlockOptions(Options):
    """How a scene is cut into blocks."""

    blocks: Annotated[_Count, BeforeValidator(_read_count, json_schema_input_type=_Count)] = Field(
        None,
        description="Train the scene in so many blocks, one after the other or, as a job of a service, on "
        "all workers at once; auto takes the fewest that the number of photographs and the memory ask for, "
        "which is 1 for most scenes.",
    )
    memory: Annotated[str | None, Spelling(metavar="SIZE")] = Field(
        None,
        description="With blocks: about the most memory that the training of one takes, such as 8G; blocks "
        "have no more Gaussians than that holds.",
    )


def check_block_options(options: BlockOptions, config: "ReconstructionConfig") -> None:
    """Refuse options of blocks that can be told to be wrong before the photographs are known.

    Raises:
        InvalidSettingsError: the memory is given without blocks or is no size, or the settings go with one
            training only.
    """
    from octasplat.engine.blocks.piece_settings import require_blocks_possible

    name = "memory"
    try:
        if options.memory is not None:
            parse_memory(options.memory)
        if options.memory is not None and options.blocks is None:
            raise ConfigError("--memory is that of a block; say --blocks auto, too.")
        name = "blocks"
        if isinstance(options.blocks, int) and options.blocks > 1:  # an automatic number is known later
            require_blocks_possible(config)
    except ConfigError as error:
        raise InvalidSettingsError([Refusal((name,), "blocks", str(error))]) from None


def block_request(
    options: BlockOptions, config: "ReconstructionConfig", sizes: Sequence[ImageSizes]
) -> "BlockRequest | None":
    """Return how a scene is to be trained in blocks; None where the options do not say.

    Args:
        options: of the request.
        config: of the reconstruction.
        sizes: of the photographs.

    Raises:
        ConfigError: the memory is given without blocks, is no size, or holds no block.
    """
    from octasplat.engine.operations.cost_model import gaussians_within
    from octasplat.engine.pipeline import BlockRequest

    check_block_options(options, config)
    if options.blocks is None:
        return None
    most = None
    if options.memory is not None:
        most = gaussians_within(config, sizes, parse_memory(options.memory))
        if most < MIN_GAUSSIANS:
            raise ConfigError(
                f"--memory {options.memory} holds no block: what a training takes besides its Gaussians is "
                "more, or nearly so; allow more, or shrink the photographs with --max-side."
            )
    return BlockRequest(count=None if options.blocks == "auto" else options.blocks, most_gaussians=most)


def parse_memory(text: str) -> int:
    """Return the bytes that ``8G``, ``500M``, ``2GiB`` or a plain number mean; G is 10^9.

    Raises:
        ConfigError: it is no size.
    """
    try:
        return int(TypeAdapter(ByteSize).validate_python(text))
    except ValidationError:
        raise ConfigError(f"'{text}' is no size of memory; write it as 8G or 500M.") from None
