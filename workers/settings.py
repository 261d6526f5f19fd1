"""Settings of all processes that use the database, from the environment; the service adds its own."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Self, TypeVar

from pydantic import AliasChoices, BeforeValidator, Field, InstanceOf, SecretStr, ValidationError
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict, SettingsError

from octasplat.engine.core.errors import ConfigError
from octasplat.workers.data_folder import default_data_folder
from octasplat.workers.postgres.embedded import EmbeddedPostgres
from octasplat.workers.sandbox.job_users import parse_uids
from octasplat.workers.storage.factory import store_folder

PREFIX = "OCTASPLAT_"


def _split_commas(value: object) -> object:
    """Return the parts of a text such as ``a,b`` or ``["a", "b"]``; anything else as it is."""
    if not isinstance(value, str):
        return value
    if value.lstrip().startswith("["):
        return json.loads(value)
    return [part.strip() for part in value.split(",") if part.strip()]


def _parse_uids(value: object) -> object:
    """Return the range of user ids that a text names."""
    return parse_uids(value) if isinstance(value, str) else value


COMMA_SEPARATED = (NoDecode, BeforeValidator(_split_commas))
"""Marks of a setting with several values, which the environment gives with commas or as JSON."""
SettingsT = TypeVar("SettingsT", bound="WorkerSettings")


@dataclass(frozen=True)
class Retention:
    """Retention times in hours; 0 keeps for ever.

    Attributes:
        jobs_hours: finished jobs with their results and checkpoints, from their end.
        jobs_hours_by_kind: the same for single kinds of jobs.
        datasets_hours: committed datasets of which there are no jobs, since they were last used.
        open_datasets_hours: datasets that were not committed, since the last file came.
    """

    jobs_hours: float = 0.0
    jobs_hours_by_kind: Mapping[str, float] = field(default_factory=dict)
    datasets_hours: float = 0.0
    open_datasets_hours: float = 0.0


class WorkerSettings(BaseSettings):
    """Settings of a worker; each can be given as ``OCTASPLAT_<NAME>``.

    Attributes:
        data: folder of the private database, the store and the work under way.
        database_url: a Postgres to use instead of the private one; also ``DATABASE_URL``.
        storage: a folder or ``s3://bucket/prefix``; by default ``store`` in the data folder.
        work: folder for the work under way; by default ``work`` in the data folder.
        floor_bytes: room that a folder's disk keeps free.
        heartbeat_seconds: how often a worker says that it lives.
        stale_seconds: after how long without it its jobs go to others.
        rescue_seconds: how often lost jobs are looked for.
        poll_seconds: how often a worker looks whether its job was cancelled, and for new ones.
        silent_seconds: a job's program that says nothing for so long is killed and tried again.
        grace_seconds: how long a program may take to write its checkpoint when its worker has to stop.
        memory_limit_bytes: a job's program that needs more is stopped; None gives each job of a worker its
            share of the machine's memory, 0 sets no limit.
        max_workspace_bytes: a job whose folder takes more on the worker's disk fails, and one that is sure to
            is not accepted; 0 sets no limit.
        full_disk_seconds: a job that filled a disk itself is tried again after this time, after four times as
            long the second time, and so on.
        recover_seconds: how often a worker that takes no jobs, as its machine ails, looks at it again.
        quota_bytes: contents that an owner may store, unless ``octasplat quota`` says otherwise.
        max_job_hours: a job whose program has run for so long, over all of its attempts, is ended with what
            it has finished; 0 sets no limit.
        absent_queue_hours: a job that waits so long in a queue that no worker takes fails; 0 lets it wait.
        job_uids: user ids, as ``200000-200063``, of which each job runs under one of its own; root only.
        threads: of one job's program; 0 takes all cores.
        pool_size: connections of a front end to the database.
        listen: hear of new jobs at once; False behind a pooler in transaction mode.
        kind_modules: further modules that register kinds of jobs.
        webhook_hosts: hosts of an inner network that webhooks may be sent to, also without TLS.
        keep_jobs_hours: how long finished jobs are kept with their results; 0 keeps them for ever.
        keep_jobs_hours_by_kind: the same for single kinds of jobs, e.g. ``{"render": 24}``.
        keep_datasets_hours: the same for datasets of which there are no jobs any more.
        keep_open_datasets_hours: the same for datasets that were never committed.
        keep_unused_hours: contents of the store that nothing names are removed after this time; at once, but
            for what is being stored, where room is short.
        keep_audit_hours: how long it is kept who asked for what; 0 keeps it for ever.
        collect_seconds: how often they are looked for.
    """

    model_config = SettingsConfigDict(env_prefix=PREFIX, extra="ignore", frozen=True)

    data: Path = Field(default_factory=default_data_folder)
    database_url: SecretStr | None = Field(
        None, validation_alias=AliasChoices("database_url", f"{PREFIX}DATABASE_URL", "DATABASE_URL")
    )
    storage: str | None = None
    work: Path | None = None
    floor_bytes: int = Field(2 << 30, ge=0)
    heartbeat_seconds: float = Field(5.0, gt=0)
    stale_seconds: float = Field(20.0, gt=0)
    rescue_seconds: float = Field(3.0, gt=0)
    poll_seconds: float = Field(1.0, gt=0)
    silent_seconds: float = Field(600.0, gt=0)
    grace_seconds: float = Field(30.0, gt=0)
    memory_limit_bytes: int | None = Field(None, ge=0)
    max_workspace_bytes: int = Field(64 << 30, ge=0)
    full_disk_seconds: float = Field(60.0, ge=0)
    recover_seconds: float = Field(30.0, gt=0)
    quota_bytes: int | None = Field(None, ge=0)
    max_job_hours: float = Field(48.0, ge=0)
    absent_queue_hours: float = Field(72.0, ge=0)
    job_uids: Annotated[InstanceOf[range] | None, NoDecode, BeforeValidator(_parse_uids)] = None
    threads: int = Field(0, ge=0)
    pool_size: int = Field(12, gt=1)
    listen: bool = True
    kind_modules: Annotated[tuple[str, ...], *COMMA_SEPARATED] = ()
    webhook_hosts: Annotated[tuple[str, ...], *COMMA_SEPARATED] = ()
    keep_jobs_hours: float = Field(0.0, ge=0)
    keep_jobs_hours_by_kind: dict[str, Annotated[float, Field(ge=0)]] = {}
    keep_datasets_hours: float = Field(0.0, ge=0)
    keep_open_datasets_hours: float = Field(720.0, ge=0)
    keep_unused_hours: float = Field(24.0, gt=0)
    keep_audit_hours: float = Field(8760.0, ge=0)
    collect_seconds: float = Field(3600.0, gt=0)

    @property
    def storage_address(self) -> str:
        """Return the address for :func:`octasplat.workers.storage.factory.open_storage`."""
        return self.storage or str(self.data.absolute() / "store")

    @property
    def work_folder(self) -> Path:
        """Return the folder for work in progress."""
        return (self.work or self.data / "work").absolute()

    @property
    def own_folders(self) -> tuple[Path, ...]:
        """Return the folders that only the service may open: its data, its storage and its work."""
        store = store_folder(self.storage_address)
        return (self.data.absolute(), self.work_folder, *(() if store is None else (store,)))

    @property
    def retention(self) -> Retention:
        """Return the retention times."""
        return Retention(
            jobs_hours=self.keep_jobs_hours,
            jobs_hours_by_kind=self.keep_jobs_hours_by_kind,
            datasets_hours=self.keep_datasets_hours,
            open_datasets_hours=self.keep_open_datasets_hours,
        )

    def conninfo(self) -> str:
        """Return how to connect to the database.

        Raises:
            DatabaseError: no address was given and no private database was started.
        """
        if self.database_url is not None:
            return self.database_url.get_secret_value()
        return EmbeddedPostgres(self.data.absolute()).conninfo()

    def checked(self) -> Self:
        """Return the settings if they are consistent; raise otherwise.

        Raises:
            ConfigError: they do not.
        """
        if self.stale_seconds < 2 * self.heartbeat_seconds:
            raise ConfigError(
                f"{PREFIX}STALE_SECONDS is {self.stale_seconds:g}, which must be at least twice "
                f"{PREFIX}HEARTBEAT_SECONDS ({self.heartbeat_seconds:g}), or jobs "
                "would be taken from live workers."
            )
        return self


def worker_connections(queues: Mapping[str, int]) -> int:
    """Return the most connections of a worker that takes so many jobs at once from these queues."""
    return 6 + 4 * sum(queues.values())


def load_settings(model: type[SettingsT], *, data: Path | None = None, **changes: object) -> SettingsT:
    """Return settings from the environment, with what a command line says on top.

    Args:
        model: which settings.
        data: the data folder, or None for what the environment says.
        changes: further values; None leaves a setting as it is.

    Raises:
        ConfigError: a value cannot be used.
    """
    given = {name: value for name, value in {"data": data, **changes}.items() if value is not None}
    try:
        settings = model()
        # Validated again, as a copy alone would not be.
        return model.model_validate({**settings.model_dump(), **given}) if given else settings
    except SettingsError as error:  # JSON that is none
        raise ConfigError(
            f"A setting of the environment cannot be read ({error}); write it as JSON."
        ) from None
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{PREFIX}{name.upper()}: {first['msg']} (it is {first.get('input')!r}).") from None
