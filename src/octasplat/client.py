"""A service from Python: photographs sent, jobs queued and followed, results saved. Needs no engine."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, cast

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.events import EventListener
from octasplat.notebook import default_progress, table_html
from octasplat.paths import PathLike
from octasplat.workers.client import submission
from octasplat.workers.client.api import Api, ServiceError, ServiceUnreachableError, find_address, find_token
from octasplat.workers.client.bucket import is_bucket_address
from octasplat.workers.client.dataset_tasks import import_dataset, is_web_address
from octasplat.workers.client.submission import Derivation, JobFailedError, Submission

JobState = Literal["queued", "running", "canceling", "succeeded", "failed", "canceled"]

__all__ = ["Client", "Job", "JobFailedError", "JobState", "Result", "ServiceError", "ServiceUnreachableError"]


@dataclass(frozen=True)
class Result:
    """A file that a job has made: its name in the job's folder and its size."""

    name: str
    size_bytes: int


class Client:
    """A service, such as ``octasplat serve`` runs.

    Args:
        url: where it is; by default as ``OCTASPLAT_SERVER`` says, or that of this machine.
        token: what to show it; by default as ``OCTASPLAT_TOKEN`` says, or that of this machine's service.

    >>> import octasplat as osp
    >>> with osp.Client(url, token) as client:
    ...     job = client.submit("photos/", preset="fast", train={"iterations": 50}, label="a trial")
    ...     files = job.wait().download("downloaded/")
    >>> job.state
    'succeeded'
    >>> osp.Run("downloaded/").psnr > 10
    True
    """

    def __init__(self, url: str | None = None, token: str | None = None) -> None:
        address = url or find_address(os.environ)
        self._api = Api(address, token or find_token(os.environ, address))

    def __enter__(self) -> "Client":
        self._api.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections; jobs go on."""
        self._api.close()

    @property
    def url(self) -> str:
        """Return the address of the service."""
        return self._api.address

    def submit(
        self,
        photographs: PathLike | None = None,
        *,
        start_from: "Job | str | None" = None,
        label: str | None = None,
        queue: str = "cpu",
        priority: int = 0,
        progress: EventListener | None = None,
        **options: Any,
    ) -> "Job":
        """Upload photographs and queue their reconstruction; uploaded photographs are not sent again.

        Args:
            photographs: a folder, a ZIP file, the id of a dataset, or what the service fetches: the https
                address of a ZIP file, or ``s3://bucket/folder``; None takes those of ``start_from``.
            start_from: a reconstruction, finished or stopped, or its id: with its Gaussians the new one
                begins.
            label: what to call the job.
            queue: which workers.
            priority: higher goes first.
            progress: told the events of the upload; by default they are logged, or shown in a notebook.
            options: of the reconstruction, as ``GET /v1/options/reconstruct`` lists them.

        Raises:
            DatasetError: there are no photographs.
            ServiceError: the service refuses the photographs or the options.
            ServiceUnreachableError: nobody answers.
        """
        scene = None if photographs is None else _scene(photographs)
        source = start_from.id if isinstance(start_from, Job) else start_from
        what = Submission(scene, options, label, queue, priority, start_from=source)
        return Job(self._api, submission.submit(self._api, what, progress or default_progress()))

    def derive(
        self,
        source: "Job | str | None",
        kind: str,
        *,
        files: Mapping[str, PathLike] | Sequence[PathLike] = (),
        photographs: PathLike | None = None,
        label: str | None = None,
        queue: str = "cpu",
        priority: int = 0,
        progress: EventListener | None = None,
        **options: Any,
    ) -> "Job":
        """Queue a job on the results of a finished one, such as a render, or on files alone.

        Args:
            source: the finished job, or its id; None for kinds that work on files alone, such as import.
            kind: of the new one; ``GET /v1/options`` lists them.
            files: files that the options name, by these names, or by their own.
            photographs: to work on in the place of the job's, as for :meth:`submit`.
            label: what to call the job.
            queue: which workers.
            priority: higher goes first.
            progress: as for :meth:`submit`.
            options: of the kind.

        Raises:
            ConfigError: two files have one name, or one is not there.
            ServiceError: the service refuses something.
            ServiceUnreachableError: nobody answers.
        """
        named = files if isinstance(files, Mapping) else {Path(path).name: path for path in files}
        if len(named) < len(files):
            raise ConfigError(
                "Two of the files have one name; give them as a mapping with names that differ."
            )
        what = Derivation(
            source.id if isinstance(source, Job) else source,
            kind,
            options,
            {name: Path(path) for name, path in named.items()},
            None if photographs is None else _scene(photographs),
            label,
            queue,
            priority,
        )
        return Job(self._api, submission.derive(self._api, what, progress or default_progress()))

    def import_dataset(self, url: str, *, name: str | None = None, sha256: str | None = None) -> str:
        """Let the service fetch photographs, and return the id of their dataset, which :meth:`submit` takes.

        Args:
            url: address of a ZIP file; https, and reachable from everywhere.
            name: what to call the dataset; by default as the file.
            sha256: what the ZIP file must be; then the same call again makes no second dataset.

        Raises:
            ServiceError: the address does not answer well, or the service refuses the photographs.
            ServiceUnreachableError: the service was away for two minutes.
        """
        return str(import_dataset(self._api, url, name=name, sha256=sha256)["id"])

    def job(self, job_id: str) -> "Job":
        """Return the job with an id.

        Raises:
            ServiceError: there is none.
        """
        return Job(self._api, self._api.get(f"/v1/jobs/{job_id}"))

    def jobs(self) -> Iterator["Job"]:
        """Yield all jobs, the newest first."""
        return (Job(self._api, content) for content in self._api.iterate_pages("/v1/jobs", "jobs"))

    def usage(self) -> Mapping[str, Any]:
        """Return what you have stored and asked for, how much you may, and the time that your jobs took."""
        return cast("Mapping[str, Any]", self._api.get("/v1/usage"))

    def __repr__(self) -> str:
        return f"Client({self.url!r})"


def _scene(photographs: PathLike) -> Path | str:
    """Return an address as text, anything else as a path."""
    is_address = is_web_address(photographs) or is_bucket_address(photographs)
    return str(photographs) if is_address else Path(photographs)


class Job:
    """A job of a service; what is known of it is what the last request told, see :meth:`refresh`."""

    def __init__(self, api: Api, content: Mapping[str, Any]) -> None:
        """Take over what the service says; :meth:`Client.job` returns the job with an id."""
        self._api = api
        self.content = content

    @property
    def id(self) -> str:
        """Return the id of the job."""
        return str(self.content["id"])

    @property
    def kind(self) -> str:
        """Return the kind, such as ``reconstruct``."""
        return str(self.content["kind"])

    @property
    def label(self) -> str | None:
        """Return the label of the job; None if it has none."""
        return cast("str | None", self.content["label"])

    @property
    def state(self) -> JobState:
        """Return the state at the last request."""
        return cast(JobState, self.content["state"])

    @property
    def psnr(self) -> float | None:
        """Return the PSNR of the held-out views in dB; None until it is known."""
        return cast("float | None", self.content.get("psnr"))

    @property
    def error(self) -> str | None:
        """Return the message of the error with which the job failed; None if it did not fail."""
        error = self.content.get("error")
        return None if error is None else str(error["message"])

    @property
    def options(self) -> Mapping[str, Any]:
        """Return all options of the job, which are requested for one out of a list."""
        if "options" not in self.content:
            self.refresh()
        return cast("Mapping[str, Any]", self.content["options"])

    def refresh(self) -> "Job":
        """Request the job's present state, and return the job itself."""
        self.content = self._api.get(f"/v1/jobs/{self.id}")
        return self

    def wait(
        self, *, progress: EventListener | None = None, on_note: Callable[[str], None] = lambda _note: None
    ) -> "Job":
        """Wait until the job is over, and return the job itself.

        Args:
            progress: told the events of the job; by default they are logged, or shown in a notebook.
            on_note: told in a sentence when another worker takes the job over.

        Raises:
            JobFailedError: it failed or was cancelled.
            ServiceUnreachableError: the service was away for two minutes.
        """
        try:
            self.content = submission.wait_for_job(
                self._api, self.id, progress or default_progress(), on_note
            )
        except JobFailedError:
            # Whoever catches the error can ask the job for its state and message.
            self.refresh()
            raise
        return self

    def cancel(self) -> "Job":
        """Stop the job, which keeps its last checkpoint; returns the job itself."""
        self.content = self._api.post(f"/v1/jobs/{self.id}/cancel")
        return self

    def retry(self, *, from_start: bool = False, **options: Any) -> "Job":
        """Queue a job that failed or was cancelled again; returns the job itself.

        Args:
            from_start: begin anew, rather than at the last checkpoint.
            options: in the place of the job's own.

        Raises:
            ServiceError: it is not over, or an option cannot change.
        """
        body = {"from": "start" if from_start else "checkpoint", "options": options}
        self.content = self._api.post(f"/v1/jobs/{self.id}/retry", body)
        return self

    def results(self) -> tuple[Result, ...]:
        """Return the files that the job has made."""
        found = self._api.get(f"/v1/jobs/{self.id}/artifacts")["artifacts"]
        return tuple(Result(artifact["name"], artifact["size_bytes"]) for artifact in found)

    def download(
        self, folder: PathLike, *names: str, progress: EventListener | None = None
    ) -> tuple[Path, ...]:
        """Save the results in a folder and return the files; files that are there are not sent again.

        Args:
            folder: where to.
            names: only these results.
            progress: told the events of the download; by default they are logged, or shown in a notebook.

        Raises:
            ServiceError: there are no such results.
            OutputError: a file cannot be written.
        """
        return submission.download_job(
            self._api, self.id, Path(folder), names, progress or default_progress()
        )

    def download_archive(self, path: PathLike, *, progress: EventListener | None = None) -> Path:
        """Save all results as one ZIP file, which replaces a file of that name, and return it.

        Args:
            path: the ZIP file.
            progress: told the events of the download; by default they are logged, or shown in a notebook.

        Raises:
            ServiceError: there are no results.
            OutputError: the file cannot be written.
        """
        return submission.download_job_archive(self._api, self.id, Path(path), progress or default_progress())

    def __repr__(self) -> str:
        return f"Job({self.id!r}, {self.kind}, {self.state})"

    def _repr_html_(self) -> str:
        facts = {"kind": self.kind, "label": self.label, "state": self.state, "psnr": self.psnr}
        facts["error"] = self.error
        return table_html(
            f"Job {self.id}", {name: value for name, value in facts.items() if value is not None}
        )
