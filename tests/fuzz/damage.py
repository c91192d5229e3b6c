"""Files that went wrong, made from whole ones; the same seed gives the same file.

Text is damaged as people, editors and other programs do it, bytes as disks, cables and cameras do it.
"""

import random
import re
from collections.abc import Callable, Sequence

LONGEST = 65_536
"""Largest input, bytes: the reader's time is measured, not the disk's."""

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
ODD_BYTES = (b"\0", b"\xff", b"\x7f", b"\x80", b"\xfe", bytes(4), b"\xff" * 4, b"\x7f\xff\xff\xff", b"\0\0\0\x01")
_CELL = re.compile(r"[^\s,;:=\[\](){}<>\"'*$]+")
_REWRITES = ((",", ";"), (",", "\t"), (".", ","), ("\n", "\r"), ("\n", "\r\n"), ("\n", ""), ("=", ":"), ("-", ""))


class Damage:
    """Ways in which content breaks. seeds: whole files. words: what means something to the reader."""

    def __init__(self, seeds: Sequence[bytes], rng: random.Random, words: Sequence[str]) -> None:
        self.seeds, self.rng, self.words = seeds, rng, words

    def odd(self) -> str:
        return self.rng.choice(self.rng.choice((ODD_NUMBERS, ODD_NUMBERS, ODD_WORDS, self.words or ODD_WORDS)))

    def place(self, content: str | bytes) -> int:
        return self.rng.randrange(len(content) + 1)

    def cell(self, text: str) -> str:
        """A number or word becomes another."""
        cells = list(_CELL.finditer(text))
        if not cells:
            return self.odd()
        cell = self.rng.choice(cells)
        return text[: cell.start()] + self.odd() + text[cell.end() :]

    def same_cells(self, text: str) -> str:
        cells = _CELL.findall(text)
        return text.replace(self.rng.choice(cells), self.odd(), 50) if cells else text

    def swapped_cells(self, text: str) -> str:
        cells = list(_CELL.finditer(text))
        if len(cells) < 2:
            return text
        a, b = (cells[k] for k in sorted(self.rng.sample(range(len(cells)), 2)))
        return text[: a.start()] + b[0] + text[a.end() : b.start()] + a[0] + text[b.end() :]

    def put_in(self, text: str) -> str:
        place = self.place(text)
        return text[:place] + self.odd() + text[place:]

    def lines(self, text: str) -> str:
        """Lines are lost, repeated, shuffled, joined, or come from another file."""
        lines, rng = text.splitlines(keepends=True), self.rng
        if not lines:
            return text
        k = rng.randrange(len(lines))
        other = rng.choice(self.seeds).decode("utf-8", "surrogateescape").splitlines(keepends=True)
        lines[k : k + 1] = rng.choice(
            (
                [],
                [lines[k]] * rng.choice((2, 3, 101)),
                rng.sample(lines, len(lines)),
                [lines[k].rstrip("\r\n")],
                [rng.choice(other or [""]), lines[k]],
                [self.odd() + "\n", lines[k]],
            )
        )
        return "".join(lines if rng.random() < 0.85 else lines[:k] + lines[k + rng.randrange(1, len(lines) + 2) :])

    def rewritten(self, text: str) -> str:
        """The whole in other separators, capitals or ends of line."""
        changed = text.replace(*self.rng.choice(_REWRITES))
        return self.rng.choice((changed, text.upper(), text.lower(), text.replace(" ", ""), f"\ufeff{text}", text * 3))

    def cut(self, content: bytes) -> bytes:
        return content[: self.place(content)]

    def hole(self, content: bytes) -> bytes:
        place = self.place(content)
        return content[:place] + content[place + self.rng.choice((1, 2, 10, 200)) :]

    def bits(self, content: bytes) -> bytes:
        changed = bytearray(content)
        for _ in range(self.rng.choice((1, 1, 3, 30)) if changed else 0):
            changed[self.rng.randrange(len(changed))] ^= 1 << self.rng.randrange(8)
        return bytes(changed)

    def overwritten(self, content: bytes) -> bytes:
        odd = self.rng.choice(ODD_BYTES) * self.rng.choice((1, 1, 1, 8, 100))
        place = self.place(content)
        return content[:place] + odd + content[place + len(odd) :]

    def inserted(self, content: bytes) -> bytes:
        """Bytes of any kind, or a piece of this file or another one, once or many times."""
        rng, place = self.rng, self.place(content)
        other = rng.choice((content, rng.choice(self.seeds)))
        first = self.place(other)
        piece = other[first : first + rng.choice((1, 4, 16, 200, 2000))] * rng.choice((1, 1, 2, 50))
        noise = rng.randbytes(rng.randrange(1, 60))
        return content[:place] + rng.choice((piece, piece, noise, self.odd().encode())) + content[place:]

    def other_encoding(self, content: bytes) -> bytes:
        text = content.decode("utf-8", "replace")
        marked = (b"\xef\xbb\xbf" + content, b"\xff\xfe" + content)
        return self.rng.choice((text.encode("utf-16"), text.encode("latin-1", "replace"), *marked))


def damaged(seeds: Sequence[bytes], rng: random.Random, text: bool, words: Sequence[str] = ()) -> bytes:
    """One of the seeds after one to six changes. words: what means something to the reader, put in here and there."""
    content, do = rng.choice(seeds), Damage(seeds, rng, words)
    of_text: tuple[Callable[[str], str], ...] = (
        do.cell, do.cell, do.cell, do.cell, do.same_cells, do.swapped_cells, do.put_in, do.lines, do.lines,
        do.rewritten,
    )  # fmt: skip
    of_bytes: tuple[Callable[[bytes], bytes], ...] = (
        do.cut, do.hole, do.bits, do.bits, do.overwritten, do.overwritten, do.inserted, do.inserted, do.other_encoding,
    )  # fmt: skip
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 6))):
        if text and rng.random() < 0.85:
            words_damaged = rng.choice(of_text)(content.decode("utf-8", "surrogateescape"))
            content = words_damaged.encode("utf-8", "surrogateescape")
        else:
            content = rng.choice(of_bytes)(content)
        content = content[:LONGEST]
    return content
