"""Opens the streams of `--emit`, such as `json:-` or `cot:udp://239.2.3.1:6969`."""

import os
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.streams.datagrams import DatagramOutlet, parse_address
from torchvision_dddas.io.streams.json_lines import json_lines
from torchvision_dddas.io.streams.line_outlet import LineOutlet
from torchvision_dddas.io.streams.stream import About, Encoder, Notify, Outlet, Stream
from torchvision_dddas.io.streams.tool_messages import CotEvents, mot_rows

WANTED = "wanted json, mot or cot, a colon, and - for standard output, a FILE or udp://HOST:PORT, as in json:-"

_BEGINS = {"json": b"{", "mot": b"0123456789", "cot": b"<"}
_MOST_WAIT_S = 2.0  # a datagram costs nothing to try


def open_stream(
    text: str, about: About, notify: Notify, retry_s: float = 0.5, retry_most_s: float = 30.0, option: str = "--emit"
) -> Stream:
    """Open a stream. notify: called when it breaks and when it works again. retry_s, retry_most_s: as in Stream.

    Raises InputError: an unknown kind, a file that cannot be written or holds something else, an unknown host, or
    events without places or a clock.
    """
    kind, colon, place = text.partition(":")
    datagrams = _is_address(place)
    if kind not in _BEGINS or not colon or not place or ("://" in place and not datagrams):
        raise InputError(f"{option} {text!r} is no stream; {WANTED}")
    encode = _encoder(kind, about, f"{option} {text}")
    try:
        outlet: Outlet
        if datagrams:
            outlet = DatagramOutlet(parse_address(place, f"{option} {text}"))
        else:
            outlet = _lines(place, kind, f"{option} {text}")
    except OSError as error:
        raise InputError(f"{option} {text}: {error.strerror or error}; choose another place") from None
    return Stream(text, encode, outlet, notify, retry_s, min(retry_most_s, _MOST_WAIT_S) if datagrams else retry_most_s)


def open_streams(
    texts: Sequence[str],
    about: About,
    notify: Notify,
    retry_s: float = 0.5,
    retry_most_s: float = 30.0,
    option: str = "--emit",
) -> list[Stream]:
    """Open all streams or none. Raises InputError as open_stream does, and if two would write to one file."""
    places: dict[str, str] = {}
    for text in texts:
        place = text.partition(":")[2]
        if _is_address(place):
            continue
        real = place if place == "-" else os.path.realpath(_path(place, f"{option} {text}"))
        if real in places:
            raise InputError(
                f"{option} {places[real]} and {option} {text} go to the same place; choose another for one"
            )
        places[real] = text
    with ExitStack() as opened:
        streams = []
        for text in texts:
            streams.append(open_stream(text, about, notify, retry_s, retry_most_s, option))
            opened.callback(streams[-1].close)
        opened.pop_all()
    return streams


def _is_address(place: str) -> bool:
    return place.lower().startswith("udp:")


def _path(place: str, asked: str) -> Path:
    try:
        if "\0" in place:
            raise ValueError("a zero byte is in no file's name")
        return Path(place).expanduser()
    except (RuntimeError, ValueError) as error:  # ~nobody
        raise InputError(f"{asked!r}: {error}; choose another place") from None


def _encoder(kind: str, about: About, asked: str) -> Encoder:
    if kind == "json":
        return lambda result, people, age_s, most_bytes: json_lines(result, people, about, age_s, most_bytes)
    if kind == "mot":
        return lambda result, people, age_s, most_bytes: mot_rows(result, people, most_bytes)
    if not about.geographic:
        raise InputError(
            f"{asked}: such events need longitudes and latitudes; give --landmarks or --telemetry in degrees, or "
            "emit json instead"
        )
    if not about.clock:
        raise InputError(f"{asked}: such events need the time of day, and neither input nor telemetry tells it")
    events = CotEvents(about)
    return lambda result, people, age_s, most_bytes: events(result)


def _lines(place: str, kind: str, asked: str) -> Outlet:
    if place == "-":
        if sys.__stdout__ is None:
            raise OSError("standard output is closed")
        return LineOutlet(None)
    path = _path(place, asked)
    if path.is_file() and os.access(path, os.R_OK):
        with path.open("rb") as file:
            first = file.read(1)
        if first not in _BEGINS[kind]:  # of an empty file nothing is in all
            raise InputError(f"{asked}: the file holds something else than {kind}; choose another file")
    return LineOutlet(path)
