"""What the vehicle reports of itself, from whatever recorded it, as one record.

Own tables, DJI's subtitles, logs of MAVLink, PX4 and ArduPilot, MISB ST 0601 inside MPEG-TS, NMEA 0183. The kind is
found by the content of the file, then by its name.
"""

import codecs
import re
from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry import dataflash, px4
from torchvision_dddas.io.telemetry.clocks import parse_time_zone
from torchvision_dddas.io.telemetry.mavlink import looks_like_tlog, read_tlog
from torchvision_dddas.io.telemetry.misb import KEY, read_misb, spacing
from torchvision_dddas.io.telemetry.nmea import SENTENCE, read_nmea
from torchvision_dddas.io.telemetry.record import KINDS
from torchvision_dddas.io.telemetry.tables import read_telemetry_table
from torchvision_dddas.io.telemetry.text_logs import read_subtitles
from torchvision_dddas.types import Telemetry

__all__ = ["read_telemetry"]

_STREAMS = {".ts": (188, 0), ".mpg": (188, 0), ".m2ts": (192, 4), ".mts": (192, 4)}


def read_telemetry(
    path: str | Path,
    clock_offset_s: float = 0.0,
    clip: str | Path | None = None,
    time_zone: str = "",
    order: str = "auto",
) -> Telemetry:
    """What a vehicle reports of itself. clock_offset_s: added to its times to get those since the clip's first frame.

    clip: the video that it belongs to; of use for a table that counts frames instead of telling times. time_zone: of
    dates that say none, a name of the IANA data base or hours from UTC; "" leaves their clock unknown. order: "lat-lon"
    or "lon-lat" for two coordinates in one field, whose order else the program tells.
    Raises InputError in one line where the file cannot be read or nothing in it can be used. What can be read of a
    damaged file is returned, and its notes say what could not.
    """
    path, clip = Path(path), Path(clip) if clip is not None else None
    zone = parse_time_zone(time_zone)
    try:
        with path.open("rb") as file:
            beginning = file.read(1 << 16)
    except OSError as error:
        raise InputError(f"telemetry {path} cannot be read: {error.strerror}") from None
    head, suffix = beginning[:4096], path.suffix.lower()
    if not head.strip() and suffix != ".csv":
        raise InputError(f"telemetry {path} is empty; wanted {KINDS}")
    if head.startswith(px4.MAGIC):
        return px4.read_ulog(path, clock_offset_s)
    if dataflash.MAGIC in head:
        return dataflash.read_dataflash(path, None, clock_offset_s)
    if head.startswith(KEY):
        return read_misb(path, None, clock_offset_s)
    text = _text(beginning)
    # What is damaged at its beginning still has its name. In text a letter may stand where packets begin.
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
        return read_telemetry_table(path, clock_offset_s, clip, zone, order)
    if suffix == ".ulg":
        raise InputError(f"telemetry {path} does not begin as a PX4 log does: it is none, or damaged there")
    if b"ftyp" in head[:12]:
        hint = "give the .SRT beside it, or extract its subtitles: ffmpeg -i VIDEO -map 0:s:0 OUT.srt"
        raise InputError(f"telemetry {path} is a video; {hint}")
    raise InputError(f"telemetry {path} is none of the kinds that can be read; wanted {KINDS}")


def _text(content: bytes) -> str | None:
    """The content as text; None where it is none. A few garbled letters do not make it something else."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16", errors="replace")
    if content.count(b"\0") > len(content) // 1000 + 3:
        return None
    text = content.decode("utf-8-sig", errors="replace")
    strange = sum(letter == "\ufffd" or (letter < " " and letter not in "\r\n\t") for letter in text[:4096])
    return text if strange <= 0.1 * min(len(text), 4096) else None
