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

# Two slashes may stand before the host, as for --emit; in a path there is one of them.
_FORM = re.compile(r"cot:(udp|tcp):/{0,2}([^?/]+:\d{1,5})(?:\?(.*))?")
_END = b"</event>"
_PLACE = {"longitude_deg": "lon", "latitude_deg": "lat"}
_LONGEST = 1 << 16
_UNKNOWN_M = 9_999_999.0


class CotInput(Lines):
    """Events from a port, as lines of JSON with the place of a landmark. Events of other senders are left out."""

    def __init__(self, text: str, notify: Notify) -> None:
        """text: `cot:udp:HOST:PORT?NAME=UID`, with the uid or callsign of each landmark. Raise InputError."""
        found = _FORM.fullmatch(text)
        pairs = [part.partition("=") for part in (found[3] or "").split("&")] if found is not None else []
        if found is None or not all(name and uid for name, _, uid in pairs):
            raise InputError(
                f"--landmarks {text}: wanted cot:udp:HOST:PORT or cot:tcp:HOST:PORT with the uid or callsign of each "
                "landmark, such as cot:udp:0.0.0.0:4242?ugv1=ALPHA&ugv2=BRAVO"
            )
        self.names: Mapping[str, str] = {uid: name for name, _, uid in pairs}
        super().__init__(text, port_opener(found[1], found[2], f"--landmarks {text}"), notify)

    def _reports(self, content: bytes) -> Iterator[bytes]:
        *events, self._rest = (self._rest + content).split(_END)
        for event in events:
            yield from self._read(event.lstrip() + _END)
        if len(self._rest) > _LONGEST or self._rest[:1] == b"\xbf":  # TAK's binary form, or no event
            yield self._rest[:_LONGEST]
            self._rest = b""

    def _read(self, content: bytes) -> Iterator[bytes]:
        """Yield the report of a landmark; a damaged event is yielded as it is, so that it is told."""
        try:
            if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
                raise ValueError
            event = ElementTree.fromstring(content)
            point, contact = event.find("point"), event.find("detail/contact")
            told = event.get("uid", ""), "" if contact is None else contact.get("callsign", "")
            name = next((self.names[one] for one in told if one in self.names), "")
            if not name or not event.get("type", "").startswith("a-") or point is None:
                return
            at = {
                column: float(point.attrib[key]) for column, key in (("longitude_deg", "lon"), ("latitude_deg", "lat"))
            }
        except (ElementTree.ParseError, ValueError, KeyError):
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
