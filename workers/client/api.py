"""Requests to a service, tried again where that is safe, with its errors as ours."""

import json
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx

from octasplat.engine.core.errors import OctasplatError
from octasplat.workers.client.backoff import MAX_FIRST_OUTAGE_SECONDS, MAX_OUTAGE_SECONDS, Backoff
from octasplat.workers.data_folder import ADDRESS_FILE, TOKEN_FILE, default_data_folder

DEFAULT_ADDRESS = "http://127.0.0.1:8642"
SERVER_VARIABLE, TOKEN_VARIABLE, DATA_VARIABLE = "OCTASPLAT_SERVER", "OCTASPLAT_TOKEN", "OCTASPLAT_DATA"
BUSY_STATUSES = frozenset({408, 429})
UNAVAILABLE_STATUSES = frozenset({502, 503, 504})
"""A proxy answers so for a service that is away, and the service itself while it stops."""
PROBLEM_MEDIA_TYPE = "application/problem+json"
_TIMEOUT = httpx.Timeout(60.0, connect=10.0)


class ServiceError(OctasplatError):
    """The service refused something.

    Attributes:
        status: of the answer.
        errors: single faults.
        retry_seconds: for how long the service asks to be left alone, s; 0 where it does not say.
    """

    def __init__(self, message: str, status: int = 0, errors: tuple[Mapping[str, Any], ...] = ()) -> None:
        super().__init__(message)
        self.status = status
        self.errors = errors
        self.retry_seconds = 0.0


class ServiceUnreachableError(OctasplatError):
    """The service does not answer, or a proxy in front of it says so."""

    error_type = "unreachable"


def find_address(environment: Mapping[str, str], data: Path | None = None) -> str:
    """Return the service's address: that of the environment, or of this machine's ``octasplat serve``."""
    if environment.get(SERVER_VARIABLE):
        return environment[SERVER_VARIABLE].rstrip("/")
    return _local_address(data or _data_folder(environment)) or DEFAULT_ADDRESS


def find_token(environment: Mapping[str, str], address: str, data: Path | None = None) -> str | None:
    """Return the token: that of the environment, or of this machine's ``octasplat serve``.

    The latter is for that service alone; no other address is ever sent it.
    """
    if environment.get(TOKEN_VARIABLE):
        return environment[TOKEN_VARIABLE]
    folder = data or _data_folder(environment)
    if _local_address(folder) != address.rstrip("/"):
        return None
    try:
        return (folder / TOKEN_FILE).read_text(encoding="ascii").strip() or None
    except (OSError, ValueError):  # somebody else's
        return None


def _data_folder(environment: Mapping[str, str]) -> Path:
    return Path(environment.get(DATA_VARIABLE) or default_data_folder())


def _local_address(folder: Path) -> str | None:
    """Return where ``octasplat serve`` on that data folder is, if it runs."""
    try:
        content = json.loads((folder / ADDRESS_FILE).read_text(encoding="utf-8"))
        return str(content["url"]).rstrip("/")
    except (OSError, ValueError, KeyError, TypeError):
        return None


class Api:
    """A service.

    Args:
        address: e.g. ``http://127.0.0.1:8642``.
        token: a bearer token, if it needs one.
        awaits_start: whether a service that refuses the first connection may be starting and is asked again;
            else the refusal is told at once.
    """

    def __init__(self, address: str, token: str | None = None, *, awaits_start: bool = True) -> None:
        headers = {"User-Agent": "octasplat"}
        if token:
            headers["Authorization"] = f"Bearer {token}"
        self.address = address
        self._has_answered = False
        self._awaits_start = awaits_start
        # Proxies of the environment are not for the own machine.
        local = httpx.URL(address).host in ("127.0.0.1", "localhost", "::1")
        self._http = httpx.Client(
            base_url=address,
            headers=headers,
            timeout=_TIMEOUT,
            trust_env=not local,
            limits=httpx.Limits(max_connections=20),
        )

    @classmethod
    def local(cls, data: Path) -> Self:
        """Return the service that ``octasplat serve`` runs on a data folder of one's own."""
        address = _local_address(data) or DEFAULT_ADDRESS
        return cls(address, find_token({}, address, data))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _type: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the HTTP connections."""
        self._http.close()

    def get(self, path: str, **query: Any) -> Any:
        """Return the JSON of a GET."""
        return _response_json(self.request("GET", path, params=query or None))

    def post(self, path: str, body: Any = None, *, key: str | None = None) -> Any:
        """Return the JSON of a POST; with a key, which is made if not given, it is safe to try again."""
        return _response_json(self.post_response(path, body, key=key))

    def post_response(self, path: str, body: Any = None, *, key: str | None = None) -> httpx.Response:
        """Return the answer to a POST, as :meth:`post`."""
        headers = {"Idempotency-Key": key or uuid.uuid4().hex}
        return self.request("POST", path, json=body, headers=headers)

    def patch(self, path: str, body: Any) -> Any:
        """Return the JSON of a PATCH."""
        return _response_json(self.request("PATCH", path, json=body))

    def request(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        """Send a request, again while the service is away or busy; bodies must be content or JSON.

        Raises:
            ServiceError: it was refused.
            ServiceUnreachableError: nobody answers.
        """
        patience = self.new_backoff()
        while True:
            try:
                response = self._http.request(method, path, **arguments)
            except httpx.TransportError as error:
                if self._is_absent(error) or not patience.wait():
                    raise self.unreachable_error(error) from None
                continue
            if response.status_code not in BUSY_STATUSES | UNAVAILABLE_STATUSES:
                self._has_answered = True
                return self._raise_for_status(response)
            self._has_answered = self._has_answered or _is_from_service(response)
            # A service that has answered is waited for longer than one that perhaps is not there.
            patience.seconds = self.new_backoff().seconds
            if not patience.wait(_retry_after(response)):
                return self._raise_for_status(response)

    def send(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        """Send a request once; for what cannot be sent again as it is.

        Raises:
            ServiceError: it was refused, also because the service is busy.
            ServiceUnreachableError: a proxy says that the service is away.
            httpx.TransportError: nobody answers.
        """
        response = self._raise_for_status(self._http.request(method, path, **arguments))
        self._has_answered = True
        return response

    def new_backoff(self) -> Backoff:
        """Return the back-off for an outage of the service that begins now."""
        return Backoff(MAX_OUTAGE_SECONDS if self._has_answered else MAX_FIRST_OUTAGE_SECONDS)

    def stream(self, method: str, path: str, **arguments: Any) -> Any:
        """Stream an answer, as a context; the caller checks it with :meth:`raise_for_stream_status`."""
        return self._http.stream(method, path, **arguments)

    def iterate_pages(self, path: str, name: str, **query: Any) -> Iterator[dict[str, Any]]:
        """Yield all entries of a list that comes in parts."""
        cursor: str | None = None
        while True:
            page = self.get(path, **query, **({} if cursor is None else {"cursor": cursor}))
            yield from page[name]
            cursor = page["next"]
            if cursor is None:
                return

    def raise_for_stream_status(self, response: httpx.Response) -> None:
        """Raise unless a streamed answer is good.

        Raises:
            ServiceError: it is not.
            ServiceUnreachableError: a proxy says that the service is away.
        """
        if not response.is_success:
            # The body of a streamed answer is not there before it is read.
            response.read()
            self._raise_for_status(response)
        self._has_answered = True

    def unreachable_error(self, error: Exception | str) -> ServiceUnreachableError:
        """Return what to tell when nobody answers."""
        reason = str(error) or type(error).__name__
        return ServiceUnreachableError(
            f"No service answers at {self.address} ({reason}); start one with octasplat serve, or "
            f"set {SERVER_VARIABLE}."
        )

    def _is_absent(self, error: httpx.TransportError) -> bool:
        """Return whether a first request met no service, for which nobody wants to wait."""
        return isinstance(error, httpx.ConnectError) and not (self._awaits_start or self._has_answered)

    def _raise_for_status(self, response: httpx.Response) -> httpx.Response:
        """Return the response itself if it is successful; raise otherwise."""
        if response.is_success:
            return response
        if response.status_code in UNAVAILABLE_STATUSES and not _is_from_service(response):
            raise self.unreachable_error(f"a proxy answers {response.status_code}")
        error = _service_error(response)
        error.retry_seconds = _retry_after(response)
        raise error


def _is_from_service(response: httpx.Response) -> bool:
    """Return whether an answer comes from the service itself, and not from a proxy in front of it."""
    return response.is_success or response.headers.get("content-type", "").startswith(PROBLEM_MEDIA_TYPE)


def _response_json(response: httpx.Response) -> Any:
    try:
        return response.json()
    except ValueError:
        kind = response.headers.get("content-type", "nothing known")
        raise ServiceError(
            f"{response.request.url} answered with {kind} in the place of JSON, so it is no octasplat "
            f"service; check {SERVER_VARIABLE} and the proxies on the way.",
            response.status_code,
        ) from None


def problem_error(problem: Mapping[str, Any], status: int) -> ServiceError:
    """Return the error that a problem document (RFC 9457) tells."""
    detail, errors = str(problem["detail"]), tuple(problem.get("errors") or ())
    further = [_error_text(e) for e in errors if e.get("detail") and str(e["detail"]) != detail]
    if further:
        more = f" and {len(further) - 5} more" if len(further) > 5 else ""
        detail = f"{detail} {' '.join(further[:5])}{more}"
    return ServiceError(detail, status, errors)


def _service_error(response: httpx.Response) -> ServiceError:
    """Return what the service, or whoever answered for it, refuses."""
    if response.is_redirect:
        return ServiceError(
            f"{response.request.url} is redirected to {response.headers['location']}; set {SERVER_VARIABLE} "
            "to the address of the service itself.",
            response.status_code,
        )
    try:
        error = problem_error(response.json(), response.status_code)
    except (ValueError, KeyError, TypeError):
        detail = f"The service answered {response.status_code} to {response.request.url}."
        error = ServiceError(detail, response.status_code)
    if response.status_code == 401:
        return ServiceError(f"{str(error).split(':')[0]}: set {TOKEN_VARIABLE}.", 401, error.errors)
    return error


def _error_text(error: Mapping[str, Any]) -> str:
    """Return what is wrong, with the option that it is about."""
    detail = str(error["detail"])
    option = str(error.get("pointer", "")).partition("#/options/")[2].replace("/", ".")
    return f"{option}: {detail}" if option and option.rpartition(".")[2] not in detail else detail


def _retry_after(response: httpx.Response) -> float:
    text = response.headers.get("retry-after", "")
    return float(text) if text.isdigit() else 0.0
