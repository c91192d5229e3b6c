"""Make a record from the messages of an autopilot. Choose the fields to read, the receiver and the gimbal."""

import math
import re
from collections.abc import Iterable, Mapping

import numpy as np

from torchvision_dddas.io.telemetry.attitude import angles, axes_of_quaternion, heading_at
from torchvision_dddas.io.telemetry.record import Log, build_record, is_clock
from torchvision_dddas.types import Telemetry

Topic = dict[str, np.ndarray]
"""Field -> (N,) values of one kind of message from one sender. Extra fields: time_s, and `where` in the file."""
Topics = dict[str, dict[str, Topic]]
"""Name of a message -> label of a sender -> topic."""

_E7, _DEGREES = "longitude_deg=lon/1e7 latitude_deg=lat/1e7 ", "longitude_deg=lon/1 latitude_deg=lat/1 "
_ARDUPILOT = "longitude_deg=Lng/1 latitude_deg=Lat/1 above_sea_m=Alt/1 altitude_m=RelHomeAlt/1 altitude_m=RelAlt/1"
_RECEIVER = f"{_E7} above_sea_m=alt/1e3 above_ellipsoid_m=alt_ellipsoid/1e3 speed_m_s=vel/1e2 speed_m_s=vel_m_s/1"
_ACCURACY = "accuracy_m=eph/1"  # PX4's receivers give it; PX4's estimates treat slow errors as noise
_SINCE_PX4_1_14 = "above_sea_m=altitude_msl_m/1 above_ellipsoid_m=altitude_ellipsoid_m/1 speed_m_s=vel_m_s/1"
# Message -> quantity=field/N for each quantity, where N units of the field are 1 unit of the quantity. The best come
# first: estimates of the autopilot, receivers (the receiver with most fixes is used), others with a height or speed.
_PLACES: tuple[dict[str, str], ...] = (
    {
        "GLOBAL_POSITION_INT": f"{_E7} above_sea_m=alt/1e3 altitude_m=relative_alt/1e3 speed_m_s=speed/1e2",
        "vehicle_global_position": f"{_DEGREES} above_sea_m=alt/1 above_ellipsoid_m=alt_ellipsoid/1",
        "vehicle_local_position": f"{_DEGREES} above_sea_m=alt/1 altitude_m=height/1 speed_m_s=speed/1",
        "POS": _ARDUPILOT,
    },
    {
        **dict.fromkeys(("GPS_RAW_INT", "GPS2_RAW"), f"{_RECEIVER} accuracy_m=h_acc/1e3"),
        **dict.fromkeys(
            ("vehicle_gps_position", "sensor_gps"),
            f"longitude_deg=longitude_deg/1 latitude_deg=latitude_deg/1 {_SINCE_PX4_1_14} {_RECEIVER} {_ACCURACY}",
        ),
        **dict.fromkeys(("GPS", "GPS2"), f"{_ARDUPILOT} speed_m_s=Spd/1"),
    },
    {"VFR_HUD": "speed_m_s=groundspeed/1", "BARO": "altitude_m=Alt/1", "GPA": "accuracy_m=HAcc/1"},
)
_DEGREES_A_RADIAN = 180 / math.pi
# The heading of the vehicle's nose: message, field and its units per radian; "q" is a quaternion. The best come first.
_HEADINGS = (
    *(("ATTITUDE", "yaw", 1.0), ("vehicle_attitude", "q", 1.0), ("ATT", "Yaw", _DEGREES_A_RADIAN)),
    ("GLOBAL_POSITION_INT", "hdg", 100 * _DEGREES_A_RADIAN),
)
# The attitude of a gimbal: the fields of heading from north, heading from the nose, pitch (up) and roll from the
# horizon, and their units per radian; or a quaternion and the flags of MAVLink's gimbal protocol, version 2.
_GIMBALS: dict[str, tuple[tuple[str, ...], float]] = {
    "GIMBAL_DEVICE_ATTITUDE_STATUS": (("q", "flags"), 1.0),
    "gimbal_device_attitude_status": (("q", "device_flags"), 1.0),
    "MNT": (("YawE", "YawB", "Pitch", "Roll"), _DEGREES_A_RADIAN),
    "MOUNT_ORIENTATION": (("yaw_absolute", "yaw", "pitch", "roll"), _DEGREES_A_RADIAN),
    "MOUNT_STATUS": (("", "pointing_c", "pointing_a", "pointing_b"), 100 * _DEGREES_A_RADIAN),
    "mount_orientation": (("", *(f"attitude_euler_angle[{i}]" for i in (2, 1, 0))), 1.0),
}
_YAW_LOCK, _YAW_IN_VEHICLE, _YAW_IN_EARTH = 16, 32, 64
_PLACE, _RECEIVERS = ("longitude_deg", "latitude_deg"), 1
# The fix that a quantity needs; other quantities need a three-dimensional fix (3). Larger degrees are damage.
_LEAST_FIX = {"altitude_m": 0, "speed_m_s": 2, "accuracy_m": 2, "longitude_deg": 2, "latitude_deg": 2}
_MOST = {"longitude_deg": 180, "latitude_deg": 90}
# The values that mean unknown, and the fields that number the devices of one sender.
_UNKNOWN = {"vel": 65535, "hdg": 65535, "alt_ellipsoid": 0, "altitude_ellipsoid_m": 0, "h_acc": 0}
_DEVICES, _MOST_DEVICES = ("gimbal_device_id", "camera_device_id", "I"), 16
NAMES = {*_PLACES[0], *_PLACES[1], *_PLACES[2], *_GIMBALS, *(name for name, *_ in _HEADINGS), "CAMERA_FOV_STATUS"}
"""The messages that are read."""


def build_flight(log: Log, topics: Topics, clock_offset_s: float, clock_s: float) -> Telemetry:
    """Return the record of one vehicle. clock_s: seconds since 1970 at time 0 of the topics, or NaN."""
    _add_places(log, topics)
    vehicle = _vehicle(topics)
    _add(log, vehicle, {"vehicle_heading_rad": vehicle["yaw"]})
    cameras = {sender: column(topic, "hfov") for sender, topic in topics.get("CAMERA_FOV_STATUS", {}).items()}
    cameras = {sender: np.where((hfov > 0) & (hfov < 180), hfov, np.nan) for sender, hfov in cameras.items()}
    if sender := _pick(log, "camera", cameras):
        _add(log, topics["CAMERA_FOV_STATUS"][sender], {"hfov_rad": np.radians(cameras[sender])}, known=True)
    for name in (name for name in _GIMBALS if name in topics and "heading_rad" not in log.samples):
        attitudes = {sender: _attitude(log, gimbal, *_GIMBALS[name]) for sender, gimbal in topics[name].items()}
        if sender := _pick(log, "gimbal", {sender: pitch for sender, (_, pitch, *_) in attitudes.items()}):
            gimbal, (heading, pitch, roll, is_absolute) = topics[name][sender], attitudes[sender]
            against_nose = heading + heading_at(gimbal["time_s"], vehicle["time_s"], vehicle["yaw"])
            heading = np.where(is_absolute, heading, against_nose)
            _add(log, gimbal, {"heading_rad": heading, "pitch_rad": pitch, "roll_rad": roll})
    return build_record(log, clock_offset_s, clock_s, from_first=True)


def add_topic(topics: Topics, name: str, sender: str, topic: Topic) -> None:
    """Add the messages of a sender, with a separate topic for each device of the sender."""
    device = next((topic[field] for field in _DEVICES if field in topic), None)
    for one in np.zeros(1) if device is None else np.unique(device)[:_MOST_DEVICES]:
        label = f"{sender} device {one:g}".strip() if one or not sender else sender
        mine = topic if device is None else {field: values[device == one] for field, values in topic.items()}
        topics.setdefault(name, {})[label] = mine


def column(topic: Topic, name: str, default: float = np.nan) -> np.ndarray:
    """Return a field as floats. A missing field has the default; values that mean unknown are NaN."""
    values = topic[name].astype(float) if name in topic else np.full(len(topic["time_s"]), default)
    return np.where(values == _UNKNOWN.get(name), np.nan, values) if name in _UNKNOWN else values


def start_clock(messages: Iterable[tuple[np.ndarray, np.ndarray]]) -> float:
    """Return the seconds since 1970 at time 0, NaN if unknown. messages: (utc_s, time_s). Prefer possible dates."""
    utc_s, time_s = np.concatenate([np.zeros((2, 0)), *map(np.stack, messages)], axis=1)
    usable = is_clock(utc_s)
    usable = usable if usable.any() else utc_s > 0
    return float(np.median((utc_s - time_s)[usable])) if usable.any() else math.nan


def _add(log: Log, topic: Topic, values: dict[str, np.ndarray], known: bool = False) -> None:
    log.add_all(topic["time_s"], topic["where"], values, known)


def _vehicle(topics: Topics) -> Topic:
    """Return the times and the headings (`yaw`) of the vehicle's nose; empty if no heading is known."""
    for name, field, per_radian in _HEADINGS:
        for topic in topics.get(name, {}).values():
            yaw = _angles_of(topic)[0] if field == "q" else column(topic, field) / per_radian
            if (is_known := np.isfinite(yaw)).any():
                return {key: values[is_known] for key, values in {**topic, "yaw": yaw}.items()}
    return dict.fromkeys(("time_s", "where", "yaw"), np.zeros(0))


def _angles_of(topic: Topic) -> tuple[np.ndarray, ...]:
    """Return the heading, pitch and roll of a topic with a quaternion."""
    parts = topic["q"] if "q" in topic else np.stack([column(topic, f"q[{i}]") for i in range(4)], axis=1)
    return angles(axes_of_quaternion(parts))


def _attitude(log: Log, gimbal: Topic, fields: tuple[str, ...], per_radian: float) -> tuple[np.ndarray, ...]:
    """Return heading, pitch (down), roll, and whether the heading is from north; otherwise it is from the nose."""
    if fields[0] == "q":
        flags = column(gimbal, fields[1], 0).astype(int)
        is_locked = (flags & _YAW_LOCK > 0) & (flags & _YAW_IN_VEHICLE == 0)
        return *_angles_of(gimbal), (flags & _YAW_IN_EARTH > 0) | is_locked
    if not fields[0]:
        log.note("the mount's pitch and roll are read as angles from the horizon, its yaw from the vehicle's nose")
    north, nose, pitch, roll = (column(gimbal, field) / per_radian for field in fields)
    is_absolute = np.isfinite(north) & (north != 0)
    return np.where(is_absolute, north, nose), -pitch, roll, is_absolute


def _add_places(log: Log, topics: Topics) -> None:
    """Add the place of the best topic with places, and each other quantity from the best topic that contains it."""
    sources: list[tuple[int, int, str, Topic, dict[str, np.ndarray]]] = []
    for rank, group in enumerate(_PLACES):
        for name, fields in group.items():
            for sender, topic in topics.get(name, {}).items():
                values = _values(topic, fields)
                away = np.nan_to_num(sum(np.abs(values.get(key, 0.0)) for key in _PLACE))
                sources.append((rank, int(np.count_nonzero(away)), f"{name} {sender}", topic, values))
    sources.sort(key=lambda one: (one[0], -one[1] if one[0] == _RECEIVERS else 0))
    for rank, fixes, name, topic, values in sorted(sources, key=lambda one: not one[1])[:1]:
        _add(log, topic, {key: values[key] for key in _PLACE if key in values})
        others = ", ".join([f"{one[2]} ({one[1]})" for one in sources if one[0] == _RECEIVERS and one[2] != name][:9])
        if not fixes:
            log.note("nothing in the log has a fix: its places are unknown")
        elif rank == _RECEIVERS and others:
            log.note(f"several receivers report: {name} is used, with {fixes} fixes; left out: {others}")
    for *_, topic, values in sources:
        _add(log, topic, {key: one for key, one in values.items() if key not in log.samples and np.isfinite(one).any()})


def _values(topic: Topic, fields: str) -> dict[str, np.ndarray]:
    """Return the quantities of a topic. Without a fix, the place is 0, 0 and other quantities are NaN."""
    fix = column(topic, "fix_type" if "fix_type" in topic else "Status", 3)
    fix = np.where(column(topic, "lat_lon_valid", 1) > 0, fix, 0)
    values: dict[str, np.ndarray] = {}
    for quantity, field, per_unit in re.findall(r"(\w+)=(\w+)/(\w+)", fields):
        if field in topic and quantity not in values:
            given = column(topic, field) / float(per_unit)
            given[np.abs(given) > _MOST.get(quantity, np.inf)] = np.nan
            values[quantity] = np.where(fix >= _LEAST_FIX.get(quantity, 3), given, 0 if quantity in _PLACE else np.nan)
    return values


def _pick(log: Log, what: str, values: Mapping[str, np.ndarray]) -> str | None:
    """Return the first sender with over half as many known values as the best sender, and note the others."""
    known = {sender: count for sender, one in values.items() if (count := np.isfinite(one).sum())}
    chosen = next((sender for sender, count in known.items() if count > max(known.values()) / 2), None)
    others = [sender for sender in values if sender != chosen]
    if chosen is not None and " of system " in chosen:
        log.note(f"the {what} is {chosen}, which is not the vehicle's")
    if chosen is not None and others:
        log.note(f"several {what}s report: {chosen} is used; left out: {', '.join(others[:9])}")
    return chosen
