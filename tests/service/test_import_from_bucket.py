"""A scene in a bucket, which the service fetches by addresses that hold for some hours."""

import io
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import boto3
import psycopg
import pytest
from botocore.awsrequest import AWSRequest, AWSResponse
from click.testing import CliRunner

import octasplat as osp
from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.workers.cli.main import cli
from octasplat.workers.client.api import Api, ServiceError
from octasplat.workers.client.bucket import Bucket, import_bucket
from tests.support.front_end import FrontEnd
from tests.support.model_builder import ColmapModelBuilder, photograph, photographs
from tests.support.zip_builder import ZipMember, build_zip

SCENE = {**photographs(), **ColmapModelBuilder().files()}


@pytest.fixture
def place(s3_address: str, s3_bucket: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """Address of a scene in a bucket, with a file beside that is no part of one."""
    monkeypatch.setenv("AWS_ENDPOINT_URL_S3", s3_address)
    client = boto3.client("s3")
    for name, content in {**SCENE, "notes.md": b"x", "images/.DS_Store": b"x"}.items():
        client.put_object(Bucket=s3_bucket, Key=f"captures/fox/{name}", Body=content)
    archive = build_zip(*(ZipMember(name, content) for name, content in SCENE.items()))
    client.put_object(Bucket=s3_bucket, Key="captures/archive.zip", Body=archive)
    client.put_object(Bucket=s3_bucket, Key="captures/foxes/images/a.png", Body=photograph())
    client.close()
    return f"s3://{s3_bucket}/captures/fox"


@pytest.fixture
def front(conninfo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FrontEnd]:
    with FrontEnd(conninfo, tmp_path / "data", OCTASPLAT_IMPORT_HOSTS="127.0.0.1") as started:
        monkeypatch.setenv("OCTASPLAT_SERVER", started.address)
        monkeypatch.setenv("OCTASPLAT_TOKEN", started.token)
        yield started


def tasks(conninfo: str) -> int:
    with psycopg.connect(conninfo) as connection:
        row = connection.execute("SELECT count(*) FROM dataset_tasks WHERE kind = 'import'").fetchone()
    assert row is not None
    return int(row[0])


def test_folder_of_a_bucket_is_fetched_checked_and_queued(front: FrontEnd, place: str, conninfo: str) -> None:
    told = CliRunner().invoke(cli, ["submit", place, "--preset", "fast", "--json"])
    assert told.exit_code == 0, told.output
    assert "left out (notes.md)" in told.stderr
    with Api(front.address, front.token) as api:
        dataset = api.get(f"/v1/datasets/{json.loads(told.stdout)['dataset_id']}")
        assert (dataset["name"], dataset["state"], dataset["has_poses"]) == ("fox", "committed", True)
        files = api.get(f"/v1/datasets/{dataset['id']}/files")["files"]
        assert [file["path"] for file in files] == sorted(SCENE)
    assert tasks(conninfo) == len(SCENE)
    with osp.Client() as client:
        again = client.submit(place)
    assert again.content["dataset_id"] == dataset["id"] and tasks(conninfo) == len(SCENE)


@pytest.mark.exhaustive
def test_fetching_from_a_bucket_goes_on_where_it_was(front: FrontEnd, place: str, conninfo: str) -> None:
    bucket = Bucket(place)
    with Api(front.address, front.token) as api:
        dataset = import_bucket(api, place)
        with psycopg.connect(conninfo, autocommit=True) as connection:
            connection.execute("UPDATE datasets SET state = 'open', committed_at = NULL")
            connection.execute("DELETE FROM dataset_files WHERE path = 'images/v2.png'")
        assert import_bucket(api, place)["id"] == dataset["id"]
        assert tasks(conninfo) == len(SCENE) + 1
        bucket._client.put_object(Bucket=bucket.name, Key="captures/fox/images/v2.png", Body=b"no picture")
        with pytest.raises(ServiceError, match=r"images/v2\.png"):
            import_bucket(api, place)
    bucket.close()


@pytest.mark.exhaustive
def test_archive_of_a_bucket_is_fetched_and_what_is_not_there_is_told(
    front: FrontEnd, place: str, conninfo: str
) -> None:
    archive = place.replace("/fox", "/archive.zip")
    with Api(front.address, front.token) as api:
        assert import_bucket(api, archive)["photographs"] == len(photographs())
        with pytest.raises(ConfigError, match="ZIP file"):
            import_bucket(api, place, sha256="0" * 64)
        with pytest.raises(DatasetError, match="holds no files"):
            import_bucket(api, f"{place}/nothing")
    archive_tasks = tasks(conninfo)
    time.sleep(1.1)  # its address is signed anew, with another time
    with Api(front.address, front.token) as api:
        ids = [import_bucket(api, archive)["id"] for _ in range(2)]
        assert len(set(ids)) == 1 and tasks(conninfo) == archive_tasks
        api.request("DELETE", f"/v1/datasets/{ids[0]}")
        again = import_bucket(api, archive)
        assert (again["id"] != ids[0], again["photographs"]) == (True, len(photographs()))
        assert tasks(conninfo) == archive_tasks
    for address, words in (
        (f"{archive}.zip", "cannot be read (404)"),
        ("s3://no-such-bucket/fox", "cannot be read (NoSuchBucket)"),
        ("s3:///fox", "is no bucket"),
        (f"{place}?endpoint_url=nowhere", "cannot be reached"),
    ):
        told = CliRunner().invoke(cli, ["submit", address])
        assert told.exit_code != 0 and words in told.stderr, told.output


@pytest.mark.exhaustive
def test_folder_with_odd_characters_in_its_name_is_that_folder(front: FrontEnd, place: str) -> None:
    """And not the one whose name is what comes before the first of them."""
    odd = "fox#2 %23+é"
    bucket = Bucket(place)
    for name in ("a b.png", "c+d%20#e.png", "'(é)!~&=@,.png"):
        bucket._client.put_object(
            Bucket=bucket.name, Key=f"captures/{odd}/images/{name}", Body=next(iter(SCENE.values()))
        )
    bucket.close()
    with Api(front.address, front.token) as api:
        dataset = import_bucket(api, place.replace("fox", odd))
        assert (dataset["name"], dataset["photographs"]) == (odd, 3)
    for address in (f"{place}?/images", f"{place}?", f"{place}?endpoint_url=https://x&key=1"):
        with pytest.raises(ConfigError, match="question mark"):
            Bucket(address)
    for address in ("s3://[x/fox", "s3://a:b/fox"):
        told = CliRunner().invoke(cli, ["submit", address])
        assert told.exit_code == 1 and "unexpected" not in told.stderr, told.output


@pytest.mark.exhaustive
def test_temporary_credentials_with_long_tokens_do(
    front: FrontEnd, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their token stands in each address, and AWS lets it have 4096 bytes."""
    monkeypatch.setenv("AWS_SESSION_TOKEN", "A0+/wXyZ" * 512)
    monkeypatch.setattr(boto3, "DEFAULT_SESSION", None)  # it remembers the credentials
    with Api(front.address, front.token) as api:
        assert import_bucket(api, place)["photographs"] == len(photographs())


@pytest.mark.parametrize(
    ("name", "host"),
    [
        ("captures", "https://captures.s3.eu-central-1.amazonaws.com/fox/"),
        ("my.captures", "https://s3.eu-central-1.amazonaws.com/my.captures/fox/"),
    ],
)
def test_addresses_are_signed_for_the_region_of_the_bucket(
    monkeypatch: pytest.MonkeyPatch, name: str, host: str
) -> None:
    """Whichever region the client is set to; a signature for another one is refused."""
    for variable in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(variable, "x" * 16)
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.delenv("AWS_ENDPOINT_URL_S3", raising=False)
    monkeypatch.setattr(boto3, "DEFAULT_SESSION", None)
    make = boto3.client

    def answer(request: AWSRequest, **_named: object) -> AWSResponse:
        headers = {"x-amz-bucket-region": "eu-central-1", "Content-Type": "application/xml"}
        is_right = "eu-central-1" in str(request.headers["Authorization"])
        listing = "<ListBucketResult><IsTruncated>false</IsTruncated><Contents><Key>fox/a b.png</Key>"
        listing += '<Size>1</Size><ETag>"x"</ETag></Contents></ListBucketResult>'
        wrong = "<Error><Code>AuthorizationHeaderMalformed</Code><Region>eu-central-1</Region></Error>"
        body = (listing if is_right else wrong) if request.method == "GET" else ""
        raw = io.BytesIO(body.encode())
        raw.stream = lambda: iter([body.encode()])  # type: ignore[attr-defined]
        return AWSResponse(request.url, 200 if is_right else 400, headers, raw)

    def client(*given: Any, **named: Any) -> Any:
        made = make(*given, **named)
        made.meta.events.register("before-send.s3", answer)
        return made

    monkeypatch.setattr(boto3, "client", client)
    bucket = Bucket(f"s3://{name}/fox")
    assert list(bucket.list_files()) == ["a b.png"]
    address = bucket.file_address("fox/a b.png")
    bucket.close()
    assert address.startswith(f"{host}a%20b.png?") and "%2Feu-central-1%2Fs3%2F" in address
