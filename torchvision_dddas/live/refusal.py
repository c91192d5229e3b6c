"""Distinguish a camera that refuses an address (401, 404) from one that is absent, which FFmpeg does not."""

import base64
import hashlib
import re
import socket
import ssl
from urllib.parse import unquote, urlsplit

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.live_streams import LiveStream, open_stream

_PORTS = {"rtsp": 554, "http": 80, "https": 443}
_MOST_BYTES = 65536
_MEANING = {
    401: "the name or the password is wrong; give both in the address, before the host, or see --password-file",
    403: "it is forbidden to this name",
    404: "there is no such stream; check the path",
}


class Refused(InputError):
    """The camera is present and refuses the address; waiting does not help."""


def open_or_refuse(target: str | int, name: str, limits_s: tuple[float, float]) -> LiveStream:
    """Open a stream. Raise Refused if the server answers 401, 403 or 404, else InputError."""
    try:
        return open_stream(target, name, limits_s)
    except InputError:
        status = answered_status(target, limits_s[1]) if isinstance(target, str) else None
        if status in _MEANING:
            raise Refused(f"{name} is refused ({status}): {_MEANING[status]}") from None
        raise


def answered_status(address: str, limit_s: float) -> int | None:
    """Return the status that an RTSP or HTTP server answers; None without an answer, or for another protocol."""
    try:
        parts = urlsplit(address)
        port = parts.port or _PORTS.get(parts.scheme)
        if port is None or not parts.hostname:
            return None
        host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
        query = f"?{parts.query}" if parts.query else ""
        path = f"{parts.path or '/'}{query}"
        is_rtsp = parts.scheme == "rtsp"
        uri = f"rtsp://{host}:{port}{parts.path}{query}" if is_rtsp else path
        request = f"DESCRIBE {uri} RTSP/1.0\r\nCSeq: 1\r\n" if is_rtsp else f"GET {uri} HTTP/1.0\r\nHost: {host}\r\n"
        where, is_encrypted = (parts.hostname, port), parts.scheme == "https"
        status, headers = _ask(where, is_encrypted, request, limit_s)
        if status == 401 and parts.username is not None:
            user, password = unquote(parts.username), unquote(parts.password or "")
            proof = _authorization(headers, user, password, "DESCRIBE" if is_rtsp else "GET", uri)
            status, _ = _ask(where, is_encrypted, f"{request}Authorization: {proof}\r\n", limit_s)
        return status
    except (OSError, ValueError):
        return None


def _ask(where: tuple[str, int], is_encrypted: bool, request: str, limit_s: float) -> tuple[int | None, str]:
    with socket.create_connection(where, timeout=limit_s) as plain:
        way = _unverified().wrap_socket(plain) if is_encrypted else plain
        way.sendall(f"{request}\r\n".encode())
        answer = b""
        while b"\r\n\r\n" not in answer and len(answer) < _MOST_BYTES and (more := way.recv(4096)):
            answer += more
    text = answer.decode("latin-1")
    first = re.match(r"(?:RTSP|HTTP)/\d\.\d (\d{3})", text)
    return (int(first.group(1)) if first else None), text


def _unverified() -> ssl.SSLContext:
    """Return a context that, like FFmpeg, accepts a camera's own certificate."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


def _authorization(headers: str, user: str, password: str, method: str, uri: str) -> str:
    """Answer a challenge, by Digest if it is offered, else Basic. Source: RFC 2617, without qop (RFC 2069)."""
    digest = re.search(r"(?im)^WWW-Authenticate: *Digest +(.*)$", headers)
    if digest is None:
        return "Basic " + base64.b64encode(f"{user}:{password}".encode()).decode()
    given = dict(re.findall(r'(\w+)="([^"]*)"', digest.group(1)))

    def md5(text: str) -> str:
        return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()

    realm, nonce = given.get("realm", ""), given.get("nonce", "")
    response = md5(f"{md5(f'{user}:{realm}:{password}')}:{nonce}:{md5(f'{method}:{uri}')}")
    return f'Digest username="{user}", realm="{realm}", nonce="{nonce}", uri="{uri}", response="{response}"'
