"""Secrets end when they should, and whose word about a client counts."""

import asyncio
from typing import Any

import httpx
import pytest
from pydantic import SecretStr

from octasplat.workers.db.tokens import hash_secret, new_secret
from tests.support.service_harness import BEARER, ConnectService, client_with_token, new_job

BEHIND_TLS = {"X-Forwarded-Proto": "https", "X-Forwarded-For": "203.0.113.9"}


async def sign_in(http: httpx.AsyncClient, secret: str, **headers: str) -> tuple[str, dict[str, str]]:
    """The cookie's whole line, and the header with which a browser sends it."""
    answer = await http.post("/sign-in", data={"token": secret}, headers=headers)
    assert answer.status_code == 303, answer.text
    http.cookies.clear()
    line = answer.headers["set-cookie"]
    return line, {**headers, "Cookie": line.partition(";")[0]}


async def status(http: httpx.AsyncClient, headers: dict[str, str], path: str = "/v1/jobs") -> int:
    return (await http.get(path, headers=headers)).status_code


async def audit(http: httpx.AsyncClient, headers: dict[str, str]) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = (await http.get("/v1/audit", headers=headers)).json()["entries"]
    return entries


async def test_session_cookie_does_not_contain_token(connect_service: ConnectService) -> None:
    async with connect_service(signed_in=False) as (http, service):
        bearer = await client_with_token(service, "me", "admin")
        secret = bearer["Authorization"].split()[1]
        line, mine = await sign_in(http, secret)
        assert secret not in line and "HttpOnly" in line and "SameSite=strict" in line
        _, other = await sign_in(http, secret)
        assert await status(http, mine) == await status(http, other) == 200
        value = mine["Cookie"].partition("=")[2]
        assert await status(http, {"Authorization": f"Bearer {value}"}) == 401
        assert await status(http, {"Cookie": f"octasplat_session={secret}"}) == 401
        assert (await http.post("/sign-out", headers=mine)).status_code == 303
        http.cookies.clear()
        assert (await status(http, mine), await status(http, other)) == (401, 200)  # a copy is worth nothing
        token = (await http.get("/v1/tokens", headers=bearer)).json()["tokens"][0]
        assert (await http.delete(f"/v1/tokens/{token['id']}", headers=bearer)).status_code == 204
        assert await status(http, other) == 401


async def test_sessions_and_tokens_run_out(connect_service: ConnectService) -> None:
    async with connect_service(signed_in=False, session_hours=0.5) as (http, service):
        boss = await client_with_token(service, "boss", "admin")
        new = {"name": "n", "owner": "me", "scopes": ["write"], "hours": 1}
        made = (await http.post("/v1/tokens", json=new, headers=boss)).json()
        bearer = {"Authorization": f"Bearer {made['token']}"}
        _, mine = await sign_in(http, made["token"])
        _, short = await sign_in(http, boss["Authorization"].split()[1])
        assert [await status(http, who) for who in (bearer, mine, short)] == [200, 200, 200]
        async with service.pool.connection() as connection:  # an hour passes
            for table in ("tokens", "sessions"):
                await connection.execute(f"UPDATE {table} SET expires_at = expires_at - interval '3601 s'")
        assert [await status(http, who) for who in (bearer, mine, short, boss)] == [401, 401, 401, 200]


async def test_environment_token_change_revokes_previous(connect_service: ConnectService) -> None:
    async def start(secret: str) -> dict[str, int]:
        async with connect_service(signed_in=False, token=SecretStr(secret)) as (http, _):
            return {s: await status(http, {"Authorization": f"Bearer {s}"}) for s in secrets}

    first, second = secrets = new_secret(), new_secret()
    assert await start(first) == {first: 200, second: 401}
    assert await start(first) == {first: 200, second: 401}
    assert await start(second) == {first: 401, second: 200}
    assert await start(first) == {first: 401, second: 200}  # and it does not come back


async def test_cookies_behind_trusted_tls_proxy_are_secure(connect_service: ConnectService) -> None:
    async with connect_service(signed_in=False, proxies=("127.0.0.0/8",), token=SecretStr(new_secret())) as (
        http,
        service,
    ):
        secret = (await client_with_token(service, "me", "admin"))["Authorization"].split()[1]
        line, mine = await sign_in(http, secret, **BEHIND_TLS)
        assert line.startswith("__Host-") and "; Secure" in line and "Domain" not in line
        assert "Path=/" in line
        assert await status(http, mine) == 200
        # What another server of that host name could set or would be sent is no session here.
        plain = mine["Cookie"].removeprefix("__Host-")
        assert await status(http, {**BEHIND_TLS, "Cookie": plain}) == 401
        newest = (await audit(http, mine))[0]
        assert (newest["action"], newest["owner"], newest["address"]) == (
            "POST /sign-in",
            "me",
            "203.0.113.9",
        )


async def test_proxy_headers_of_untrusted_clients_are_ignored(connect_service: ConnectService) -> None:
    async with connect_service(signed_in=False, proxies=("10.0.0.1",), token=SecretStr(new_secret())) as (
        http,
        service,
    ):
        secret = (await client_with_token(service, "me", "admin"))["Authorization"].split()[1]
        for headers in (BEHIND_TLS, {"Forwarded": "for=203.0.113.9;proto=https"}):
            line, mine = await sign_in(http, secret, **headers)
            assert not line.startswith("__Host-") and "Secure" not in line
            assert (await audit(http, mine))[0]["address"] == "127.0.0.1"


@pytest.mark.parametrize(
    ("dialect", "headers", "address", "is_secure"),
    [
        ("x-forwarded", {"X-Forwarded-For": "6.6.6.6, 203.0.113.9, 10.1.1.1", "X-Forwarded-Proto": "https"},
         "203.0.113.9", True),
        ("x-forwarded", {"X-Forwarded-For": "203.0.113.9:4711", "Forwarded": "for=6.6.6.6;proto=https"},
         "203.0.113.9", False),
        ("x-forwarded", {"X-Forwarded-For": "what?", "X-Forwarded-Proto": "gopher"}, "127.0.0.1", False),
        ("forwarded", {"Forwarded": 'for=6.6.6.6;proto=http, for="[2001:db8::9]:1";proto=https'},
         "2001:db8::9", True),
        ("forwarded", {"Forwarded": "for=203.0.113.9", "X-Forwarded-Proto": "https"}, "203.0.113.9", False),
    ],
)  # fmt: skip
async def test_forwarded_address_uses_nearest_hop(
    connect_service: ConnectService, dialect: str, headers: dict[str, str], address: str, is_secure: bool
) -> None:
    async with connect_service(
        signed_in=False,
        proxies=("127.0.0.1", "10.0.0.0/8"),
        proxy_headers=dialect,
        token=SecretStr(new_secret()),
    ) as (http, service):
        secret = (await client_with_token(service, "me", "admin"))["Authorization"].split()[1]
        line, mine = await sign_in(http, secret, **headers)
        assert ("; Secure" in line) == is_secure
        assert (await audit(http, mine))[0]["address"] == address


async def test_request_without_token_is_refused_behind_any_proxy(connect_service: ConnectService) -> None:
    plain_proxy: dict[str, str] = {"Host": "127.0.0.1"}  # what proxy_pass alone sends
    new = {"name": "n", "owner": "me", "scopes": ["admin"]}
    async with connect_service(signed_in=False) as (http, _):
        for headers in (
            plain_proxy,
            BEHIND_TLS,
            {"Forwarded": "for=203.0.113.9"},
            {"X-Client-IP": "6.6.6.6"},
        ):
            assert await status(http, headers) == 401
            assert (await http.post("/v1/tokens", json=new, headers=headers)).status_code == 401


async def test_wrong_tokens_are_throttled_per_address(connect_service: ConnectService) -> None:
    async with connect_service(signed_in=False, wrong_token_seconds=60.0) as (http, service):
        known = await client_with_token(service, "me", "admin")
        assert await status(http, known) == 200
        pending: set[asyncio.Task[httpx.Response]] = set()
        done: set[asyncio.Task[httpx.Response]] = set()
        while not done:  # until one is turned away; those before it wait for their answer
            guess = {"Authorization": f"Bearer guess-{len(pending)}"}
            pending.add(asyncio.create_task(http.get("/v1/jobs", headers=guess)))
            done, pending = await asyncio.wait(pending, timeout=0.2)
        assert {task.result().status_code for task in done} == {429}
        assert all("Retry-After" in task.result().headers for task in done)
        new = await client_with_token(service, "me", "admin")
        for mine in (known, new):  # nobody waits for a guesser of the same address
            assert [await status(http, mine) for _ in range(5)] == [200] * 5
        assert not any(task.done() for task in pending)
        for task in pending:
            task.cancel()


async def test_event_streams_end_with_their_token_or_session(connect_service: ConnectService) -> None:
    async with connect_service(ping_seconds=60.0) as (http, service):
        job = await new_job(http, service)
        address = f"/v1/jobs/{job['id']}/events"
        me = "local"
        bearer = [await client_with_token(service, me, "read") for _ in range(3)]
        del http.headers["Authorization"]
        _, browser = await sign_in(http, bearer[2]["Authorization"].split()[1])
        keeps = await client_with_token(service, me, "read")
        asked = [*bearer[:2], browser, keeps]
        revoked, expired, signed_out, stays = (
            asyncio.create_task(http.get(address, headers=headers)) for headers in asked
        )
        while service.event_broker.subscriber_count < len(asked):
            await asyncio.sleep(0.01)
        hashes = [hash_secret(headers["Authorization"].split()[1]) for headers in bearer[:2]]
        async with service.pool.connection() as connection:
            for change, sha256 in zip(("revoked_at", "expires_at"), hashes, strict=True):
                await connection.execute(
                    f"UPDATE tokens SET {change} = now() WHERE sha256 = %s",
                    [sha256],
                )
        assert (await http.post("/sign-out", headers=browser)).status_code == 303
        async with asyncio.timeout(10):
            answers = await asyncio.gather(revoked, expired, signed_out)
        assert [answer.status_code for answer in answers] == [200, 200, 200]
        assert not stays.done()
        assert (await http.post(f"/v1/jobs/{job['id']}/cancel", headers=BEARER)).is_success
        async with asyncio.timeout(30):
            assert (await stays).status_code == 200


async def test_audit_log_records_changes(connect_service: ConnectService) -> None:
    async with connect_service(signed_in=False) as (http, service):
        boss = await client_with_token(service, "boss", "admin")
        mine = await client_with_token(service, "me", "read")
        new = {"name": "n", "owner": "me", "scopes": ["write"]}
        made = (await http.post("/v1/tokens", json=new, headers=boss)).json()
        assert (await http.post("/v1/tokens", json=new, headers=mine)).status_code == 403
        assert (await http.get("/v1/jobs", headers={"Authorization": "Bearer no\0ne"})).status_code == 401
        assert (await http.post("/v1/tokens", json=new)).status_code == 401  # by nobody: fills no table
        await http.delete(f"/v1/tokens/{made['id']}", headers=boss)
        assert await status(http, mine, "/v1/audit") == 403
        told = [(e["owner"], e["action"], e["target"], e["status"]) for e in await audit(http, boss)]
        assert told == [
            ("boss", f"DELETE /v1/tokens/{made['id']}", None, 204),
            (None, "wrong token", None, 401),
            ("me", "POST /v1/tokens", None, 403),
            ("boss", "POST /v1/tokens", f"/v1/tokens/{made['id']}", 201),
        ]
        first = (await http.get("/v1/audit?limit=3", headers=boss)).json()
        rest = (await http.get("/v1/audit", params={"cursor": first["next"]}, headers=boss)).json()
        assert [e["action"] for e in rest["entries"]] == ["POST /v1/tokens"] and rest["next"] is None
        assert made["token"] not in str(first) + str(rest)


async def test_sign_in_link_works_once(connect_service: ConnectService) -> None:
    async with connect_service(signed_in=False) as (http, service):
        mine = await client_with_token(service, "me", "write")
        path = (await http.post("/v1/sign-in-links", headers=mine)).json()["path"]
        assert (await http.head(path)).status_code == 405  # looking at it does not use it up
        answer = await http.get(path)
        cookie = {"Cookie": answer.headers["set-cookie"].partition(";")[0]}
        http.cookies.clear()
        assert answer.status_code == 200 and await status(http, cookie) == 200
        assert (await http.get("/v1/info", headers=cookie)).json()["owner"] == "me"
        again = await http.get(path)
        assert again.status_code == 403 and "set-cookie" not in again.headers
