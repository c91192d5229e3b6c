"""The one error that a user's mistake raises; and what any message, table or page may show of a name or an address."""

import re
from unicodedata import category

LONGEST = 1000
"""Characters of a message; what came may have been of any length."""

_END = 300  # of these, those that are kept of its end, which says what to do


# Each of these needs time in proportion to a text's length: names are bounded, and a search for an @ finds one.
# Between a scheme and the last @ stands who logs in, if there is a colon or no path in between: a password may hold /.
_LOGIN = re.compile(r"((?:^|(?<=[\s'\"(=/]))[a-z][\w+.-]{0,30}:/+|[a-z][\w+.-]{0,30}://)(?:[^/?#]*:.*|[^/?#]*)@", re.I)
# user:password@host in a word, as it is written where the scheme is forgotten or mistyped.
_WORD = re.compile(r"\S+")
_BARE_LOGIN = re.compile(r"(?:^|(?<=['\"(])|(?<=//))[^/:@'\"(]+:(?!/).*@")
# A path has one slash of two.
_SCHEME = re.compile(r"://|(?:https?|rtsps?|rtmps?|srt|tcp|udp|ftps?):/", re.I)
# Cameras also have user=NAME_password=WORD in their path.
_SECRET_KEY = re.compile(
    r"((?:(?<=[?&;/])(?:[^\s=?&;/]{0,60}(?:pass|pwd|psw|token|secret|auth|key|sig|cred|session)[^\s=?&;/]{0,60}"
    r"|[^\s=?&;/]{0,60}pas|p|pw|pin|otp|sas|jwt|code)|(?<=_)(?:password|passwd|pass|pwd))=)(?!\*\*\*(?:[^\w]|$))[^&]+",
    re.I,
)
# Of a query any other value too, up to a blank, unless its key is known to tell of no secret.
_OTHER_KEY = re.compile(
    r"((?<=[?&;])(?!(?:(?:rtsp_)?transport|timeout|stimeout|port|rate|fps|framerate|width|height|size|resolution|channel"
    r"|camera|stream|subtype|profile|codec|video|audio|format|quality|mode|latency|ttl|hops|bytes|interface|localaddr"
    r"|pkt_size|fifo_size|buffer_size|overrun_nonfatal)=)[^\s=?&;/]+=)[^&\s]*[^&\s'\".,;:)]",
    re.I,
)
_HIDDEN = r"\1***"


def without_secrets(text: str) -> str:
    """A text without the names and passwords of its addresses: `user:password@` is left out, `?password=` says ***.

    So does any other value of a query whose key is not known to tell of no secret, as `?stream=2` does. A password may
    hold any sign. Where it cannot be known whether an @ ends one, all before it is left out, and of a query all from
    its secret to the next & or the end of the line. What was hidden once keeps the words that follow.
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
    r"""A text that any encoding of Unicode holds: bytes of a file's name that are no UTF-8 are shown as `\xff`."""
    if text.isascii():
        return text
    try:
        return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    except UnicodeEncodeError:  # half a character that is no byte of a name either
        return text.encode("utf-8", "backslashreplace").decode("utf-8")


class InputError(ValueError):
    """Bad input in one clear line: what came, what was wanted, what to do. The command line exits with 2 on it.

    What came may hold line feeds, what steers a terminal, or half a character: such is shown by its number. The middle
    of an endless line is left out, and so are passwords.
    """

    def __init__(self, text: object = "") -> None:
        super().__init__(_line(readable(without_secrets(str(text)))))


class LostInputError(InputError):
    """The input stopped before its end. What came until then is kept."""


def _line(text: str) -> str:
    if not text.isprintable():
        text = "".join(map(_shown, " ".join(text.splitlines()).replace("\t", " ")))
    return text if len(text) <= LONGEST else f"{text[: LONGEST - _END - 5]} ... {text[-_END:]}"


def printable(text: str) -> str:
    """The text with its line feeds and spaces; what steers a terminal, or is no UTF-8, by its number."""
    if text.isprintable():
        return text
    text = readable(text)
    return "".join(letter if letter == "\n" or category(letter) == "Zs" else _shown(letter) for letter in text)


def _shown(letter: str) -> str:
    return letter if letter.isprintable() else letter.encode("unicode_escape").decode("ascii")
