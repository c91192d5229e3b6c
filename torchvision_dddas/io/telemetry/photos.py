"""Read the camera's place, heights, angles and field of view from EXIF in still pictures and XMP of drones.

Pillow reads the files. In XMP the angles are those of the gimbal, from true north and negative below the horizon.
"""

import math
import re
import warnings
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.images import images_of_folder
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.io.telemetry.record import Log, build_record
from torchvision_dddas.types import Telemetry

MAGIC = (b"\xff\xd8\xff", b"II*\0", b"MM\0*")
"""The first bytes of JPEG and TIFF. DNG is TIFF, too."""

_XMP = re.compile(r"\b[\w-]+:(\w+)\s*(?:=\s*(?:\"([^\"]*)\"|'([^']*)')|>([^<]{1,60})<)")
_EXIF, _GPS = 0x8769, 0x8825
_ANGLES = {
    "heading_rad": ("GimbalYawDegree", "CameraYawDegree"),
    "pitch_rad": ("GimbalPitchDegree", "CameraPitchDegree"),
    "roll_rad": ("GimbalRollDegree", "CameraRollDegree"),
    "vehicle_heading_rad": ("FlightYawDegree",),
}
_PLACES = {"latitude_deg": ("GpsLatitude",), "longitude_deg": ("GpsLongitude", "GpsLongtitude")}
_CUT = 0.02  # if the aspect ratio has changed by a larger share, the picture was cut
_RTK_FIX = 16  # the smallest RtkFlag of DJI for a place from RTK
_ON_ITS_SIDE = (5, 6, 7, 8)  # EXIF orientations that exchange width and height

Values = dict[str, float]


def read_photos(
    path: Path, clock_offset_s: float, clip: Path | None, rate_hz: float | None, zone: tzinfo | None
) -> Telemetry:
    """Return the record of a picture or of a folder's pictures. Picture n has the time of frame n of their clip.

    Raise InputError if Pillow is missing, if the only picture cannot be read, or if no picture has usable values.
    """
    try:
        from PIL import Image
    except ImportError:
        raise InputError(f"pictures such as {path} need Pillow: pip install 'torchvision-dddas[photos]'") from None
    files = images_of_folder(path) if path.is_dir() else [path]  # the frames of a clip of the folder
    if len(files) > 1 and rate_hz is None:
        if clip is None:
            raise InputError(f"telemetry {path} is a folder of pictures; give its clip, or --rate, for the times")
        rate_hz = open_source(clip).rate_hz
    log = Log(path, "pictures' EXIF and XMP", where="picture")
    start_utc_s = math.nan
    for number, file in enumerate(files, 1):
        try:
            with warnings.catch_warnings(action="ignore"), Image.open(file) as picture:
                values, utc_s = _values(log, picture, file.name, zone)
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            says = f"{file.name} cannot be read as a picture: {error}"
            if len(files) == 1:
                raise log.refuse(" ".join(says.split())) from None
            log.note(f"{says}; its values are unknown")
            values, utc_s = {}, math.nan
        time_s = (number - 1) / (rate_hz or 1.0)
        log.moments.append((time_s, 0.0, number))
        for name, value in values.items():
            log.add(name, time_s, value, number)
        start_utc_s = utc_s if number == 1 else start_utc_s
    return build_record(log, clock_offset_s, start_utc_s)


def _values(log: Log, picture: Any, name: str, zone: tzinfo | None) -> tuple[Values, float]:
    """Return the quantities of a picture, named as in `Log`, and its time, s since 1970, NaN if the zone is unknown."""
    exif = picture.getexif()
    taken, gps = exif.get_ifd(_EXIF), exif.get_ifd(_GPS)
    xmp = picture.info.get("xmp", b"")
    text = xmp.decode("utf-8", "replace") if isinstance(xmp, bytes) else str(xmp)
    said = {found[1].lower(): (found[2] or found[3] or found[4] or "").strip() for found in _XMP.finditer(text)}
    values = {key: value for key, names in _PLACES.items() if not math.isnan(value := _number(said, *names))}
    if len(values) < 2:
        values = _gps_place(gps)
    height = _number(said, "AbsoluteAltitude")
    kind = said.get("altitudetype", "")
    by_rtk = kind.lower().startswith("rtk") if kind else _number(said, "RtkFlag") >= _RTK_FIX
    if math.isnan(height):
        zero = int.from_bytes(gps[5], "big") if isinstance(gps.get(5), bytes) else gps.get(5, 0)
        height, by_rtk = (-1 if zero in (1, 3) else 1) * float(gps.get(6, math.nan)), zero in (2, 3)
    values["above_ellipsoid_m" if by_rtk else "above_sea_m"] = height
    values["above_takeoff_m"] = _number(said, "RelativeAltitude")
    east, north = _number(said, "RtkStdLon"), _number(said, "RtkStdLat")
    values["accuracy_m"] = math.hypot(east, north) if min(east, north) >= 0 else math.nan
    for key, names in _ANGLES.items():
        values[key] = math.radians((-1 if key == "pitch_rad" else 1) * _number(said, *names))
    if math.isnan(values["heading_rad"]) and gps.get(17) is not None:
        if gps.get(16) == "T":
            values["heading_rad"] = math.radians(float(gps[17]))
        else:
            log.note(f"{name} gives its direction from magnetic north or an unknown north: it is not used")
    values["hfov_rad"] = _field_of_view(log, picture.size, said, taken, name)
    if exif.get(0x0112, 1) in _ON_ITS_SIDE and not log.is_nominal:
        values["hfov_rad"] = 2 * math.atan(math.tan(values["hfov_rad"] / 2) * picture.size[1] / picture.size[0])
    if exif.get(0x0112, 1) != 1:
        log.note(f"{name} is stored turned (EXIF orientation {exif[0x0112]}): pixels refer to the upright picture")
    return {key: value for key, value in values.items() if not math.isnan(value)}, _utc_s(exif, taken, zone)


def _number(said: dict[str, str], *names: str) -> float:
    for name in names:
        try:
            return float(said[name.lower()])
        except (KeyError, ValueError):
            continue
    return math.nan


def _gps_place(gps: dict[int, Any]) -> Values:
    """Return latitude and longitude from EXIF's degrees, minutes and seconds; {} if they are missing."""
    try:
        latitude, longitude = (
            (-1 if str(gps[key - 1])[:1].upper() in "SW" else 1) * sum(float(v) / 60**k for k, v in enumerate(gps[key]))
            for key in (2, 4)
        )
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return {}
    return {"latitude_deg": latitude, "longitude_deg": longitude}


def _field_of_view(log: Log, size: tuple[int, int], said: dict[str, str], taken: dict[int, Any], name: str) -> float:
    """Return the horizontal field of view, rad, by the calibrated or the 35 mm focal length; NaN for a cut picture.

    A focal length for 35 mm film refers to the diagonal (CIPA DCG-001). A picture wider than 3:2 is cut at top and
    bottom, so its focal length refers to the width of the film.
    """
    width, height = size
    focal_px = _number(said, "CalibratedFocalLength")
    middle = _number(said, "CalibratedOpticalCenterX"), _number(said, "CalibratedOpticalCenterY")
    if focal_px > 0 and middle[0] > 0 and middle[1] > 0:
        if abs(width / height * middle[1] / middle[0] - 1) > _CUT:
            log.note(
                f"{name} of {width}x{height} px is cut from a picture of about {2 * middle[0]:.0f}x{2 * middle[1]:.0f} "
                "px: its field of view is unknown; give a camera's file for the cut picture"
            )
            return math.nan
        return 2 * math.atan(middle[0] / focal_px)
    try:
        focal_mm = float(taken.get(0xA405) or 0)
    except (TypeError, ValueError, ZeroDivisionError):
        focal_mm = 0.0
    if focal_mm <= 0:
        return math.nan
    log.is_nominal = True
    film_mm = min(36.0, math.hypot(36, 24) * max(size) / math.hypot(*size))
    return 2 * math.atan(film_mm / 2 / focal_mm)


def _utc_s(exif: Any, taken: dict[int, Any], zone: tzinfo | None) -> float:
    """Return when the picture was taken, seconds since 1970; NaN if neither the file nor the user gives the zone."""
    try:
        local = datetime.strptime(str(taken.get(0x9003) or exif.get(0x0132)).strip("\0 "), "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return math.nan
    if (found := re.fullmatch(r"([+-])(\d\d):(\d\d)", str(taken.get(0x9011) or "").strip("\0 "))) is not None:
        ahead = timedelta(hours=int(found[2]), minutes=int(found[3]))
        return (local - (ahead if found[1] == "+" else -ahead)).replace(tzinfo=UTC).timestamp()
    return local.replace(tzinfo=zone).timestamp() if zone is not None else math.nan
