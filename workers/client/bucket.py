"""Photographs in a bucket that speaks S3: the service fetches them, and they do not pass this machine.

The credentials stay here. The service is given an address of each file that holds for some hours.
"""

import hashlib
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import parse_qs

from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.engine.core.scene_layout import is_ignored_file
from octasplat.workers.client.api import Api, ServiceError
from octasplat.workers.client.dataset_files import ProgressCounter, keep_files
from octasplat.workers.client.dataset_tasks import (
    create_dataset_once,
    fill_and_commit,
    import_dataset,
    wait_for_task,
)
from octasplat.workers.client.upload import preview_files

if TYPE_CHECKING:
    from mypy_boto3_s3 import S3Client

ADDRESS_SECONDS = 6 * 3600
"""For so long the service may fetch a file; it begins as soon as it has a place."""
AddressingStyle = Literal["auto", "virtual", "path"]
PARALLEL_IMPORTS = 8
"""A service fetches four at once for an owner, and lets sixteen wait."""


def is_bucket_address(scene: object) -> bool:
    """Return whether a scene is named as a place in a bucket."""
    return isinstance(scene, str) and scene.startswith("s3://")


@dataclass(frozen=True)
class BucketObject:
    """An object of a bucket: its key, length, and what changes with its content."""

    key: str
    size_bytes: int
    etag: str


class Bucket:
    """A place in a bucket.

    Args:
        address: ``s3://bucket/prefix``, with ``?endpoint_url=https://...`` for one that is not Amazon's.

    Raises:
        ConfigError: the address cannot be understood, or boto3 is not installed.
    """

    def __init__(self, address: str) -> None:
        # Names of objects may hold what ends the path of a web address, as in scan#2.
        place, mark, query = address.removeprefix("s3://").partition("?")
        self.name, _, path = place.partition("/")
        if not self.name or "@" in self.name:
            raise ConfigError("s3://... is no bucket; write s3://bucket/prefix.")
        settings = parse_qs(query, keep_blank_values=True)
        if mark and settings.keys() != {"endpoint_url"}:
            raise ConfigError(
                "Only ?endpoint_url=https://... may follow a bucket and its folder; a folder with a question "
                "mark in its name cannot be named."
            )
        self.path = path.strip("/")
        try:
            import boto3  # noqa: F401 - here, as many have no bucket
        except ModuleNotFoundError:
            raise ConfigError("A bucket needs boto3; install it with: pip install boto3") from None
        endpoint = settings["endpoint_url"][0] if mark else None
        self._client = self._open_client(endpoint_url=endpoint)
        self._signer = self._client

    def _open_client(
        self, *, endpoint_url: str | None = None, region: str | None = None, style: AddressingStyle = "auto"
    ) -> "S3Client":
        import boto3
        from botocore.config import Config

        with self._translate_errors():
            return boto3.client(
                "s3",
                endpoint_url=endpoint_url,
                region_name=region,
                config=Config(
                    # Other signatures are refused by buckets of newer regions.
                    signature_version="s3v4",
                    s3={"addressing_style": style},
                    retries={"max_attempts": 5, "mode": "standard"},
                ),
            )

    def _sign_for_region(self) -> None:
        """Sign addresses for the region of the bucket, if Amazon holds it; others are refused.

        Requests of boto3 itself are sent again where they have to go, but not what others do with an address.
        """
        from botocore.exceptions import ClientError

        if ".amazonaws.com" not in self._client.meta.endpoint_url:
            return
        with self._translate_errors():
            try:
                headers = self._client.head_bucket(Bucket=self.name)["ResponseMetadata"]["HTTPHeaders"]
            except ClientError as error:  # it tells this also for want of a right
                headers = error.response["ResponseMetadata"]["HTTPHeaders"]
        region = headers.get("x-amz-bucket-region")
        # By its own name, which leads to the region at once; certificates do not cover names with dots.
        style: AddressingStyle = "path" if "." in self.name else "virtual"
        self._signer = self._open_client(region=region or self._client.meta.region_name, style=style)

    def close(self) -> None:
        """Close the HTTP connections."""
        self._client.close()
        self._signer.close()

    @property
    def place(self) -> str:
        """Return the address without that of the store."""
        return f"s3://{self.name}/{self.path}"

    def find_file(self, key: str) -> BucketObject:
        """Return the object of that key.

        Raises:
            ConfigError: it is not there, or cannot be read.
        """
        with self._translate_errors():
            facts = self._client.head_object(Bucket=self.name, Key=key)
        self._sign_for_region()
        return BucketObject(key, facts["ContentLength"], facts["ETag"])

    def list_files(self) -> dict[str, BucketObject]:
        """Return the objects below the path by their names there, but for those that are no files.

        Raises:
            ConfigError: the bucket cannot be read.
        """
        prefix = f"{self.path}/" if self.path else ""
        found = {}
        with self._translate_errors():
            for page in self._client.get_paginator("list_objects_v2").paginate(
                Bucket=self.name, Prefix=prefix
            ):
                for item in page.get("Contents", ()):
                    path = item["Key"].removeprefix(prefix)
                    if path and not path.endswith("/") and not is_ignored_file(path):
                        found[path] = BucketObject(item["Key"], item["Size"], item["ETag"])
        self._sign_for_region()
        return found

    def file_address(self, key: str) -> str:
        """Return an https address of an object that was found, which holds for some hours.

        Raises:
            ConfigError: there are no credentials.
        """
        with self._translate_errors():
            return self._signer.generate_presigned_url(
                "get_object", Params={"Bucket": self.name, "Key": key}, ExpiresIn=ADDRESS_SECONDS
            )

    @contextmanager
    def _translate_errors(self) -> Iterator[None]:
        from botocore.exceptions import BotoCoreError, ClientError

        try:
            yield
        except ClientError as error:
            code = error.response.get("Error", {}).get("Code", "")
            raise ConfigError(
                f"The bucket {self.name} cannot be read ({code}); check its name and the credentials."
            ) from error
        except (BotoCoreError, ValueError) as error:
            raise ConfigError(
                f"The bucket {self.name} cannot be reached ({type(error).__name__}); check the credentials "
                "and the address of the store."
            ) from error


def import_bucket(
    api: Api,
    address: str,
    *,
    sha256: str | None = None,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
    on_warning: Callable[[str], None] = lambda _sentence: None,
) -> dict[str, Any]:
    """Let the service fetch a scene out of a bucket, and commit it; the same call goes on where it was.

    Args:
        api: the service.
        address: of a folder with ``images/``, a bare folder of photographs, or a ZIP file.
        sha256: what the ZIP file must be.
        progress: called with (bytes done, total).
        on_warning: called with a sentence on which files are left out, before anything is fetched.

    Returns:
        The dataset.

    Raises:
        ConfigError: the bucket cannot be read.
        DatasetError: the service would refuse the scene.
        ServiceError: the service refuses it, or cannot fetch a file; the text names it.
    """
    bucket = Bucket(address)
    try:
        name = PurePosixPath(bucket.path).stem or bucket.name
        if PurePosixPath(bucket.path).suffix.lower() == ".zip":
            file = bucket.find_file(bucket.path)
            # The address of the same file is another one each time that it is signed.
            version = f"{bucket.place}\n{file.size_bytes}\n{file.etag}"
            url = bucket.file_address(file.key)
            return import_dataset(api, url, name=name, sha256=sha256, version=version)
        if sha256 is not None:
            raise ConfigError("A digest goes with a ZIP file, not with a folder of a bucket.")
        return _import_folder(api, bucket, name, progress, on_warning)
    finally:
        bucket.close()


def _import_folder(
    api: Api,
    bucket: Bucket,
    name: str,
    progress: Callable[[int, int], None],
    on_warning: Callable[[str], None],
) -> dict[str, Any]:
    place = bucket.place
    objects = bucket.list_files()
    if not objects:
        raise DatasetError(f"{place} holds no files; name the folder that holds images/.")
    listed = [{"path": path, "size_bytes": item.size_bytes} for path, item in objects.items()]
    taken = preview_files(api, place, listed, on_warning)
    files = {file["name"]: objects[file["path"]] for file in taken}
    digest = hashlib.sha256(f"{place}\n{name}\n".encode())
    for path, item in files.items():
        digest.update(f"{path}\0{item.size_bytes}\0{item.etag}\n".encode())
    dataset = create_dataset_once(api, {"name": name[:200]}, f"bucket-{digest.hexdigest()}")
    return fill_and_commit(api, dataset, lambda: _fetch_files(api, dataset["id"], bucket, files, progress))


def _fetch_files(
    api: Api,
    dataset_id: str,
    bucket: Bucket,
    files: dict[str, BucketObject],
    progress: Callable[[int, int], None],
) -> None:
    """Let the service fetch those files that the dataset lacks."""
    there = keep_files(api, dataset_id, files.keys())
    counter = ProgressCounter(sum(item.size_bytes for item in files.values()), progress)

    def fetch(path: str) -> None:
        if path not in there:
            body = {"url": bucket.file_address(files[path].key), "path": path}
            try:
                wait_for_task(api, api.post(f"/v1/datasets/{dataset_id}/import", body))
            except ServiceError as error:
                raise ServiceError(f"{path}: {error}", error.status, error.errors) from None
        counter.add(files[path].size_bytes)

    with ThreadPoolExecutor(PARALLEL_IMPORTS) as pool:
        jobs = [pool.submit(fetch, path) for path in files]
        try:
            done, _ = wait(jobs, return_when=FIRST_EXCEPTION)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    for job in done:
        job.result()
