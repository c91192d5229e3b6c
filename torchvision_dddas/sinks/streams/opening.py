"""What a user asks for in one word, `json:-` or `cot:udp://239.2.3.1:6969`, as a stream."""

import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.sinks.streams.about import About
from torchvision_dddas.sinks.streams.json_lines import json_lines
from torchvision_dddas.sinks.streams.line_outlet import LineOutlet
from torchvision_dddas.sinks.streams.outlet import Outlet
from torchvision_dddas.sinks.streams.stream import Encoder, Stream, Tell

KINDS = ("json", "mot", "cot")
WANTED = "wanted json, mot or cot, a colon, and - for standard output, a FILE or udp://HOST:PORT, as in json:-"


def open_stream(
    text: str, about: About, tell: Tell, retry_s: float = 0.5, retry_most_s: float = 30.0, option: str = "--emit"
) -> Stream:
    """The stream that a user asks for. tell: called with `sink` and words when something is wrong, and when it is well.

    retry_s, retry_most_s: a broken outlet is tried again after the first, then twice that, up to the second.
    Raises InputError with one line: not such a word, a file that cannot be written, a host that is not known.
    """
    kind, colon, place = text.partition(":")
    if kind not in KINDS or not colon or not place:
        raise InputError(f"{option} {text!r} is no stream; {WANTED}")
    encode = _encoder(kind, about)
    try:
        outlet = _outlet(place)
    except OSError as error:
        raise InputError(
            f"{option} {text}: cannot write {place}: {error.strerror or error}; choose another place"
        ) from None
    return Stream(text, encode, outlet, tell, retry_s, retry_most_s)


def open_streams(
    texts: Sequence[str],
    about: About,
    tell: Tell,
    retry_s: float = 0.5,
    retry_most_s: float = 30.0,
    option: str = "--emit",
) -> list[Stream]:
    """Several, all or none. Raises InputError as open_stream does, and where two would write to the same place."""
    streams: list[Stream] = []
    try:
        streams.extend(open_stream(text, about, tell, retry_s, retry_most_s, option) for text in texts)
    except BaseException:
        for stream in streams:
            with suppress(Exception):
                stream.close()
        raise
    return streams


def _encoder(kind: str, about: About) -> Encoder:
    encoders: dict[str, Callable[[], Encoder]] = {
        "json": lambda: lambda surveyed, people, age_s, most: json_lines(surveyed, people, about, age_s, most),
    }
    return encoders[kind]()


def _outlet(place: str) -> Outlet:
    if place == "-":
        if sys.__stdout__ is None:
            raise OSError("standard output is closed")
        return LineOutlet(None)
    return LineOutlet(Path(place).expanduser())
