"""Live scenes: the newest state of a training, decimated, with its cameras.

The file of a job in blocks has the Gaussians of one block after those of the other. A block that is trained
has a row of its own job, and its file is shown in their place: nobody writes what two blocks share, so that
blocks may end at once, on any workers.
"""

import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from octasplat.workers.db.connections import Connection, fetch_one


@dataclass(frozen=True)
class LiveScene:
    """The newest state of a job's training.

    Attributes:
        job_id: the job.
        sha256: of the PLY file.
        views_sha256: of the JSON file of the cameras.
        step: iterations that are done; 0 for the sparse points before the training.
        gaussians: number of Gaussians in the file.
        block_gaussians: of each block, one after the other, in the file of a scene in blocks; else None.
    """

    job_id: uuid.UUID
    sha256: str
    views_sha256: str
    step: int
    gaussians: int
    block_gaussians: list[int] | None = None


@dataclass(frozen=True)
class LiveBlock:
    """What a trained block shows in the place of its part of the scene.

    Attributes:
        sha256: of its PLY file.
        gaussians: number of Gaussians in the file.
        iterations: of its training.
    """

    sha256: str
    gaussians: int
    iterations: int


@dataclass(frozen=True)
class ShownScene:
    """What is shown of a training.

    Attributes:
        scene: the newest state.
        blocks: those that are trained, by number.
    """

    scene: LiveScene
    blocks: Mapping[int, LiveBlock] = field(default_factory=dict)

    @property
    def step(self) -> int:
        """Return the iterations that are done of what is shown."""
        return self.scene.step + sum(block.iterations for block in self.blocks.values())

    @property
    def gaussians(self) -> int:
        """Return the number of Gaussians that are shown."""
        counts = self.scene.block_gaussians or []
        more = sum(block.gaussians - counts[number - 1] for number, block in self.blocks.items())
        return self.scene.gaussians + more


async def get_shown_scene(connection: Connection, job_id: uuid.UUID) -> ShownScene | None:
    """Return what is shown of a job's training; None if there is nothing."""
    query = "SELECT {} FROM live_scenes WHERE job_id = %s"
    scene = await fetch_one(connection, LiveScene, query, [job_id])
    if scene is None:
        return None
    *counts, mark = scene.block_gaussians or [0]
    # Not so where a worker of the former version has written another file since, and left the column.
    if mark != _mark_of_file(scene.sha256) or sum(counts) != scene.gaussians:
        return ShownScene(replace(scene, block_gaussians=None))
    scene = replace(scene, block_gaussians=counts)
    cursor = await connection.execute(
        """
        SELECT (jobs.options->>'number')::int AS number, sha256, gaussians,
            coalesce((jobs.options->>'iterations')::int, 0) AS iterations
        FROM live_scenes JOIN jobs ON jobs.id = live_scenes.job_id
        WHERE jobs.root_id = %s AND jobs.state = 'succeeded' ORDER BY number
        """,
        [job_id],
    )
    found = {row.pop("number"): LiveBlock(**row) for row in await cursor.fetchall()}
    return ShownScene(scene, {number: block for number, block in found.items() if 0 < number <= len(counts)})


async def put_live_scene(connection: Connection, scene: LiveScene) -> None:
    """Replace the live scene of a job."""
    counts = scene.block_gaussians
    marked = None if counts is None else [*counts, _mark_of_file(scene.sha256)]
    await connection.execute(
        """
        INSERT INTO live_scenes (job_id, sha256, views_sha256, step, gaussians, block_gaussians)
        VALUES (%s, %s, %s, %s, %s, %s)
        ON CONFLICT (job_id) DO UPDATE SET sha256 = excluded.sha256, views_sha256 = excluded.views_sha256,
            step = excluded.step, gaussians = excluded.gaussians, block_gaussians = excluded.block_gaussians
        """,
        [
            scene.job_id,
            scene.sha256,
            scene.views_sha256,
            scene.step,
            scene.gaussians,
            marked,
        ],
    )


def _mark_of_file(sha256: str) -> int:
    """Return what stands behind the counts of blocks in the table, and tells of which file they are."""
    return int(sha256[:7], 16)  # fits an integer of the database


async def remove_live_scene(connection: Connection, job_id: uuid.UUID) -> None:
    """Remove the live scene of a job; harmless if there is none."""
    await connection.execute("DELETE FROM live_scenes WHERE job_id = %s", [job_id])
