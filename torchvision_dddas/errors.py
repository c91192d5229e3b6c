"""InputError, the error for mistakes of the user, and functions that make names and addresses safe to print."""

import re
from unicodedata import category

LONGEST = 1000
"""Largest number of characters of a message. Longer messages are shortened, because input may have any length."""

_END = 300  # characters kept from the end of a long message, because the end says what to do


# Each of these patterns needs time in proportion to the length of the text: the names in them have bounded lengths.
# A login stands between the scheme and the last @ if there is a colon or no path in between; a password may contain /.
_LOGIN = re.compile(r"((?:^|(?<=[\s'\"(=/]))[a-z][\w+.-]{0,30}:/+|[a-z][\w+.-]{0,30}://)(?:[^/?#]*:.*|[^/?#]*)@", re.I)
# user:password@host in a word, for addresses whose scheme is missing or mistyped.
_WORD = re.compile(r"\S+")
_BARE_LOGIN = re.compile(r"(?:^|(?<=['\"(])|(?<=//))[^/:@'\"(]+:(?!/).*@")
# The scheme of an address. A path object reduces :// to :/.
_SCHEME = re.compile(r"://|(?:https?|rtsps?|rtmps?|srt|tcp|udp|ftps?):/", re.I)
# Keys of secrets in a query. Some cameras also have user=NAME_password=WORD in their path.
_SECRET_KEY = re.compile(
    r"((?:(?<=[?&;/])(?:[^\s=?&;/]{0,60}(?:pass|pwd|psw|token|secret|auth|key|sig|cred|session)[^\s=?&;/]{0,60}"
    r"|[^\s=?&;/]{0,60}pas|p|pw|pin|otp|sas|jwt|code)|(?<=_)(?:password|passwd|pass|pwd))=)(?!\*\*\*(?:[^\w]|$))[^&]+",
    re.I,
)
# All other values of a query, up to a blank, unless the key is known to be harmless.
_OTHER_KEY = re.compile(
    r"((?<=[?&;])(?!(?:(?:rtsp_)?transport|timeout|stimeout|port|rate|fps|framerate|width|height|size|resolution|channel"
    r"|camera|stream|subtype|profile|codec|video|audio|format|quality|mode|latency|ttl|hops|bytes|interface|localaddr"
    r"|pkt_size|fifo_size|buffer_size|overrun_nonfatal)=)[^\s=?&;/]+=)[^&\s]*[^&\s'\".,;:)]",
    re.I,
)
_HIDDEN = r"\1***"


def without_secrets(text: str) -> str:
    """Remove the user names and passwords of addresses from a text.

    `user:password@` is removed. In a query the value of `password=` is replaced by ***, and so is any other value
    unless its key is known to be harmless, as in `?stream=2`. A password may contain any character: if it is unclear
    whether an @ ends a password, everything before the @ is removed; in a query, everything from the secret to the
    next & or the end of the line is replaced. A second call does not change the result.
    """
    if "@" not in text and (":/" not in text or "=" not in text):
        return text
    return "\n".join(_without_secrets(line) for line in text.split("\n"))


def _without_secrets(line: str) -> str:
    before, at, after = line.rpartition("@")
    line = _LOGIN.sub(r"\1", before + at) + after
    line = _WORD.sub(_without_login, line)
    scheme = _SCHEME.search(line)
    if scheme is None:
        return line
    rest = _SECRET_KEY.sub(_HIDDEN, line[scheme.end() :])
    return line[: scheme.end()] + _OTHER_KEY.sub(_HIDDEN, rest)


def _without_login(word: re.Match[str]) -> str:
    before, at, after = word[0].rpartition("@")
    return _BARE_LOGIN.sub("", before + at) + after


def readable(text: str) -> str:
    r"""Return a text that can be encoded as UTF-8. Bytes of a file name that are not UTF-8 are shown as `\xff`."""
    if text.isascii():
        return text
    try:
        return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    except UnicodeEncodeError:  # the text has a lone surrogate that does not stand for a byte of a name
        return text.encode("utf-8", "backslashreplace").decode("utf-8")


class InputError(ValueError):
    """Bad input, described in one line: what came, what was wanted, what to do. The command line exits with code 2.

    Line feeds are replaced by spaces, and control characters and lone surrogates by their codes. Passwords and the
    middle of a very long line are removed.

    >>> issubclass(td.InputError, ValueError)
    True
    """

    def __init__(self, text: object = "") -> None:
        super().__init__(_line(readable(without_secrets(str(text)))))


class LostInputError(InputError):
    """The input stopped before its end. The results up to that point are kept."""


def _line(text: str) -> str:
    if not text.isprintable():
        text = "".join(map(_shown, " ".join(text.splitlines()).replace("\t", " ")))
    return text if len(text) <= LONGEST else f"{text[: LONGEST - _END - 5]} ... {text[-_END:]}"


def printable(text: str) -> str:
    """Replace control characters and lone surrogates in a text by their codes; keep line feeds and spaces."""
    if text.isprintable():
        return text
    text = readable(text)
    return "".join(letter if letter == "\n" or category(letter) == "Zs" else _shown(letter) for letter in text)


def _shown(letter: str) -> str:
    return letter if letter.isprintable() else letter.encode("unicode_escape").decode("ascii")
