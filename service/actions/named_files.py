"""Check that files named in the options of a job are among the uploaded ones."""

import uuid

from pydantic import BaseModel

from octasplat.engine.core.portable_names import quoted_name
from octasplat.service.actions.validation import input_problem
from octasplat.service.auth import Principal
from octasplat.service.problems import ProblemError
from octasplat.workers.db.connections import Connection
from octasplat.workers.db.datasets import files_of, get_dataset
from octasplat.workers.worker.job_kinds import JobKind


async def check_named_files(
    connection: Connection,
    principal: Principal,
    kind: JobKind,
    options: BaseModel,
    files_id: uuid.UUID | None,
) -> None:
    """Refuse options that name a file which was not uploaded under exactly this name.

    Args:
        connection: to the database.
        principal: asks.
        kind: of the job.
        options: complete ones.
        files_id: the dataset that is to hold the files.

    Raises:
        ProblemError: 422, with the place of each such name; 409 if the dataset is not committed.
    """
    names = list(kind.named_files(options))
    sent: set[str] = set()
    if files_id is not None:
        if not kind.takes_files:
            raise input_problem("files_id", f"Jobs of the kind {kind.name} take no files.")
        # Locked, so that it is not deleted before the new job refers to it.
        dataset = await get_dataset(connection, files_id, lock=True)
        if dataset is None or not principal.may_see(dataset.owner):
            raise input_problem("files_id", "There is no such dataset.")
        if dataset.holds != "files":
            detail = "The dataset holds photographs; make one that holds files."
            raise input_problem("files_id", detail)
        if dataset.state != "committed":
            raise ProblemError(
                409, "dataset-open", "The dataset is not committed yet; POST to its /commit first."
            )
        sent = {file.path for file in await files_of(connection, files_id)}
    faults = [
        {
            "pointer": f"#/options/{path.replace('.', '/')}",
            "detail": f"{path}: there is no file {quoted_name(name)} among those of files_id; send it.",
            "file": name,
        }
        for path, name in names
        if name not in sent
    ]
    if faults:
        raise ProblemError(422, "file-missing", faults[0]["detail"], errors=faults)
