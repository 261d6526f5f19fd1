"""Settings of the front end, which extend those of the workers."""

import ipaddress
import math
import re
from dataclasses import dataclass
from typing import Annotated, Self

from pydantic import Field, IPvAnyNetwork, SecretStr

from octasplat.engine.core.errors import ConfigError
from octasplat.service.connection_limits import ConnectionLimits, connections_for
from octasplat.service.intake.dataset import DatasetLimits
from octasplat.service.intake.mesh_check import MeshLimits
from octasplat.service.intake.model_check import ModelLimits
from octasplat.service.intake.receive import UploadLimits
from octasplat.service.intake.spool import SpoolSpace
from octasplat.service.proxy_headers import HeaderStyle
from octasplat.workers.db.quotas import Quota
from octasplat.workers.settings import COMMA_SEPARATED, PREFIX, WorkerSettings
from octasplat.workers.worker.job_kinds.resource_limits import LIMIT_UNITS

DEFAULT_PORT = 8642
MIN_TOKEN_BITS = 128
MAX_UPLOADS = 50
"""Uploads of an owner that may be under way in parts."""
MAX_WAIT_SECONDS = 50
"""An answer waits no longer for a task, as usual proxies give up after 60 s."""
_BODY_SECONDS = 90.0
"""Longer than an upload may be silent, which is answered with a problem."""
# Characters that a secret may be made of, and how many they are; the first pattern that fits counts.
_ALPHABETS = (("[0-9]*", 10), ("[0-9a-f]*|[0-9A-F]*", 16), ("[0-9a-z]*|[0-9A-Z]*", 36))
_MIN_DISTINCT_CHARACTERS = 8
"""A text of fewer is none that was drawn at random."""


@dataclass(frozen=True)
class TaskShares:
    """How many tasks of a kind there may be.

    Attributes:
        max_running: that one front end works on at once.
        max_running_per_owner: that all work on at once for one owner.
        max_unfinished: that wait or are worked on.
        max_unfinished_per_owner: of those of one owner.
        crowded_from: with so many under way each further one is of an owner who has none, so that a few
            owners, whatever they ask of slow addresses, do not hold all.
    """

    max_running: int
    max_running_per_owner: int
    max_unfinished: int
    max_unfinished_per_owner: int
    crowded_from: int | None = None

    def per_owner(self, running: int) -> int:
        """Return how many of one owner may be under way where so many of all are."""
        is_crowded = self.crowded_from is not None and running >= self.crowded_from
        return 1 if is_crowded else self.max_running_per_owner


class ServiceSettings(WorkerSettings):
    """Settings of the front end; each can be given as ``OCTASPLAT_<NAME>``.

    Attributes:
        host: address to listen at.
        port: port to listen at; 0 takes a free one.
        token: a token of 128 random bits or more that lets its owner do everything; any other is made with
            ``octasplat token``. Another one here shuts out the one that was here before.
        token_hours: for how long a new token is valid unless its maker says otherwise; 0 is for ever.
        session_hours: for how long a browser stays signed in.
        wrong_token_seconds: how long the first wrong token of an address waits for its answer; each further
            one half as long again.
        proxies: addresses or networks of proxies whose word is taken for where a request comes from and
            whether it came by TLS, e.g. ``["10.0.0.1", "fd00::/8"]``.
        proxy_headers: how they say so: ``x-forwarded`` (``X-Forwarded-For``, ``-Proto`` and ``-Host``) or
            ``forwarded`` (RFC 7239). The proxy must set or remove what clients send of them.
        allowed_hosts: further names under which the service is reached while it listens at this machine only.
        max_upload_bytes: length of one uploaded file.
        max_archive_bytes: length of an uploaded archive.
        max_spool_bytes: what has come of all archives that are being read, on this machine's disk.
        spool_share: the part of them that one owner may take.
        max_checks: datasets that are checked at once.
        max_waiting_checks: datasets that wait to be checked; further commits are refused, those of one owner
            from half of all on.
        commit_wait_seconds: how long the answer to a commit waits for its end unless the request says
            otherwise.
        max_body_bytes: length of any other request.
        quota_datasets: datasets that an owner may have.
        quota_jobs: jobs of an owner that may be queued or running.
        max_iterations: ceiling of the iterations of a training, of each block in blocks; where they are not
            named, photographs that are mostly transparent or masked take up to twice as many as is reckoned
            with.
        max_gaussians: ceiling of the Gaussians that a training may come to; a scene in blocks may come to so
            many in each block, unless its options name a number for the whole.
        max_rays: ceiling of the rays of one iteration.
        max_side_px: ceiling of the longer side that photographs may be asked for.
        max_exports: ceiling of the files that one job writes in formats of its own.
        max_render_pixels: ceiling of the pixels of all images of a render together.
        max_render_paths: ceiling of the pixels of all images of a stage together times the samples of each.
        max_priority: highest priority that whoever is no administrator may give.
        ping_seconds: how often a quiet stream of events gives a sign of life.
        max_streams: streams of events at once.
        max_streams_per_owner: of those of one owner.
        max_streams_per_address: of those of one address; of IPv6, 64 bits count as one.
        max_connections: connections at once; fewer where the process may open few files. Where all are taken,
            a new one replaces the one that has waited longest for a request.
        max_connections_per_address: the same of one address; those of ``proxies`` may have all.
        import_hosts: hosts of an inner network that files may be imported from, also without TLS.
        header_seconds: how long the headers of a request may take.
        reader_seconds: how long a client may take to read 64 KiB of an answer.
    """

    host: str = "127.0.0.1"
    port: int = Field(DEFAULT_PORT, ge=0, le=65535)
    token: SecretStr | None = None
    token_hours: float = Field(0.0, ge=0)
    session_hours: float = Field(168.0, gt=0)
    wrong_token_seconds: float = Field(0.25, ge=0)
    proxies: Annotated[tuple[IPvAnyNetwork, ...], *COMMA_SEPARATED] = ()
    proxy_headers: HeaderStyle = "x-forwarded"
    allowed_hosts: Annotated[tuple[str, ...], *COMMA_SEPARATED] = ()
    max_upload_bytes: int = Field(4 << 30, gt=0)
    max_archive_bytes: int = Field(64 << 30, gt=0)
    max_spool_bytes: int = Field(128 << 30, gt=0)
    spool_share: float = Field(0.5, gt=0, le=1)
    max_checks: int = Field(2, gt=0)
    max_waiting_checks: int = Field(24, ge=0)
    commit_wait_seconds: float = Field(20.0, ge=0, le=MAX_WAIT_SECONDS)
    max_body_bytes: int = Field(1 << 20, gt=0)
    quota_datasets: int | None = Field(None, ge=0)
    quota_jobs: int | None = Field(None, ge=0)
    max_iterations: int = Field(100_000, ge=1)
    max_gaussians: int = Field(5_000_000, ge=1)
    max_rays: int = Field(1 << 20, ge=1)
    max_side_px: int = Field(16_384, ge=16)
    max_exports: int = Field(20, ge=1)
    max_render_pixels: int = Field(4_000_000_000, ge=1)
    max_render_paths: int = Field(40_000_000_000, ge=1)
    max_priority: int = Field(10, ge=-100, le=100)
    ping_seconds: float = Field(15.0, gt=0)
    max_streams: int = Field(500, gt=0)
    max_streams_per_owner: int = Field(100, gt=0)
    max_streams_per_address: int = Field(200, gt=0)
    max_connections: int = Field(4096, gt=0)
    max_connections_per_address: int = Field(1024, gt=0)
    import_hosts: Annotated[tuple[str, ...], *COMMA_SEPARATED] = ()
    header_seconds: float = Field(20.0, gt=0)
    reader_seconds: float = Field(120.0, gt=0)

    @property
    def is_private(self) -> bool:
        """Return whether the service can be reached from this machine only."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def quota(self) -> Quota:
        """Return the default quota of an owner."""
        return Quota(self.quota_bytes, self.quota_datasets, self.quota_jobs)

    @property
    def ceilings(self) -> dict[str, int]:
        """Return the limits of jobs, by the names in ``LIMIT_UNITS``."""
        found = {name: getattr(self, f"max_{name}") for name in LIMIT_UNITS}
        # 0 sets no limit.
        return found if self.max_workspace_bytes else {**found, "workspace_bytes": 1 << 62}

    def upload_limits(self) -> UploadLimits:
        """Return the limits of uploads."""
        return UploadLimits(max_file_bytes=self.max_upload_bytes, max_archive_bytes=self.max_archive_bytes)

    def check_shares(self) -> TaskShares:
        """Return how many commits there may be; half of the places are reserved for other owners."""
        places = self.max_checks + self.max_waiting_checks
        return TaskShares(self.max_checks, places, places, -(-places // 2))

    def import_shares(self) -> TaskShares:
        """Return how many imports there may be: connections, not work."""
        return TaskShares(
            max_running=32,
            max_running_per_owner=4,
            max_unfinished=128,
            max_unfinished_per_owner=16,
            crowded_from=16,
        )

    def upload_shares(self) -> TaskShares:
        """Return how many uploads that came in parts are stored at once: copies within the store."""
        return TaskShares(
            max_running=3, max_running_per_owner=2, max_unfinished=1000, max_unfinished_per_owner=MAX_UPLOADS
        )

    def connection_limits(self, open_files: int) -> ConnectionLimits:
        """Return the limits of connections for a process that may have so many open files."""
        return ConnectionLimits(
            max_connections=min(self.max_connections, connections_for(open_files)),
            max_per_address=min(self.max_connections_per_address, connections_for(open_files)),
            header_seconds=self.header_seconds,
            body_seconds=_BODY_SECONDS,
            reader_seconds=self.reader_seconds,
            proxies=self.proxies,
        )

    def dataset_limits(self) -> DatasetLimits:
        """Return the limits of the validation of datasets."""
        return DatasetLimits(model=ModelLimits(hidden=self.own_folders))

    def mesh_limits(self) -> MeshLimits:
        """Return the limits of the check of meshes before a job is queued."""
        return MeshLimits(hidden=self.own_folders)

    def spool(self) -> SpoolSpace:
        """Return the spool folder for uploaded archives, with its limits."""
        folder = self.work_folder / "archives"
        return SpoolSpace(
            folder,
            max_bytes=self.max_spool_bytes,
            owner_share=self.spool_share,
            floor_bytes=self.floor_bytes,
        )

    def checked(self) -> Self:
        """Return the settings if they are consistent; raise otherwise.

        Raises:
            ConfigError: they do not fit together, or the token can be guessed.
        """
        super().checked()
        if self.token is not None and secret_bits(self.token.get_secret_value()) < MIN_TOKEN_BITS:
            raise ConfigError(
                f"{PREFIX}TOKEN has less than {MIN_TOKEN_BITS} bits, so it could be guessed; take a long "
                "random text, such as openssl rand -hex 24 prints."
            )
        return self


def secret_bits(secret: str) -> float:
    """Return how many bits a random text of this length and these kinds of characters has at most."""
    if len(set(secret)) < _MIN_DISTINCT_CHARACTERS:
        return 0.0
    for pattern, alphabet in _ALPHABETS:
        if re.fullmatch(pattern, secret):
            return len(secret) * math.log2(alphabet)
    # Any other text is taken for base64.
    return len(secret) * math.log2(64)
