"""Secrets and signatures of messages."""

import base64
import binascii
import json
import secrets
import uuid
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from standardwebhooks.webhooks import Webhook

PREFIX = "whsec_"
_MIN_BYTES, _MAX_BYTES = 24, 64


def new_secret() -> str:
    """Return a fresh secret of 256 random bits."""
    return PREFIX + base64.b64encode(secrets.token_bytes(32)).decode("ascii")


def check_secret(secret: str) -> str:
    """Return the secret itself, if it is one by the standard.

    Raises:
        ValueError: it is not ``whsec_`` and the base64 of 24 to 64 bytes.
    """
    try:
        if not secret.startswith(PREFIX):
            raise ValueError
        content = base64.b64decode(secret.removeprefix(PREFIX), validate=True)
    except (ValueError, binascii.Error):
        content = b""
    if not _MIN_BYTES <= len(content) <= _MAX_BYTES:
        raise ValueError(f"a secret is {PREFIX} and the base64 of {_MIN_BYTES} to {_MAX_BYTES} random bytes")
    return secret


def signed_message(
    secret: str, delivery_id: uuid.UUID, payload: Mapping[str, Any], now: datetime
) -> tuple[bytes, dict[str, str]]:
    """Return the body and headers of a message; the body is the same at every attempt.

    Args:
        secret: of the endpoint.
        delivery_id: of the message.
        payload: its content.
        now: when it is sent.
    """
    body = json.dumps(payload, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    name, moment = f"msg_{delivery_id.hex}", now.astimezone(UTC)
    headers = {
        "Content-Type": "application/json",
        "User-Agent": "octasplat-webhooks",
        "webhook-id": name,
        "webhook-timestamp": str(int(moment.timestamp())),
        "webhook-signature": Webhook(secret).sign(name, moment, body),
    }
    return body.encode(), headers
