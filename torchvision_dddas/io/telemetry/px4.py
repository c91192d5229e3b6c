"""Read PX4's ULog files, whose topics have their own time stamps."""

import contextlib
import io
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry.autopilots import NAMES, Topic, Topics, add_topic, build_flight, column, start_clock
from torchvision_dddas.io.telemetry.record import Log
from torchvision_dddas.types import Telemetry

PX4_RADIUS_M = 6_371_000.0  # radius of the Earth in PX4's MapProjection (CONSTANTS_RADIUS_OF_EARTH)
MAGIC = b"ULog\x01\x12\x35"


@np.errstate(invalid="ignore")  # a damaged log may hold any bits
def read_ulog(path: Path, clock_offset_s: float) -> Telemetry:
    """Read positions, heights and attitudes of a PX4 log; times count from the first. Raise InputError without data."""
    log = Log(path, "PX4 log", "sample", bridge_s=1.0)
    topics = _px4_topics(log)
    for local in topics.get("vehicle_local_position", {}).values():
        _place_local(log, local, topics.get("home_position", {}))
    receivers = [topic for name in ("vehicle_gps_position", "sensor_gps") for topic in topics.get(name, {}).values()]
    clock_s = start_clock((column(topic, "time_utc_usec", 0) / 1e6, topic["time_s"]) for topic in receivers)
    return build_flight(log, topics, clock_offset_s, clock_s)


# The beginning of a message: its length, up to about 10,000, and a kind that pyulog knows.
_HEADER = re.compile(rb"(?:[^\0][\0-\x27]|\0[\1-\x27])[ABCDFILMOPQRS]", re.DOTALL)


class _Onwards(io.BytesIO):
    """The bytes of a log, without the bytes from damage to the next beginning of a message.

    pyulog 1.3 seeks back from a damaged message to its second byte, which takes seconds a megabyte. At the end of the
    file, it seeks back by the announced length although it read less, and would loop forever.
    is_cut: whether the last message that was read ends behind the end of the file.
    """

    def __init__(self, content: bytes) -> None:
        super().__init__(content)
        self._content, self._asked, self._short, self.is_cut = content, 0, 0, False

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        self._asked = size or 0
        self._short = max(self._asked - len(data), 0)
        self.is_cut = self._short > 0 and (self._asked > 3 or len(data) > 0)  # else no message begins there
        return data

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        if whence != io.SEEK_CUR or offset >= 0:
            return super().seek(offset, whence)
        place = self.tell() + offset + self._short
        if offset == -2 - self._asked:  # pyulog seeks to the second byte of the last message
            following = _HEADER.search(self._content, place)
            place = len(self._content) if following is None else following.start()
        return super().seek(place)


def _px4_topics(log: Log) -> Topics:
    try:
        from pyulog import ULog
    except ImportError:
        raise InputError(
            f"telemetry {log.path} is a PX4 log, which needs pyulog: pip install 'torchvision-dddas[telemetry]'"
        ) from None
    content = _Onwards(log.path.read_bytes())
    try:
        # pyulog prints a message for each damaged part.
        with contextlib.redirect_stdout(io.StringIO()):
            read = ULog(content, [*NAMES, "home_position"])
    except Exception as error:
        raise log.refuse(f"the PX4 log is damaged from its beginning and cannot be read ({error})") from None
    if read.file_corruption:
        log.note("the log is damaged: unreadable parts are left out")
    elif content.is_cut:
        log.note(f"byte {log.path.stat().st_size}: the file ends within a message; it was cut off")
    if read.dropouts:
        lost_s = sum(part.duration for part in read.dropouts) / 1000
        log.note(f"the logger dropped messages {len(read.dropouts)} times, for {lost_s:.3g} s in all")
    topics: Topics = {}
    for topic in sorted(read.data_list, key=lambda topic: topic.multi_id):
        stamps = topic.data.get("timestamp", ())
        if len(stamps):
            own = {"time_s": stamps.astype(float) / 1e6, "where": 1 + np.arange(len(stamps))}
            add_topic(topics, topic.name, str(topic.multi_id), {**topic.data, **own})
    if not topics:
        raise log.refuse("the PX4 log has no position, height or attitude")
    return topics


def px4_lonlat(
    east_m: np.ndarray, north_m: np.ndarray, longitude0_deg: np.ndarray, latitude0_deg: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return longitudes and latitudes of PX4's local positions, azimuthal equidistant about an origin on PX4's sphere.

    This is the inverse of PX4's MapProjection.
    """
    latitude0, distance = np.radians(latitude0_deg), np.hypot(east_m, north_m) / PX4_RADIUS_M
    over = 1 / PX4_RADIUS_M * np.sinc(distance / np.pi)  # sin(distance) / distance, 1 at the origin
    east, north = east_m * over, north_m * over
    latitude = np.arcsin(np.clip(np.cos(distance) * np.sin(latitude0) + north * np.cos(latitude0), -1, 1))
    turned = np.arctan2(east, np.cos(latitude0) * np.cos(distance) - np.sin(latitude0) * north)
    longitude = longitude0_deg + np.degrees(turned)
    return np.where(np.abs(longitude) > 180, (longitude + 180) % 360 - 180, longitude), np.degrees(latitude)


def _place_local(log: Log, local: Topic, homes: Mapping[str, Topic]) -> None:
    """Add the fields of a global position, altitude, height and speed to a local position.

    The height is above the take-off point, or above the ground if a range finder measures it throughout.
    """
    latitude0 = column(local, "ref_lat")
    if np.nanmax(np.abs(latitude0), initial=0) > 0:
        local["lon"], local["lat"] = px4_lonlat(
            column(local, "y"), column(local, "x"), column(local, "ref_lon"), latitude0
        )
        local["alt"] = column(local, "ref_alt") - column(local, "z")
        is_known = (column(local, "xy_valid", 1) > 0) & (column(local, "xy_global", 1) > 0) & (latitude0 != 0)
        local |= {name: np.where(is_known, local[name], np.nan) for name in ("lon", "lat", "alt")}
    height = -column(local, "z")
    for home in homes.values():
        if np.isfinite(home_z := float(column(home, "z")[-1])):
            height = height + home_z
    height = np.where(column(local, "z_valid", 1) > 0, height, np.nan)
    if (is_ranged := column(local, "dist_bottom_valid", 0) > 0).mean() > 0.95:
        height = np.where(is_ranged, column(local, "dist_bottom"), np.nan)
        log.height_zero = "ground"
        log.note("the altitude above ground comes from the range finder")
    local["height"] = height
    speed = np.hypot(column(local, "vx"), column(local, "vy"))
    local["speed"] = np.where(column(local, "v_xy_valid", 1) > 0, speed, np.nan)
