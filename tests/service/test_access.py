"""Who gets in: tokens, scopes, owners, hosts, origins; test_access_matrix asks at every route."""

import secrets

import pytest
from pydantic import SecretStr

from octasplat.engine.core.errors import ConfigError
from octasplat.service.settings import ServiceSettings
from tests.support.service_harness import (
    TOKEN,
    ConnectService,
    client_with_token,
    committed_dataset,
)


async def test_lists_and_inputs_are_limited_to_owner(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        mine = await client_with_token(service, "me", "write")
        stranger = await client_with_token(service, "stranger", "write")
        taken = {"kind": "toy", "dataset_id": await committed_dataset(service, "me")}
        assert (await http.post("/v1/jobs", json=taken, headers=mine)).status_code == 202
        assert (await http.post("/v1/jobs", json=taken, headers=stranger)).status_code == 422
        for path in ("/v1/jobs", "/v1/datasets"):
            listed = (await http.get(path, headers=stranger)).json()
            assert listed[path.removeprefix("/v1/")] == []
        admin = await client_with_token(service, "boss", "admin")
        assert len((await http.get("/v1/jobs", headers=admin)).json()["jobs"]) == 1


async def test_private_service_accepts_local_same_origin_requests_only(
    connect_service: ConnectService,
) -> None:
    async with connect_service() as (http, _):
        assert (await http.get("/v1/jobs")).status_code == 200
        for host in ("evil.example", "127.0.0.1.evil.example", "", "evil.example:8642"):
            assert (await http.get("/v1/jobs", headers={"Host": host})).status_code == 421
        for host in ("127.0.0.1:1", "[::1]:80", "LOCALHOST"):
            assert (await http.get("/v1/jobs", headers={"Host": host})).status_code == 200
        body = {"name": "x"}
        for headers in (
            {"Origin": "https://evil.example"},
            {"Origin": "null"},
            {"Origin": "http://localhost:9999"},
            {"Sec-Fetch-Site": "cross-site"},
        ):
            assert (await http.post("/v1/datasets", json=body, headers=headers)).status_code == 403
        own = {"Origin": "http://localhost:8642", "Sec-Fetch-Site": "same-origin"}
        assert (await http.post("/v1/datasets", json=body, headers=own)).status_code == 201
        answer = await http.get("/v1/info")
        assert answer.headers["X-Content-Type-Options"] == "nosniff"


async def test_made_token_is_valid_until_it_is_revoked(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        new = {"name": "n", "owner": "me", "scopes": ["admin"]}
        made = (await http.post("/v1/tokens", json=new)).json()
        headers = {"Authorization": f"Bearer {made['token']}"}
        assert (await http.get("/v1/jobs", headers=headers)).status_code == 200
        listed = (await http.get("/v1/tokens", headers=headers)).json()["tokens"]
        assert listed[0]["id"] == made["id"] and not any("token" in token for token in listed)
        async with service.pool.connection() as connection:
            cursor = await connection.execute("SELECT * FROM tokens")
            assert made["token"] not in str(await cursor.fetchall())
        for token in reversed(listed):  # its own last
            answer = await http.delete(f"/v1/tokens/{token['id']}", headers=headers)
            assert answer.status_code == 204
        assert (await http.get("/v1/jobs", headers=headers)).status_code == 401
        del http.headers["Authorization"]
        assert (await http.get("/v1/jobs")).status_code == 401  # that the last has ended opens nothing


async def test_token_of_the_environment_is_let_in(connect_service: ConnectService) -> None:
    async with connect_service(signed_in=False, host="0.0.0.0", token=SecretStr(TOKEN)) as (
        http,
        _,
    ):
        assert (await http.get("/v1/jobs")).status_code == 401
        headers = {"Authorization": f"Bearer {TOKEN}", "Host": "anything.example"}
        assert (await http.get("/v1/tokens", headers=headers)).status_code == 200


async def test_start_without_a_token_is_refused(connect_service: ConnectService) -> None:
    addresses = ("0.0.0.0", "::", "192.0.2.7", "example.org", "127.0.0.1", "::1", "localhost")
    for host in addresses:
        with pytest.raises(ConfigError, match="octasplat token create"):
            async with connect_service(host=host, has_token=False):
                pass
    for host in addresses:
        async with connect_service(host=host):
            pass


def test_token_of_the_environment_must_be_long_and_random() -> None:
    weak = ("a", "from-the-environment", "0123456789" * 3, secrets.token_hex(16)[:31], "ab" * 40)
    for secret in weak:
        with pytest.raises(ConfigError, match="OCTASPLAT_TOKEN has less than 128 bits") as refusal:
            ServiceSettings(token=SecretStr(secret)).checked()
        assert len(secret) == 1 or secret not in str(refusal.value)
    for secret in (secrets.token_hex(16), secrets.token_hex(24), secrets.token_urlsafe(16), TOKEN):
        assert ServiceSettings(token=SecretStr(secret)).checked().token is not None
