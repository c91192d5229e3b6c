"""Who may read the served pages: the token, and the rule without one."""

import hmac
import os
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from email.message import Message
from ipaddress import IPv4Address, IPv6Address, ip_address
from urllib.parse import parse_qs

from torchvision_dddas.errors import InputError

TOKEN = "DDDAS_SERVE_TOKEN"  # in the environment
_WANTED = re.compile(r"[A-Za-z0-9._~-]{8,200}")


@dataclass(frozen=True)
class Access:
    """The rule of a server. token: "" if none is needed. is_made: the token was made here, so it has to be printed."""

    token: str = ""
    is_made: bool = False

    def holds(self, token: str) -> bool:
        """Whether this is the token, compared in constant time."""
        return bool(self.token) and hmac.compare_digest(token.encode(), self.token.encode())

    def allows(self, headers: Message | Mapping[str, str], query: str, port: int) -> bool:
        """Whether a request may be answered. It has the token as a Bearer, in its cookie or in its query.

        A server without a token answers only requests for an address or localhost. Otherwise a page of another site
        could read it in the user's browser, by a name that resolves to this machine (DNS rebinding).
        """
        if not self.token:
            return is_address(headers.get("Host", ""))
        kind, _, bearer = headers.get("Authorization", "").partition(" ")
        pairs = (part.strip().partition("=") for part in headers.get("Cookie", "").split(";"))
        cookies = [value for name, _, value in pairs if name == cookie_name(port)]
        given = [*parse_qs(query).get("token", []), *cookies, *([bearer.strip()] if kind.lower() == "bearer" else [])]
        return any(self.holds(token) for token in given)


def cookie_name(port: int) -> str:
    """Return the name of the cookie with the token. Cookies do not distinguish ports, so the name does."""
    return f"dddas_token_{port}"


def choose_access(host: str, given: str | None) -> Access:
    """Return the rule for a host: the given token, else the environment's, else a new token beyond this machine.

    Raise InputError for a token that an address cannot hold or that is too short.
    """
    source = "--serve-token" if given is not None else f"${TOKEN}"
    token = os.environ.get(TOKEN, "") if given is None else given
    if not token and given is None:
        return Access() if _is_loopback(host) else Access(secrets.token_urlsafe(16), is_made=True)
    if not _WANTED.fullmatch(token):
        raise InputError(
            f"{source} has {len(token)} characters; give 8 to 200 of letters, digits and . _ ~ - without others"
        )
    return Access(token)


def is_address(host: str) -> bool:
    """Whether the Host of a request is localhost, an address, or missing."""
    name = host.rpartition(":")[0] if re.search(r":\d*$", host) and not host.endswith("]") else host
    return name in ("", "localhost") or _parsed(name) is not None


def _is_loopback(host: str) -> bool:
    address = _parsed(host)
    return host == "localhost" or (address is not None and address.is_loopback)


def _parsed(host: str) -> IPv4Address | IPv6Address | None:
    try:
        return ip_address(host.strip("[]"))
    except ValueError:
        return None
