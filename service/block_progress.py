"""Progress of a job in blocks, made from that of its blocks while it waits for them."""

from collections.abc import Sequence
from dataclasses import replace

from octasplat.workers.db.rows import Job


def with_block_progress(root: Job, blocks: Sequence[Job]) -> Job:
    """Return a job with steps and time left as its blocks have them; any that does not wait as it is.

    What waits for a worker is taken to have the pace of what runs, and as many blocks to run at once as now.

    Args:
        root: the job; while it waits, its own step is what was done before the blocks.
        blocks: the jobs of its blocks.
    """
    if not root.waits_for_blocks or root.total_steps is None:
        return root
    lengths = [_iterations(block) for block in blocks]
    done = [_done(block, length) for block, length in zip(blocks, lengths, strict=True)]
    step = min(root.total_steps, (root.step or 0) + sum(done))
    running = [
        (block.seconds_left, length - steps)
        for block, length, steps in zip(blocks, lengths, done, strict=True)
        if block.state == "running" and _is_trained_now(block) and block.seconds_left is not None
        if length > steps
    ]
    if not running:
        return replace(root, step=step)
    pace_s = sum(seconds for seconds, _ in running) / sum(left for _, left in running)
    left = sum(lengths) - sum(done)
    after = max(0, root.total_steps - (root.step or 0) - sum(lengths))
    side_by_side = sum(block.state == "running" for block in blocks)
    longest = max(seconds for seconds, _ in running)
    return replace(root, step=step, seconds_left=max(longest, left * pace_s / side_by_side) + after * pace_s)


def _iterations(block: Job) -> int:
    return int(block.options.get("iterations", 0)) or block.total_steps or 0


def _done(block: Job, length: int) -> int:
    if block.state == "succeeded":
        return length
    return min(block.step or 0, length) if _is_trained_now(block) else 0


def _is_trained_now(block: Job) -> bool:
    """Return whether steps and time left of a block are iterations, not those of reading its photographs."""
    return block.stage == "train"
