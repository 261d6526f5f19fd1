"""Live scenes: the newest state of a training, decimated, with its cameras."""

import uuid
from dataclasses import dataclass

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
    """

    job_id: uuid.UUID
    sha256: str
    views_sha256: str
    step: int
    gaussians: int


async def get_live_scene(connection: Connection, job_id: uuid.UUID) -> LiveScene | None:
    """Return the live scene of a job; None if it has none."""
    return await fetch_one(connection, LiveScene, "SELECT {} FROM live_scenes WHERE job_id = %s", [job_id])


async def put_live_scene(connection: Connection, scene: LiveScene) -> None:
    """Replace the live scene of a job."""
    await connection.execute(
        """
        INSERT INTO live_scenes (job_id, sha256, views_sha256, step, gaussians)
        VALUES (%s, %s, %s, %s, %s)
        ON CONFLICT (job_id) DO UPDATE SET sha256 = excluded.sha256, views_sha256 = excluded.views_sha256,
            step = excluded.step, gaussians = excluded.gaussians
        """,
        [scene.job_id, scene.sha256, scene.views_sha256, scene.step, scene.gaussians],
    )


async def remove_live_scene(connection: Connection, job_id: uuid.UUID) -> None:
    """Remove the live scene of a job; harmless if there is none."""
    await connection.execute("DELETE FROM live_scenes WHERE job_id = %s", [job_id])
