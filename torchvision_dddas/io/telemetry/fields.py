"""The names of quantities in logs, their units, possible values and zero points, and their meanings in each program.

The readers of tables and of subtitles know no other names. docs/telemetry.md shows both tables; a test compares them.
"""

import math
import re
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np


class Field(NamedTuple):
    """A quantity. kind: its key in UNITS. low, high: possible values, angles in degrees. zero: the zero point.

    names: in lower case without blanks, dashes and underscores, the best first. A prefix for the vehicle is ignored,
    and prefixes such as `gb` and `camera` count as `gimbal`.
    """

    quantity: str
    kind: str
    low: float
    high: float
    zero: str
    names: str


_ANY, _HEIGHT = (-math.inf, math.inf), ("length", -1000.0, 30_000.0)
FIELDS = (
    Field("longitude_deg", "degrees", -180, 180, "Greenwich", "longitude longtitude lon lng long gpscoord[1]"),
    Field("latitude_deg", "degrees", -90, 90, "the equator", "latitude lat gpscoord[0]"),
    Field("longitude_side", "text", *_ANY, "E or W", "e/w ew longitudedirection londir longituderef lonref lngref "
          "longitudehemisphere lonhemisphere lonhemi longitudeew lonew"),
    Field("latitude_side", "text", *_ANY, "N or S", "n/s ns latitudedirection latdir latituderef latref "
          "latitudehemisphere lathemisphere lathemi latitudens latns"),
    Field("place", "text", *_ANY, "both in one cell", "gps latlon latlong latlng lonlat lnglat "
          "coordinates position location"),
    Field("east_m", "length", -1e7, 1e7, "an origin, to the east", "east"),
    Field("north_m", "length", -1e7, 1e7, "an origin, to the north", "north"),
    Field("above_takeoff_m", *_HEIGHT, "the take-off point",
          "relhomealt ascent barometricaltitude barometer baroaltitude baroalt baro hb h"),
    Field("above_ground_m", *_HEIGHT, "the ground below the vehicle",
          "heightabovegroundatdronelocation radaraltitude radaralt grounddistance distbottom cheight"),
    Field("above_sea_m", *_HEIGHT, "the sea", "gpsaltitude gpsalt galt"),
    Field("above_ellipsoid_m", *_HEIGHT, "the ellipsoid WGS 84", ""),
    Field("geoid_m", "length", -120, 100, "the ellipsoid, up to the sea",
          "undulation geoidundulation geoidheight geoidseparation geoidsep geoidalseparation geoid"),
    Field("bare_height_m", *_HEIGHT, "not said: the take-off point is assumed", "height"),
    Field("bare_altitude_m", *_HEIGHT, "not said: the sea is assumed", "altitude alt gpsheight ele"),
    Field("accuracy_m", "length", 1e-3, 1000, "standard deviation of the place, of east and north together",
          "horizontalaccuracy hacc gpsaccuracy gpshorizontalaccuracy"),
    Field("speed_m_s", "speed", 0, 300, "the ground",
          "h.s speed groundspeed gndspeed gspd hspeed horizontalspeed velocity horizontalvelocity vel velh spd"),
    Field("heading_rad", "angle", -360, 360, "true north, clockwise, of the camera",
          "gimbalyaw gimbalheading gimbalabsoluteyaw gimbalazimuth"),
    # A gimbal that looks straight down reports 90.2 as well as 89.8.
    Field("pitch_rad", "angle", -100, 100, "the horizon, up, of the camera", "gimbalpitch gimbalabsolutepitch"),
    Field("roll_rad", "angle", -360, 360, "level, clockwise, of the camera", "gimbalroll gimbalabsoluteroll"),
    Field("vehicle_heading_rad", "angle", -360, 360, "true north, clockwise, of the vehicle's nose",
          "heading yaw compassheading compass hdg"),
    Field("course", "text", *_ANY, "true north; it need not be the nose's and is not read",
          "course courseoverground cog gcrs groundcourse gpscourse gpsheading"),
    Field("hfov_rad", "angle", 0.05, 179, "across the picture", "hfov horizontalfov picturehfov"),
    Field("focal_mm", "number", 8, 2000, "a picture with a longer side of 36 mm", "focallen focallength35mm focal35mm"),
    Field("f_number", "number", *_ANY, "", "fnum"),
    Field("zoom", "number", 1, 200, "1; 179 and 17900 are 1.79", "dzoomratio dzoom zoomratio zoom"),
    Field("filming", "text", *_ANY, "whether the camera records",
          "isvideo istakingvideo isrecording recording gimbalisvideo gimbalrecording gimbalrecordstate recordstate "
          "isrecordingvideo videorecording recordingvideo takingvideo isvideorecording isfilming filming videostate"),
    Field("fix", "number", *_ANY, "2 or more where the place is known", "fixtype"),
    Field("frame", "number", *_ANY, "the clip's first frame", "frame framenumber framecnt framecount"),
    Field("time", "time", *_ANY, "the first row, midnight or 1970",
          "elapsedtime elapsed flytime flighttime offsettime timeboot time timestamp datetime date/time date ts t "
          "epoch updatetime updatedatetime updatedatetime24 currenttime localtime utctime timeutc utc utcdatetime"),
)  # fmt: skip

_DEG = math.pi / 180
_SCALES: dict[str, dict[float, str]] = {
    "length": {1: "m meter meters metre metres", 0.3048: "ft feet foot", 0.01: "cm", 1e-3: "mm", 1e3: "km", -1: "-m"},
    "speed": {1: "m/s mps ms", 1 / 3.6: "km/h kmh kph", 0.44704: "mph", 1852 / 3600: "kn kt kts knot knots",
              0.3048: "ft/s fps", 0.01: "cm/s", 1e-3: "mm/s"},
    "angle": {_DEG: "deg degree degrees ° º @ 360 180", 1: "rad radian radians", _DEG / 10: "ddeg", _DEG / 100: "cdeg"},
    "degrees": {1: "deg degree degrees ° º @ wgs84", 1 / _DEG: "rad radian radians",
                1e-7: "dege7 1e7 e7", 1e-6: "dege6 1e6 e6 microdegrees"},
    "time": {1: "s sec secs second seconds", 1e-3: "ms msec millis millisecond milliseconds",
             1e-6: "us µs usec micros microsecond microseconds",
             1e-9: "ns nsec nsecs nanosec nanosecs nanosecond nanoseconds", 60: "min mins minute minutes",
             3600: "hr hrs hour hours h", math.nan: "utc gmt local epoch"},
}  # fmt: skip
UNITS = {kind: {w: scale for scale, words in scales.items() for w in words.split()} for kind, scales in _SCALES.items()}
"""For each kind of field: unit -> factor to the record's unit, NaN if only the values show the factor."""
_ANY_UNIT = {unit for units in UNITS.values() for unit in units}


class Dialect(NamedTuple):
    """A program and its names. order: the order of the two numbers of a place.

    marks: for tables, the names by which the program is recognized; | separates alternatives, and `osd.` is a prefix.
    For subtitles, a regular expression that matches their lower-case beginning. means: name=quantity,unit for names
    that are ambiguous elsewhere. Names with nothing after = are ignored.
    """

    program: str
    marks: str
    means: str = ""
    order: str = ""


TABLES = (
    Dialect("AirData", "datetime heightabovetakeoff|ascent", "altitude=above_sea_m"),
    Dialect("Litchi", "istakingvideo|gimbalpitchraw|velocityx velocityy", "altitude=above_takeoff_m "
            "gimbalpitchraw=pitch_rad,ddeg gimbalrollraw=roll_rad,ddeg gimbalyawraw=heading_rad,ddeg"),
    Dialect("DJI flight record (FlightReader, PhantomHelp, TXTlogToCSV)", "osd.|custom.",
            "altitude=above_sea_m height=above_takeoff_m"),
    Dialect("UgCS SkyHub", "elapsed date time latitude altitude", "altitude=above_takeoff_m elapsed=time,ms"),
    Dialect("EdgeTX, OpenTX", "date time gps", "hdg=course", "lat-lon"),
    Dialect("ulog2csv, receiver before PX4 1.14", "timestamp timeutcusec lat lon",
            "timestamp=time,us alt=above_sea_m,mm altellipsoid=above_ellipsoid_m,mm eph=accuracy_m heading="),
    Dialect("ulog2csv", "timestamp timestampsample|timestamp altellipsoid|timestamp deltaalt|timestamp timeutcusec",
            "timestamp=time,us timestampsample= alt=above_sea_m z=above_takeoff_m,-m heading=vehicle_heading_rad,rad"),
    Dialect("mavlogdump, MNT", "timeus desyawe", "pitch=pitch_rad roll=roll_rad yawe=heading_rad"),
    Dialect("mavlogdump, with a place", "timeus lat lng", "alt=above_sea_m status=fix relalt=above_takeoff_m"),
    Dialect("mavlogdump, without a place", "timeus", "alt=above_takeoff_m"),
    Dialect("MAVLink GPS_RAW_INT", "timeusec fixtype lat lon alt eph|gpsrawint.|gps2raw.", "alt=above_sea_m,mm "
            "altellipsoid=above_ellipsoid_m,mm vel=speed_m_s,cm/s cog=course hacc=accuracy_m,mm"),
    Dialect("MAVLink MOUNT_ORIENTATION", "timebootms roll pitch yaw yawabsolute|mountorientation.", "roll=roll_rad "
            "pitch=pitch_rad yaw= yawabsolute=heading_rad"),
    Dialect("u-blox NAV-PVT", "itow lon lat height hmsl", "itow=time,ms lon=longitude_deg,e7 lat=latitude_deg,e7 "
            "height=above_ellipsoid_m,mm hmsl=above_sea_m,mm gspeed=speed_m_s,mm/s headmot=course hacc=accuracy_m,mm"),
    Dialect("mavlogdump of a .tlog", "timebootms lat lon alt relativealt|globalpositionint.", "alt=above_sea_m,mm "
            "relativealt=above_takeoff_m,mm hdg=vehicle_heading_rad,cdeg vfrhud.alt=above_sea_m "
            "attitude.yaw=vehicle_heading_rad,rad"),
    # GPS_altitude is ignored: its unit is the metre or the decimetre, depending on the firmware.
    Dialect("blackbox_decode (Betaflight, INAV)", "gpscoord[0]|loopiteration",
            "navpos[2]=above_takeoff_m,cm gpsaltitude="),
    Dialect("Parrot", "productgpslatitude", "anglepsi=vehicle_heading_rad,rad"),
)  # fmt: skip
SUBTITLES = (
    Dialect("DJI with SrtCnt (Air 2S, Mini 2)", "srtcnt", "altitude=above_takeoff_m"),
    Dialect("DJI with FrameCnt (Mavic 2)", "framecnt", "altitude=above_sea_m"),
    Dialect("GPS(48.1, 11.5, 52.5M)", r"gps ?\([^()]{3,60}[,;] ?-?[\d.]{1,12} ?m\)", "", "lat-lon"),
    Dialect("GPS(48.1, 11.5, 569.8)", r"gps ?\((([^(),;]{3,20}[,;]){2} ?-?(\d{3,5}|\d{1,6}\.\d{1,6})|"
            r"([^();]{3,20};){2} ?-?\d{1,6},\d{1,6}|(-?\d{1,3},\d{1,12},){2}-?\d{1,6},\d{1,6})\)", "", "lat-lon"),
    Dialect("GPS(11.5, 48.1, 16)", r"(gps|rtk) ?\([^()]{3,60}[,;] ?\d{1,2}\)", "", "lon-lat"),
)  # fmt: skip

_BY_QUANTITY = {field.quantity: field for field in (*FIELDS, Field("", "text", *_ANY, "", ""))}
# Name -> quantity, unit, rank. A column may have the name of its unit, `seconds`.
_MEANT = {unit: ("time", unit, 0) for unit, scale in UNITS["time"].items() if not scale >= 60}
_MEANT |= {name: (field.quantity, "", rank) for field in FIELDS for rank, name in enumerate(field.names.split(), 1)}
POSSIBLE = {
    field.quantity: (field.low * scale, field.high * scale)
    for field in FIELDS
    for scale in [_DEG if field.kind == "angle" else 1.0]
} | {"altitude_m": _HEIGHT[1:]}
"""Lowest and highest possible value of each quantity, in the record's units."""
HEIGHTS = ("above_takeoff_m", "above_ground_m", "bare_height_m", "bare_altitude_m", "geoid_m")
"""The heights from which the record's altitude_m and above_sea_m are made."""

# Words for the zero point of a height. Names also have words for a height and fillers, in any order: `GPS height AMSL`.
ZEROS = {
    "above_takeoff_m": "relativetohome relativetotakeoff relative rel abovetakeoffpoint abovetakeoff overtakeoff "
    "fromtakeoff abovehomepoint abovehome fromhome abovelaunch abovestart ato",
    "above_ground_m": "abovegroundlevel aboveground overground aboveterrain abovesurface agl",
    "above_sea_m": "abovemeansealevel abovesealevel abovesea sealevel amsl msl asl absolute abs orthometric orth "
    "abovegeoid egm96 egm2008 egm84",
    "above_ellipsoid_m": "abovewgs84ellipsoid aboveellipsoid wgs84ellipsoid ellipsoidal ellipsoid ell abovewgs84 "
    "wgs84 hae",
}
_ZERO_OF = {word: quantity for quantity, words in ZEROS.items() for word in words.split()}
_ALONE = {"agl", "amsl", "msl", "asl", "hae", "ato", "abovesealevel", "abovesea", "aboveground", "abovetakeoff"}
_ALONE |= {"aboveellipsoid", "ellipsoidal", "abovegeoid"}
_FILL = "gps|gnss|rtk|drone|uav|aircraft|vehicle|point"
_IN_HEIGHT = re.compile(rf"({'|'.join(_ZERO_OF)})|(altitude|alt|height|elevation|elev|ele|hgt|h)|{_FILL}")
_NOTHING = re.compile(f"(?:{_FILL})*")
# Search for the first bracket only: an expression for the whole name would try each bracket of a name with many.
_OPENING = re.compile(r"[(\[](?!\d{1,2}[)\]])| / (?=\S+$)")
_BLANKS, _WORDS = re.compile(r"[\s_-]|:[cd]$"), re.compile(r"[^\s,;()\[\]]+")
_VEHICLE = re.compile(
    r"(?:globalpositionint|gpsrawint|gps2raw|mountorientation|\.?(?:header\.?)?stamp\.|tv|osd|gps|custom|clock|general"
    r"|aircraft|drone|uav|vehicle|flight|product(?:gps)?|location|imuatti|fused|field)(?:\(\d\))?[.:]?"
)
_CAMERA = re.compile(r"(?:gimbal|gb|camera|cam|mount|payload)(?:\(\d\))?[.:]?")
_PARTS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_UNLIKE = re.compile(r"batt|max|min|remain|rate|speed|veloc|(?<!finder[_ .])dist|acc|gyr|mag_", re.IGNORECASE)
_ALIKE = re.compile(
    r"lat(itude)?|lon(gitude)?|lng|alt(itude)?|height|elevation|heading|hdg|course|yaw|pitch|roll|azimuth|tilt|pan"
    r"|[hv]?fov|zoom|focal|time|timestamp|date|position|agl|msl|hae|hagl|ato|elev?|z|angle|rangefinder"
    r"|east(ing)?|north(ing)?|video|recording|filming|film"
)
_HEAD, _LONGEST_UNIT, _LAST = 20_000, 13, 99
# Half the longer side of the picture for which focal lengths are given.
_HALF_WIDTH_MM, _NUMBER = 18.0, re.compile(r"[-+]?\d{1,12}(?:\.\d{1,12})?")


class Known(NamedTuple):
    """The meaning of a name. scale: factor to the record's unit and sign, NaN if only the values show it.

    rank: 0 for the best name, _LAST for a meaning in one dialect only. is_utc: whether it is a clock in UTC.
    """

    field: Field
    scale: float
    rank: int = _LAST
    is_utc: bool = False

    def in_unit(self, unit: str) -> "Known | None":
        """Return the same meaning in a unit; None if the field has no such unit."""
        scale = UNITS.get(self.field.kind, {}).get(unit)
        sign = -1 if self.field.quantity == "pitch_rad" else 1  # the record's pitch is positive down
        return None if scale is None else self._replace(scale=sign * scale, is_utc=unit in ("utc", "gmt"))


class Names:
    """The meanings of names in a log. dialects: the first takes precedence; program is its program, or ""."""

    def __init__(self, dialects: Sequence[Dialect] = ()) -> None:
        self.program = dialects[0].program if dialects else ""
        self.order = next((dialect.order for dialect in dialects if dialect.order), "")
        self._meant: dict[str, tuple[str, str, int]] = dict(_MEANT)
        for part in (part for dialect in reversed(dialects) for part in dialect.means.split()):
            name, _, what = part.partition("=")
            quantity, _, unit = what.partition(",")
            self._meant[name] = quantity, unit, _LAST
        self._known: dict[str, Known | None] = {}

    def find(self, title: str) -> Known | None:
        """Return the meaning of a name with its unit: `OSD.height [ft]`, `Speed (mph)`, `gb_yaw`; None if unknown."""
        try:
            return self._known[title]
        except KeyError:
            self._known[title] = self._find(*_parted(title))
            return self._known[title]

    def _find(self, name: str, words: list[str]) -> Known | None:
        rest = _plain("".join(word for word in words if word in _ZERO_OF or word not in _ANY_UNIT))
        for key in dict.fromkeys((name + rest, name)):  # "altitude (m AMSL)" is known as altitudeamsl
            if (known := self._named(key)) is not None:
                with_unit = next((found for word in words if (found := known.in_unit(word))), None)
                # Reject a quantity with an unknown unit. The letter h means the height only with a unit.
                if key == name and known.field.kind == "length" and not _NOTHING.fullmatch(rest):
                    continue  # the column does not name the zero point of this height
                if with_unit or (key != "h" and (not words or key != name or known.field.kind not in UNITS)):
                    return with_unit or known
        return None

    def _named(self, key: str) -> Known | None:
        """Return the meaning of a name, None if unknown. It may have the prefix of a vehicle or camera, and a unit."""
        bare = key[vehicle.end() :] if (vehicle := _VEHICLE.match(key)) else key
        forms = [key, key.replace(".", ""), bare, bare.replace(".", "")]
        forms += ["gimbal" + form[camera.end() :] for form in (key, bare) if (camera := _CAMERA.match(form))]
        for form in forms:
            for cut in range(len(form), max(len(form) - _LONGEST_UNIT, 0), -1):
                stem, end = form[:cut], form[cut:]
                quantity, unit, rank = self._meant.get(stem, (None, "", 0))
                if quantity is None and (quantity := _height(stem)):
                    rank = 0
                if quantity is not None:
                    field = _BY_QUANTITY[quantity]
                    known = Known(field, math.nan if field.kind == "time" else 1.0, rank)
                    found = known.in_unit(end or unit or "deg")
                    if found or not end:
                        return (found or known) if quantity else None
        return None


@lru_cache(maxsize=10_000)
def _height(name: str) -> str | None:
    """Return the height that a name means by its words for a height and a zero point; None if the name is unclear."""
    place, zeros, count = 0, set[str](), 0
    while place < len(name) and (found := _IN_HEIGHT.match(name, place)) is not None:
        zeros |= {_ZERO_OF[found[1]]} if found[1] else set()
        count += found[1] in _ALONE or found[2] is not None
        place = found.end()
    return zeros.pop() if place == len(name) and count and len(zeros) == 1 else None


def _plain(name: str) -> str:
    return _BLANKS.sub("", name.lower())


def _parted(title: str) -> tuple[str, list[str]]:
    """Return the plain name of a column, and the words in the brackets behind it."""
    opening = _OPENING.search(title)
    end = opening.start() if opening is not None else len(title)
    return _plain(title[:end]), _WORDS.findall(title[opening.end() :].lower()) if opening else []


def names_of_table(header: Sequence[str]) -> Names:
    """Return the meanings of a table's columns, according to the programs that write such columns."""
    keys = {_parted(title)[0] for title in header}
    keys |= {key.partition(".")[0] + "." for key in keys if "." in key}
    return Names([one for one in TABLES if any(keys.issuperset(marks.split()) for marks in one.marks.split("|"))])


def names_of_subtitles(text: str) -> Names:
    """Return the meanings of the keys of subtitles."""
    head = text[:_HEAD].lower()
    return Names([one for one in SUBTITLES if re.search(one.marks, head)])


def looks_alike(title: str) -> bool:
    """Return whether the words of a name suggest a place, a height, an attitude, a time or a zoom."""
    return any(_ALIKE.fullmatch(word.lower()) for word in _PARTS.findall(title)) and not _UNLIKE.search(title)


_PART = r"(\d{1,3}(?:[.,]\d{1,12})?)"
ANGLE = rf"([NSEW-])? ?{_PART} ?(?:[°d:]|deg)? ?(?:{_PART} ?['′m:]? ?)?(?:{_PART} ?(?:[\"″s]|'')? ?)?([NSEW])?"
"""The pattern of degrees, minutes and seconds, with a letter before or behind them. It has five groups."""
_ANGLE = re.compile(ANGLE, re.IGNORECASE)


def parse_angle(text: str) -> tuple[float, str]:
    """Return the degrees of `48.1371 N`, `48°08'13.6"N` or `48,1371`, and the side if given; NaN for other text."""
    if (found := _ANGLE.fullmatch(text.strip())) is None:
        return math.nan, ""
    degrees, minutes, seconds = (float((part or "0").replace(",", ".")) for part in found.groups()[1:4])
    side = (found[1] or found[5] or "").upper()
    return (degrees + minutes / 60 + seconds / 3600) * (-1 if side in ("S", "W", "-") else 1), side.strip("-")


def field_of_view(focal: Sequence[str], f_number: Sequence[str], zoom: Sequence[str]) -> tuple[np.ndarray, list[str]]:
    """Return the widths of the field of view, rad, (N,), NaN if unknown, and notes. Arguments: (N,) texts of the log.

    The focal length is for a picture with a longer side of 36 mm. Some logs have ten times the focal length and 100
    times the aperture: 240 and 280 mean 24 mm at f/2.8. The zoom is 1.79, or counts hundredths to ten-thousandths.
    """
    texts = (focal, f_number, [text.strip("xX× ") for text in zoom])
    mm, aperture, times = (np.array([float(t) if _NUMBER.fullmatch(t) else np.nan for t in text]) for text in texts)
    is_tenths = np.array(["." not in text for text in focal]) & (mm >= 100) & ~(aperture < 100)
    notes = ["the field of view follows from a focal length for a picture with a longer side of 36 mm"]
    if (times >= 100).any():
        first = times[times >= 100][0]
        # The smallest zoom of a log is one or more.
        lowest = times[times >= 100].min()
        scale = next(scale for scale in (10_000, 1000, 100) if scale <= lowest)
        times = np.where(times >= 100, times / scale, times)
        or_more = f"; the log does not give the scale: in 1/{scale // 10} it would be {first / scale * 10:g}"
        notes.append(
            f"the zoom is counted in 1/{scale}: {first:g} is {first / scale:g}{or_more * int(scale != lowest)}"
        )
    known = np.unique(times[np.isfinite(times)])
    if len(known) == 1 and known[0] > 1:
        notes.append(f"the zoom is {known[0]:g} throughout; a focal length in the camera's file must include it")
    is_wrong = (times < POSSIBLE["zoom"][0]) | (times > POSSIBLE["zoom"][1])
    if is_wrong.any():
        notes.append(f"a zoom of {times[is_wrong][0]:g} is impossible; {is_wrong.sum()} left out")
    mm = np.where(is_tenths, mm / 10, mm) * np.where(np.isnan(times) | is_wrong, 1.0, times)
    low, high = POSSIBLE["focal_mm"]
    hfov = 2 * np.arctan(_HALF_WIDTH_MM / np.where((mm >= low) & (mm <= high), mm, np.nan))
    return hfov, notes if np.isfinite(hfov).any() else []
