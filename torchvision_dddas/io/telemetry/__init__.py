"""Read the reports of a vehicle, from any recorder, as one record.

Supported: own tables, DJI's subtitles, logs of MAVLink, PX4 and ArduPilot, MISB ST 0601 inside MPEG-TS, NMEA 0183, and
the metadata of still pictures. The content of a file, and then its name, determine its kind.
"""

import codecs
import re
from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry import dataflash, photos, px4
from torchvision_dddas.io.telemetry.autopilots import NAMES as MAVLINK_NAMES
from torchvision_dddas.io.telemetry.clocks import parse_time_zone
from torchvision_dddas.io.telemetry.mavlink import looks_like_tlog, message_parts, read_tlog
from torchvision_dddas.io.telemetry.misb import KEY, read_misb, spacing
from torchvision_dddas.io.telemetry.misb_packets import encode_flight, mapped
from torchvision_dddas.io.telemetry.newest import ReportWindow, kind_of_report, split_reports
from torchvision_dddas.io.telemetry.nmea import SENTENCE, read_nmea
from torchvision_dddas.io.telemetry.record import KINDS, is_clock
from torchvision_dddas.io.telemetry.tables import read_telemetry_table
from torchvision_dddas.io.telemetry.text_logs import read_subtitles
from torchvision_dddas.io.telemetry.vmti import VMTI, VmtiTarget, encode_vmti
from torchvision_dddas.types import Telemetry

__all__ = [
    "MAVLINK_NAMES",
    "VMTI",
    "ReportWindow",
    "VmtiTarget",
    "encode_flight",
    "encode_vmti",
    "is_clock",
    "kind_of_report",
    "mapped",
    "message_parts",
    "read_telemetry",
    "split_reports",
]

_STREAMS = {".ts": (188, 0), ".mpg": (188, 0), ".m2ts": (192, 4), ".mts": (192, 4)}


def read_telemetry(
    path: str | Path,
    *,
    clock_offset_s: float = 0.0,
    clip: str | Path | None = None,
    time_zone: str = "",
    order: str = "auto",
    rate_hz: float | None = None,
) -> Telemetry:
    r"""Read the reports of a vehicle. clock_offset_s: added to its times so that they count from the first frame.

    path: a file, or a folder of still pictures. clip: the video that the log belongs to. rate_hz: its frames a second.
    Tables with frame numbers but no times, and folders of pictures, need clip or rate_hz. time_zone: the zone of dates
    without a zone, a name of the IANA data base or hours from UTC; "" leaves their clock unknown. order: "lat-lon" or
    "lon-lat" for two coordinates in one field; by default the numbers or the dialect decide.
    Raise InputError in one line if the file cannot be read or has no usable data. The readable part of a damaged file
    is returned, and its notes say what is missing.

    >>> written = pathlib.Path("log.csv").write_text("time_s,altitude_m,speed_m_s\n0,40,5\n1,42,5\n")
    >>> td.read_telemetry("log.csv").at(0.5).altitude_m
    41.0
    """
    path, clip = Path(path), Path(clip) if clip is not None else None
    zone = parse_time_zone(time_zone)
    if path.is_dir():
        return photos.read_photos(path, clock_offset_s, clip, rate_hz, zone)
    try:
        with path.open("rb") as file:
            beginning = file.read(1 << 16)
    except OSError as error:
        raise InputError(f"telemetry {path} cannot be read: {error.strerror}") from None
    head, suffix = beginning[:4096], path.suffix.lower()
    if not head.strip() and suffix != ".csv":
        raise InputError(f"telemetry {path} is empty; give {KINDS}")
    if head.startswith(photos.MAGIC):
        return photos.read_photos(path, clock_offset_s, clip, rate_hz, zone)
    if head.startswith(px4.MAGIC):
        return px4.read_ulog(path, clock_offset_s)
    if dataflash.MAGIC in head:
        return dataflash.read_dataflash(path, None, clock_offset_s)
    if head.startswith(KEY):
        return read_misb(path, None, clock_offset_s)
    text = _text(beginning)
    # If the beginning is damaged, the name decides. A letter in a text may equal the sync byte of packets.
    if (layout := (spacing(head) if text is None else None) or _STREAMS.get(suffix)) is not None:
        return read_misb(path, layout, clock_offset_s)
    if KEY in beginning or suffix == ".klv":
        return read_misb(path, None, clock_offset_s)
    if looks_like_tlog(head) or suffix == ".tlog":
        return read_tlog(path, clock_offset_s)
    if text is not None and dataflash.IN_TEXT.search(text):
        return dataflash.read_dataflash(path, _text(path.read_bytes()) or "", clock_offset_s)
    if text is not None and (re.search(r"\$[A-Z]{5},", text) or SENTENCE.search(text)):
        return read_nmea(path, _text(path.read_bytes()) or "", clock_offset_s)
    if text is not None and re.search(r"-->" if suffix == ".csv" else r"-->|\bGPS\s*\(|\[\s*latitude", text):
        return read_subtitles(path, _text(path.read_bytes()) or "", clock_offset_s, zone, order)
    if text is not None and re.search(r"mavlink_\w{1,60}_t,|^[\d :.-]{10,30}: \w{1,60} \{", text):
        advice = "give the .tlog or .bin itself, or tables by mavlogdump.py --format csv --types GPS"
        raise InputError(f"telemetry {path} holds the messages of an autopilot as text; {advice}")
    if suffix == ".csv" or (text is not None and re.search(r"[,;\t|]|^\W{0,9}\w{0,20}time\w{0,20} ", text)):
        return read_telemetry_table(path, clock_offset_s, clip, zone, order, rate_hz)
    if suffix == ".ulg":
        raise InputError(f"telemetry {path} does not begin like a PX4 log: it is another file, or it is damaged")
    if b"ftyp" in head[:12]:
        hint = "give the .SRT beside it, or extract its subtitles: ffmpeg -i VIDEO -map 0:s:0 OUT.srt"
        raise InputError(f"telemetry {path} is a video; {hint}")
    raise InputError(f"telemetry {path} is of no supported kind; give {KINDS}")


def _text(content: bytes) -> str | None:
    """Return the content as text; None if it is not text. A few garbled letters are accepted."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16", errors="replace")
    if content.count(b"\0") > len(content) // 1000 + 3:
        return None
    text = content.decode("utf-8-sig", errors="replace")
    strange = sum(letter == "\ufffd" or (letter < " " and letter not in "\r\n\t") for letter in text[:4096])
    return text if strange <= 0.1 * min(len(text), 4096) else None
