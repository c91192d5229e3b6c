"""Files that went wrong, made from whole ones; the same seed gives the same file.

Text is damaged as people, editors and other programs do it, bytes as disks, cables and cameras do it.
"""

import random
import re
from collections.abc import Callable, Sequence

LONGEST = 65_536
"""No input is larger, bytes: a reader's time is what is looked at, not the disk's."""

ODD_NUMBERS = (
    "0", "-0", "1", "-1", "2", "0.5", "nan", "NaN", "-nan", "inf", "-inf", "Infinity", "1e308", "-1e308", "1e999",
    "5e-324", "1e-12", "2147483647", "2147483648", "-2147483649", "4294967296", "9223372036854775807",
    "9223372036854775808", "9007199254740993", "1" + "0" * 40, "9" * 400, "1" * 5000, "0x10", "1_000", "1,5", "1.2.3",
    "1e", "+5", "--5", "٣", "½", "¹", "1e+5", ".", "-", "+", "1/2", "5%", "true", "null", "None", "180", "180.0001",
    "-90", "361", "1e5", "1e10",
)  # fmt: skip
ODD_WORDS = (
    "", " ", "\t", "\0", "\x07", "\x1b[31m", "\r", "\n", "\r\n", "\x0b", "\x0c", "\x1c", "\x85", "\u2028", "\ufeff",
    "\u00a0", "é", "\ud7ff", "\U0001f600", "\u202e", '"', '""', "'", '"""', "'''", "\\", "\\u0000", "\\ud800", "#",
    ";", ",", ",,,,", "=", "[", "]", "[[", "]]", "{", "}", "(", ")", "<", ">", "-->", "*", "$", "%", "%s", "%(x)s",
    "{0}", "..", "/", "../..", "/dev/null", "a" * 300, "[" * 2000, "{a=" * 500, "a." * 500, "1979-05-27T07:32:00Z",
    "00:00:00", "0000-00-00",
)  # fmt: skip
ODD_BYTES = (
    b"\0",
    b"\xff",
    b"\x7f",
    b"\x80",
    b"\xfe",
    b"\0\0\0\0",
    b"\xff\xff\xff\xff",
    b"\x7f\xff\xff\xff",
    b"\0\0\0\x01",
)

_CELL = re.compile(r"[^\s,;:=\[\](){}<>\"'*$]+")


def damaged(seeds: Sequence[bytes], rng: random.Random, text: bool, words: Sequence[str] = ()) -> bytes:
    """One of the seeds after one to six changes. words: what means something to the reader, put in here and there."""
    content = rng.choice(seeds)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 6))):
        if text and rng.random() < 0.85:
            content = rng.choice(_OF_TEXT)(content.decode("utf-8", "surrogateescape"), seeds, words, rng).encode(
                "utf-8", "surrogateescape"
            )
        else:
            content = rng.choice(_OF_BYTES)(content, seeds, words, rng)
        content = content[:LONGEST]
    return content


def _odd(words: Sequence[str], rng: random.Random) -> str:
    return rng.choice(rng.choice((ODD_NUMBERS, ODD_NUMBERS, ODD_WORDS, words or ODD_WORDS)))


def _place(content: str | bytes, rng: random.Random) -> int:
    return rng.randrange(len(content) + 1)


# -- Text --------------------------------------------------------------------------------------------------------------


def _cell(text: str, seeds: Sequence[bytes], words: Sequence[str], rng: random.Random) -> str:
    """A number or word becomes another."""
    cells = list(_CELL.finditer(text))
    if not cells:
        return _odd(words, rng)
    cell = rng.choice(cells)
    return text[: cell.start()] + _odd(words, rng) + text[cell.end() :]


def _same_cells(text: str, seeds: Sequence[bytes], words: Sequence[str], rng: random.Random) -> str:
    """A word or number becomes another wherever it stands."""
    cells = _CELL.findall(text)
    return text.replace(rng.choice(cells), _odd(words, rng), 50) if cells else text


def _cells_change_places(text: str, seeds: Sequence[bytes], words: Sequence[str], rng: random.Random) -> str:
    cells = list(_CELL.finditer(text))
    if len(cells) < 2:
        return text
    first, second = sorted(rng.sample(range(len(cells)), 2))
    a, b = cells[first], cells[second]
    return text[: a.start()] + b[0] + text[a.end() : b.start()] + a[0] + text[b.end() :]


def _put_in(text: str, seeds: Sequence[bytes], words: Sequence[str], rng: random.Random) -> str:
    place = _place(text, rng)
    return text[:place] + _odd(words, rng) + text[place:]


def _lines(text: str, seeds: Sequence[bytes], words: Sequence[str], rng: random.Random) -> str:
    """Lines are lost, doubled, shuffled, joined, or come from another file."""
    lines = text.splitlines(keepends=True)
    if not lines:
        return text
    kind, k = rng.randrange(7), rng.randrange(len(lines))
    if kind == 0:
        del lines[k]
    elif kind == 1:
        lines[k:k] = [lines[k]] * rng.choice((1, 2, 100))
    elif kind == 2:
        rng.shuffle(lines)
    elif kind == 3:
        lines[k] = lines[k].rstrip("\r\n")
    elif kind == 4:
        lines.insert(
            k, rng.choice(rng.choice(seeds).decode("utf-8", "surrogateescape").splitlines(keepends=True) or [""])
        )
    elif kind == 5:
        lines.insert(k, _odd(words, rng) + "\n")
    else:
        del lines[k : k + rng.randrange(1, len(lines) + 1)]
    return "".join(lines)


def _rewritten(text: str, seeds: Sequence[bytes], words: Sequence[str], rng: random.Random) -> str:
    """The whole in other separators, capitals or ends of line."""
    old, new = rng.choice(
        ((",", ";"), (",", "\t"), (".", ","), ("\n", "\r"), ("\n", "\r\n"), ("\n", ""), ("=", ":"), ("-", ""))
    )
    return rng.choice(
        (text.replace(old, new), text.upper(), text.lower(), text.replace(" ", ""), f"\ufeff{text}", text * 3)
    )


# -- Bytes -------------------------------------------------------------------------------------------------------------


def _cut(content: bytes, seeds: Sequence[bytes], words: Sequence[str], rng: random.Random) -> bytes:
    return content[: _place(content, rng)]


def _hole(content: bytes, seeds: Sequence[bytes], words: Sequence[str], rng: random.Random) -> bytes:
    place = _place(content, rng)
    return content[:place] + content[place + rng.choice((1, 2, 10, 200)) :]


def _bits(content: bytes, seeds: Sequence[bytes], words: Sequence[str], rng: random.Random) -> bytes:
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 3, 30)) if changed else 0):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _overwritten(content: bytes, seeds: Sequence[bytes], words: Sequence[str], rng: random.Random) -> bytes:
    odd = rng.choice(ODD_BYTES) * rng.choice((1, 1, 1, 8, 100))
    place = _place(content, rng)
    return content[:place] + odd + content[place + len(odd) :]


def _inserted(content: bytes, seeds: Sequence[bytes], words: Sequence[str], rng: random.Random) -> bytes:
    place = _place(content, rng)
    odd = rng.choice((rng.choice(ODD_BYTES), rng.randbytes(rng.randrange(1, 60)), _odd(words, rng).encode()))
    return content[:place] + odd + content[place:]


def _copied(content: bytes, seeds: Sequence[bytes], words: Sequence[str], rng: random.Random) -> bytes:
    """A piece of it, or of another file, stands somewhere else once more, or many times."""
    other = rng.choice((content, rng.choice(seeds)))
    first, place = _place(other, rng), _place(content, rng)
    piece = other[first : first + rng.choice((1, 4, 16, 200, 2000))]
    return content[:place] + piece * rng.choice((1, 1, 2, 50)) + content[place:]


def _other_encoding(content: bytes, seeds: Sequence[bytes], words: Sequence[str], rng: random.Random) -> bytes:
    text = content.decode("utf-8", "replace")
    return rng.choice(
        (text.encode("utf-16"), text.encode("latin-1", "replace"), b"\xef\xbb\xbf" + content, b"\xff\xfe" + content)
    )


_Text = Callable[[str, Sequence[bytes], Sequence[str], random.Random], str]
_Bytes = Callable[[bytes, Sequence[bytes], Sequence[str], random.Random], bytes]
_OF_TEXT: tuple[_Text, ...] = (
    _cell, _cell, _cell, _cell, _same_cells, _cells_change_places, _put_in, _lines, _lines, _rewritten,
)  # fmt: skip
_OF_BYTES: tuple[_Bytes, ...] = (
    _cut, _hole, _bits, _bits, _overwritten, _overwritten, _inserted, _copied, _other_encoding,
)  # fmt: skip
