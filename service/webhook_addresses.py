"""Check of webhook addresses before they are stored."""

from octasplat.service.problems import ProblemError
from octasplat.service.state import Service
from octasplat.workers.maintenance.webhooks.addresses import AddressRefusedError, check_url


def check_webhook_address(service: Service, url: str, pointer: str = "#/url") -> None:
    """Refuse an address that messages may not be sent to.

    Raises:
        ProblemError: 422.
    """
    try:
        check_url(url, service.settings.webhook_hosts)
    except AddressRefusedError as error:
        errors = [{"pointer": pointer, "detail": str(error)}]
        raise ProblemError(422, "webhook-address", str(error), errors=errors) from None
