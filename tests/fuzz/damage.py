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
    "5e-324", "1e-12", "2147483647", "2147483648", "-2147483649", "4294967296", "9223372036854775807", "1e5", "1e10",
    "9223372036854775808", "9007199254740993", "1" + "0" * 40, "9" * 400, "1" * 5000, "0x10", "1_000", "1,5", "1.2.3",
    "1e", "+5", "--5", "٣", "½", "¹", "1e+5", ".", "1/2", "5%", "true", "null", "180", "180.0001", "-90", "361",
)  # fmt: skip
ODD_WORDS = (
    "", " ", "\t", "\0", "\x1b[31m", "\r", "\n", "\r\n", "\x0b", "\x0c", "\x1c", "\x85", "\u2028", "\ufeff", "\u00a0",
    "é", "\ud7ff", "\U0001f600", "\u202e", *"\"'\\#;,=[]{}()<>*$%", '""', '"""', "\\u0000", "\\ud800", "[[", ",,,,",
    "-->", "%s", "%(x)s", "{0}", "..", "/", "../..", "/dev/null", "a" * 300, "[" * 2000, "{a=" * 500, "a." * 500,
    "1979-05-27T07:32:00Z", "00:00:00", "0000-00-00",
)  # fmt: skip
ODD_BYTES = (b"\0", b"\xff", b"\x7f", b"\x80", b"\xfe", bytes(4), b"\xff" * 4, b"\x7f\xff\xff\xff", b"\0\0\0\x01")
_CELL = re.compile(r"[^\s,;:=\[\](){}<>\"'*$]+")
_REWRITES = ((",", ";"), (",", "\t"), (".", ","), ("\n", "\r"), ("\n", "\r\n"), ("\n", ""), ("=", ":"), ("-", ""))


def damaged(seeds: Sequence[bytes], rng: random.Random, text: bool, words: Sequence[str] = ()) -> bytes:
    """One of the seeds after one to six changes. words: what means something to the reader, put in here and there."""

    def odd() -> str:
        return rng.choice(rng.choice((ODD_NUMBERS, ODD_NUMBERS, ODD_WORDS, words or ODD_WORDS)))

    def other_cells(content: str) -> str:
        """One number or word, or all like it, become another; or two change places."""
        cells = list(_CELL.finditer(content))
        if len(cells) < 2:
            return odd()
        a, b = (cells[k] for k in sorted(rng.sample(range(len(cells)), 2)))
        one = content[: a.start()] + odd() + content[a.end() :]
        swapped = content[: a.start()] + b[0] + content[a.end() : b.start()] + a[0] + content[b.end() :]
        return rng.choice((one, one, one, content.replace(a[0], odd(), 50), swapped))

    def put_in(content: str) -> str:
        place = rng.randrange(len(content) + 1)
        return content[:place] + odd() + content[place:]

    def other_lines(content: str) -> str:
        """Lines are lost, repeated, shuffled, joined, or come from another file."""
        lines = content.splitlines(keepends=True) or [""]
        others = rng.choice(seeds).decode("utf-8", "surrogateescape").splitlines(keepends=True) or [""]
        k = rng.randrange(len(lines))
        other, joined, repeated = rng.choice((*others, odd() + "\n")), lines[k].rstrip("\r\n"), rng.choice((2, 3, 101))
        lines[k : k + 1] = rng.choice(
            ([], [joined], [lines[k]] * repeated, [other, lines[k]], rng.sample(lines, len(lines)))
        )
        return "".join(lines)

    def rewritten(content: str) -> str:
        """The whole in other separators, capitals or ends of line."""
        changed = content.replace(*rng.choice(_REWRITES))
        plain = content.replace(" ", "")
        return rng.choice((changed, content.upper(), content.lower(), plain, f"\ufeff{content}", content * 3))

    def cut(content: bytes) -> bytes:
        return content[: rng.randrange(len(content) + 1)]

    def bits(content: bytes) -> bytes:
        changed = bytearray(content)
        for _ in range(rng.choice((1, 1, 3, 30)) if changed else 0):
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        return bytes(changed)

    def other_bytes(content: bytes) -> bytes:
        """A hole, odd bytes in place of others, or noise or a piece of this file or another one between them."""
        place, first = rng.randrange(len(content) + 1), rng.randrange(len(content) + 1)
        piece = rng.choice((content, rng.choice(seeds)))[first : first + rng.choice((1, 4, 16, 200, 2000))]
        noise = rng.choice(ODD_BYTES) * rng.choice((1, 1, 1, 8, 100))
        between = rng.choice((piece * rng.choice((1, 1, 2, 50)), rng.randbytes(rng.randrange(1, 60)), odd().encode()))
        put, skipped = rng.choice(((b"", rng.choice((1, 2, 10, 200))), (noise, len(noise)), (between, 0)))
        return content[:place] + put + content[place + skipped :]

    def other_encoding(content: bytes) -> bytes:
        plain = content.decode("utf-8", "replace")
        marked = (b"\xef\xbb\xbf" + content, b"\xff\xfe" + content)
        return rng.choice((plain.encode("utf-16"), plain.encode("latin-1", "replace"), *marked))

    of_text: tuple[Callable[[str], str], ...] = (*(other_cells,) * 5, put_in, other_lines, other_lines, rewritten)
    of_bytes: tuple[Callable[[bytes], bytes], ...] = (cut, bits, bits, *(other_bytes,) * 4, other_encoding)
    content = rng.choice(seeds)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 6))):
        if text and rng.random() < 0.85:
            changed = rng.choice(of_text)(content.decode("utf-8", "surrogateescape"))
            content = changed.encode("utf-8", "surrogateescape")
        else:
            content = rng.choice(of_bytes)(content)
        content = content[:LONGEST]
    return content
