"""Who gets in: tokens, scopes, owners, hosts, origins; test_access_matrix asks at every route."""

import pytest
from pydantic import SecretStr

from octasplat.engine.core.errors import ConfigError
from tests.support.service_harness import (
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


async def test_tokenless_service_accepts_local_same_origin_requests_only(
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


async def test_first_token_ends_anonymous_access(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        new = {"name": "n", "owner": "me", "scopes": ["admin"]}
        made = (await http.post("/v1/tokens", json=new)).json()
        assert (await http.get("/v1/jobs")).status_code == 401
        headers = {"Authorization": f"Bearer {made['token']}"}
        assert (await http.get("/v1/jobs", headers=headers)).status_code == 200
        listed = (await http.get("/v1/tokens", headers=headers)).json()["tokens"]
        assert [t["id"] for t in listed] == [made["id"]] and "token" not in listed[0]
        async with service.pool.connection() as connection:
            cursor = await connection.execute("SELECT * FROM tokens")
            assert made["token"] not in str(await cursor.fetchall())
        assert (await http.delete(f"/v1/tokens/{made['id']}", headers=headers)).status_code == 204
        assert (await http.get("/v1/jobs", headers=headers)).status_code == 401
        service.invalidate_token_state()
        assert (await http.get("/v1/jobs")).status_code == 401  # that the last has ended opens nothing


async def test_token_of_the_environment_is_let_in(connect_service: ConnectService) -> None:
    async with connect_service(host="0.0.0.0", token=SecretStr("from-the-environment")) as (http, _):
        assert (await http.get("/v1/jobs")).status_code == 401
        headers = {"Authorization": "Bearer from-the-environment", "Host": "anything.example"}
        assert (await http.get("/v1/tokens", headers=headers)).status_code == 200


async def test_public_address_without_a_token_is_refused(connect_service: ConnectService) -> None:
    for host in ("0.0.0.0", "::", "192.0.2.7", "example.org"):
        with pytest.raises(ConfigError, match="token"):
            async with connect_service(host=host):
                pass
    for host in ("127.0.0.1", "127.8.8.8", "::1", "localhost"):
        async with connect_service(host=host):
            pass
