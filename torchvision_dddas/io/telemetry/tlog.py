"""MAVLink telemetry logs of a ground station: messages, each behind the time at which it came."""

import math
from pathlib import Path

import numpy as np

from torchvision_dddas.io.telemetry.attitude import angles, axes_of_quaternion, heading_at
from torchvision_dddas.io.telemetry.log import Log
from torchvision_dddas.io.telemetry.mavlink import Said, messages
from torchvision_dddas.io.telemetry.record import assembled
from torchvision_dddas.types import Telemetry

_UNKNOWN_16 = 0xFFFF
_YAW_LOCK, _YAW_IN_VEHICLE, _YAW_IN_EARTH = 16, 32, 64


def read_tlog(path: Path, clock_offset_s: float) -> Telemetry:
    """Positions and attitudes of the vehicle that reports most; times since the first of them.

    Raises InputError where no vehicle reports any.
    """
    log = Log(path, "MAVLink log", "byte", bridge_s=2.0)
    said = _on_vehicle_clock(log, messages(log))
    get = said.get
    places = get("GLOBAL_POSITION_INT", [])
    for time_s, m, byte in places:
        _say_place(log, time_s, m.lon, m.lat, byte)
        log.say("above_sea_m", time_s, m.alt / 1e3, byte)
        log.say("altitude_m", time_s, m.relative_alt / 1e3, byte)
        log.say("speed_m_s", time_s, math.hypot(m.vx, m.vy) / 100, byte)
    if not places:
        for time_s, m, byte in get("GPS_RAW_INT", []):
            fixed = m.fix_type >= 2
            _say_place(log, time_s, m.lon if fixed else 0, m.lat if fixed else 0, byte)
            log.say("above_sea_m", time_s, m.alt / 1e3 if m.fix_type >= 3 else math.nan, byte)
            log.say("speed_m_s", time_s, m.vel / 100 if fixed and m.vel != _UNKNOWN_16 else math.nan, byte)
    for time_s, m, byte in get("VFR_HUD", []) if "speed_m_s" not in log.said else []:
        log.say("speed_m_s", time_s, m.groundspeed, byte)
    yaws = [(t, m.yaw, byte) for t, m, byte in get("ATTITUDE", [])]
    yaws = yaws or [(t, math.radians(m.hdg / 100), byte) for t, m, byte in places if m.hdg != _UNKNOWN_16]
    for row in yaws:
        log.say("vehicle_heading_rad", *row)
    _say_camera(log, said, np.array([(t, yaw) for t, yaw, _ in yaws]).reshape(-1, 2))
    return assembled(log, clock_offset_s, 0.0, from_first=True)  # its times are since 1970


def _on_vehicle_clock(log: Log, said: dict[str, Said]) -> dict[str, Said]:
    """The same with the times at which the vehicle sent them, as its own clock tells.

    Messages come in bursts, a second late or more; at 20 m/s that is 20 m. The least delay counts as none. A message
    that tells no time has that of the one before. Where the clocks do not go alike, as they came.
    """
    rows = sorted(((byte, time_s, m) for of in said.values() for time_s, m, byte in of), key=lambda row: row[0])
    came = np.array([time_s for _, time_s, _ in rows])
    sent = np.array([getattr(message, "time_boot_ms", np.nan) / 1e3 for *_, message in rows])
    told = np.isfinite(sent)
    if told.sum() < 2:
        return said
    apart, span_s = (came - sent)[told], float(np.ptp(sent[told]))
    alike = np.abs(apart - np.median(apart)) < 5 + 0.01 * span_s
    if alike.mean() < 0.9:  # a few may be damaged: no checksum covers the times
        log.note("the vehicle's clock and the station's do not go alike: times are those at which messages came")
        return said
    sent = sent[np.maximum.accumulate(np.where(told, np.arange(len(sent)), np.argmax(told)))]
    times = dict(zip((byte for byte, *_ in rows), (sent + np.percentile(apart[alike], 1)).tolist(), strict=True))
    log.jitter_s = math.inf  # what came out of order is put in order
    return {name: [(times[byte], message, byte) for _, message, byte in of] for name, of in said.items()}


def _say_place(log: Log, time_s: float, longitude: int, latitude: int, byte: int) -> None:
    known = abs(latitude) <= 90e7 and abs(longitude) <= 180e7
    log.say("longitude_deg", time_s, longitude / 1e7 if known else math.nan, byte)
    log.say("latitude_deg", time_s, latitude / 1e7 if known else math.nan, byte)


def _say_camera(log: Log, said: dict[str, Said], yaw: np.ndarray) -> None:
    """How the gimbal points, by the best message that there is."""
    for time_s, m, byte in said.get("CAMERA_FOV_STATUS", []):
        if 0 < m.hfov < 180:
            log.say("hfov_rad", time_s, math.radians(m.hfov), byte)
    if rows := said.get("GIMBAL_DEVICE_ATTITUDE_STATUS", []):
        heading, pitch, roll = angles(axes_of_quaternion(np.array([m.q for _, m, _ in rows], float)))
        earth = [
            bool(m.flags & _YAW_IN_EARTH) or (m.flags & _YAW_LOCK and not m.flags & _YAW_IN_VEHICLE) for _, m, _ in rows
        ]
        turned = np.array(earth, bool)
    elif rows := said.get("MOUNT_ORIENTATION", []):
        absolute = np.array([m.yaw_absolute for _, m, _ in rows], float)
        turned = np.isfinite(absolute) & (absolute != 0)
        heading = np.radians(np.where(turned, absolute, [m.yaw for _, m, _ in rows]))
        pitch, roll = (np.radians([getattr(m, name) for _, m, _ in rows]) for name in ("pitch", "roll"))
        pitch = -pitch
    elif rows := said.get("MOUNT_STATUS", []):
        pitch, roll, heading = (
            np.radians([getattr(m, f"pointing_{axis}") / 100 for _, m, _ in rows]) for axis in "abc"
        )
        pitch, turned = -pitch, np.zeros(len(rows), bool)
        log.note("the mount's pitch and roll are taken against the horizon, its yaw against the vehicle")
    else:
        return
    times = np.array([time_s for time_s, _, _ in rows])
    heading = np.where(turned, heading, heading + heading_at(times, yaw[:, 0], yaw[:, 1]))
    for name, values in (("heading_rad", heading), ("pitch_rad", pitch), ("roll_rad", roll)):
        for (time_s, _, byte), value in zip(rows, values.tolist(), strict=True):
            log.say(name, time_s, value, byte)
