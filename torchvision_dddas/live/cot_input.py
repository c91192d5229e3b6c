"""Places of landmarks from Cursor-on-Target events, as TAK clients, servers and vehicles send them."""

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from xml.etree import ElementTree

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.mavlink_link import port_opener
from torchvision_dddas.live.report_inputs import Lines, Notify

# A user may write cot:udp://HOST:PORT, as for --emit. Path makes cot:udp:/HOST:PORT of it.
_FORM = re.compile(r"cot:(udp|tcp):/{0,2}([^?/]+:\d{1,5})(?:\?(.*))?")
_BEGIN, _END = re.compile(rb"<event[\s>]"), b"</event>"
_PLACE = {"longitude_deg": "lon", "latitude_deg": "lat"}
_LONGEST = 1 << 16
_UNKNOWN_M = 9_999_999.0
_HIGHEST_PORT = 65535


class CotInput(Lines):
    """Events from a port, as lines of JSON with the place of a landmark. Events of other senders are left out."""

    def __init__(self, text: str, notify: Notify) -> None:
        """text: `cot:udp:HOST:PORT?NAME=UID`, with the uid or callsign of each landmark. Raise InputError."""
        found = _FORM.fullmatch(text)
        pairs = [part.partition("=") for part in (found[3] or "").split("&")] if found is not None else []
        names, uids = {name for name, _, _ in pairs}, {uid for _, _, uid in pairs}
        is_known = bool(pairs) and "" not in names | uids
        if found is None or not is_known or int(found[2].rpartition(":")[2]) > _HIGHEST_PORT:
            raise InputError(
                f"--landmarks {text}: wanted cot:udp:HOST:PORT or cot:tcp:HOST:PORT with the uid or callsign of each "
                "landmark, such as cot:udp:0.0.0.0:4242?ugv1=ALPHA&ugv2=BRAVO"
            )
        if not len(names) == len(uids) == len(pairs):
            raise InputError(f"--landmarks {text}: name each landmark and each uid only once")
        self.names: Mapping[str, str] = {uid: name for name, _, uid in pairs}
        opener = port_opener(found[1], found[2], f"--landmarks {text}")
        super().__init__(text, opener, notify, option="--landmarks")

    def _reports(self, content: bytes) -> Iterator[bytes]:
        *events, self._rest = (self._rest + content).split(_END)
        for event in events:
            starts = [found.start() for found in _BEGIN.finditer(event)]
            if len(starts) > 1:  # the earlier event was cut off
                yield event[: starts[-1]]
                event = event[starts[-1] :]
            yield from self._read(event.lstrip() + _END)
        if len(self._rest) > _LONGEST or self._rest[:1] == b"\xbf":  # TAK's binary form, or no event
            yield self._rest[:_LONGEST]
            self._rest = b""

    def _read(self, content: bytes) -> Iterator[bytes]:
        """Yield the report of a landmark, and yield a damaged event as it is, so that the caller reports it."""
        try:
            if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
                raise ValueError
            event = ElementTree.fromstring(content)
            point, contact = event.find("point"), event.find("detail/contact")
            told = event.get("uid", ""), "" if contact is None else contact.get("callsign", "")
            name = next((self.names[own] for own in told if own in self.names), "")
            if not name or not event.get("type", "").startswith("a-") or point is None:
                return
            at = {column: float(point.attrib[key]) for column, key in _PLACE.items()}
            if not any(at.values()):  # a client without a fix sends 0, 0
                raise ValueError
        except (ElementTree.ParseError, ValueError, LookupError):  # the last also for an unknown encoding
            yield content
            return
        row: dict[str, object] = {"landmark": name, **at}
        with suppress(ValueError, KeyError):
            when = datetime.fromisoformat(event.attrib["time"])
            row["time_s"] = (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
        with suppress(ValueError, KeyError):
            if 0 < (sigma_m := float(point.attrib["ce"])) < _UNKNOWN_M:
                row["sigma_m"] = sigma_m
        yield json.dumps(row).encode()
