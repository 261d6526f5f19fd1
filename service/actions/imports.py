"""Files of datasets that the service fetches from elsewhere, under the rules of webhooks' addresses."""

import asyncio
import uuid
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from urllib.parse import urljoin

import httpx

from octasplat.service.actions import uploads
from octasplat.service.actions.access import check_not_draining, open_dataset
from octasplat.service.actions.dataset_tasks import TaskOutcome, check_share, new_task
from octasplat.service.actions.uploads import Upload
from octasplat.service.auth import Principal
from octasplat.service.idempotency import create_once, fingerprint
from octasplat.service.problems import ProblemError, not_found_error
from octasplat.service.schemas.datasets import MAX_IMPORT_URL, NewImport
from octasplat.service.state import Service
from octasplat.workers.db.connections import retry_on_deadlock
from octasplat.workers.db.dataset_tasks import DatasetTask, get_task
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.maintenance.webhooks.addresses import AddressRefusedError, check_url
from octasplat.workers.maintenance.webhooks.guarded_transport import OWNER_EXTENSION
from octasplat.workers.maintenance.webhooks.sender import guarded_client

MAX_REDIRECTS = 5
HEADER_SECONDS = 30.0
"""For an address to begin its answer."""


@retry_on_deadlock
async def request_import(
    service: Service,
    principal: Principal,
    dataset_id: uuid.UUID,
    new: NewImport,
    *,
    idempotency_key: str | None = None,
) -> DatasetTask:
    """Return the task that fetches a ZIP file, or one file, from an address and stores it as an upload is.

    Raises:
        ProblemError: 404, 422 for an address that nothing is fetched from, 429 with too many that wait.
        ConflictError: the dataset is not open.
        IntakeError: the name of the file is refused.
    """
    check_not_draining(service)
    try:
        check_url(new.url, service.settings.import_hosts, max_length=MAX_IMPORT_URL)
    except AddressRefusedError as error:
        raise _import_error(str(error), "import-address") from None
    async with service.pool.connection() as connection, connection.transaction():
        dataset = await open_dataset(connection, principal, dataset_id)
        if new.path is None:
            uploads.check_takes_archives(dataset)
        else:
            uploads.check_file_name_of(dataset, new.path)

        async def make() -> uuid.UUID:
            await lock_owner(connection, dataset.owner)
            await check_share(connection, service.settings.import_shares(), dataset.owner, "import")
            return (await new_task(service, connection, dataset, "import", new.model_dump())).id

        request = fingerprint("import", str(dataset_id), new.model_dump())
        task_id, _ = await create_once(connection, principal, idempotency_key, request, make)
        task = await get_task(connection, task_id)
    if task is None:
        raise not_found_error("task")
    return task


async def run_import(service: Service, task: DatasetTask) -> TaskOutcome:
    """Fetch what an import asks for; the outcome counts the files.

    Raises:
        ProblemError: 422 for an address that does not answer well.
        IntakeError: the content is refused.
        QuotaExceededError: its owner may not store as much.
        StorageError: it is not as announced, or there is no room.
    """
    new = NewImport.model_validate(task.request)
    owner = Principal(task.owner, frozenset({"write"}), task.id)
    async with _opened(service, owner, new.url) as answer:
        text = answer.headers.get("content-length", "")
        # The length of an encoded body is not that of the file.
        length = int(text) if text.isdigit() and "content-encoding" not in answer.headers else None
        upload = Upload(_body(answer), sha256=new.sha256, size_bytes=length)
        return TaskOutcome(await uploads.store_named(service, owner, task.dataset_id, new.path, upload))


@asynccontextmanager
async def _opened(service: Service, principal: Principal, url: str) -> AsyncIterator[httpx.Response]:
    """Open an address, over redirects that are judged as it is."""
    allowed = service.settings.import_hosts
    location = ""
    async with guarded_client(allowed) as client:
        for _ in range(MAX_REDIRECTS + 1):
            try:
                url = urljoin(url, location)
                request = client.build_request(
                    "GET",
                    check_url(url, allowed, max_length=MAX_IMPORT_URL),
                    headers={"Accept-Encoding": "identity"},
                    extensions={OWNER_EXTENSION: principal.owner},
                )
                # Each read has a limit of its own, which headers that trickle never reach.
                async with asyncio.timeout(HEADER_SECONDS):
                    answer = await client.send(request, stream=True)
            except AddressRefusedError as error:
                raise _import_error(str(error), "import-address") from None
            except (httpx.HTTPError, httpx.InvalidURL, OSError, ValueError) as error:
                raise _import_error(f"The address cannot be reached ({type(error).__name__}).") from None
            try:
                if not answer.has_redirect_location:
                    if answer.status_code != 200:
                        raise _import_error(f"The address answered {answer.status_code}.")
                    yield answer
                    return
                location = answer.headers["location"]
            finally:
                await answer.aclose()
    raise _import_error(f"The address is redirected more than {MAX_REDIRECTS} times.")


async def _body(answer: httpx.Response) -> AsyncIterator[bytes]:
    """Yield what comes; an answer that breaks off leaves nothing."""
    try:
        async for piece in answer.aiter_raw():
            yield piece
    except (httpx.HTTPError, OSError) as error:
        raise _import_error(f"The address broke off ({type(error).__name__}).") from None


def _import_error(detail: str, code: str = "import") -> ProblemError:
    return ProblemError(422, code, detail, errors=[{"pointer": "#/url", "detail": detail}])
