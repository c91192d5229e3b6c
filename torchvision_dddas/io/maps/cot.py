"""Located targets as Cursor-on-Target events, the XML that situational-awareness tools exchange."""

import math

import numpy as np

from torchvision_dddas.io.maps.ellipses import semi_axes
from torchvision_dddas.io.maps.ground_tracks import GroundTracks, iso_utc
from torchvision_dddas.io.maps.kml import xml_text

UNKNOWN = "9999999.0"
"""A height or an error that is not known."""

KIND = "a-u-G"
"""An atom on the ground of unknown affiliation."""

STALE_S = 10.0
"""How long an event is valid."""


def cot(tracks: GroundTracks, source: str = "dddas") -> str:
    """`<events>` in the order of time, a line each, at most one per target and second.

    ce is one standard deviation along the ellipse's longer axis; how="m-f" is fused from several machine sources.
    uid: the source, the start of the clip, the target. Raises ValueError without a geographic origin or a clock.
    Source: MITRE, Event-PUBLIC.xsd, version 2.0.
    """
    if tracks.lonlat_deg is None or tracks.times_utc is None:
        raise ValueError("these positions have no longitude and latitude, or no clock")
    rows = np.array([row for of in tracks.of.values() for row in _each_second(tracks, of)], int)
    rows = rows[np.lexsort((tracks.target[rows], tracks.time_s[rows]))]
    axes, _ = semi_axes(tracks.covariance_m2[rows], chi2=1.0)
    stale = iso_utc(tracks.start_utc_s + tracks.time_s[rows] + STALE_S)
    lines = []
    for row, (sigma_m, _), until in zip(rows.tolist(), axes.tolist(), stale, strict=True):
        longitude, latitude = tracks.lonlat_deg[row].tolist()
        uid = event_uid(source, tracks.start_utc_s, tracks.target[row])
        when = tracks.times_utc[row], until
        lines.append(event(uid, tracks.target[row], when, (longitude, latitude), sigma_m, tracks.velocity_m_s[row]))
    return '<?xml version="1.0" encoding="UTF-8"?>\n<events>\n' + "".join(lines) + "</events>\n"


def event_uid(source: str, start_utc_s: float, target: int) -> str:
    """The uid of a target of a run."""
    return f"{xml_text(source)}-{start_utc_s:.0f}-{target}"


def event(
    uid: str,
    target: int,
    when: tuple[str, str],
    lonlat_deg: tuple[float, float],
    sigma_m: float,
    velocity_m_s: np.ndarray,
) -> str:
    """One event, a line. when: its time, and the time until which it is valid. sigma_m: becomes ce."""
    longitude, latitude = lonlat_deg
    time, stale = when
    return (
        f'<event version="2.0" uid="{uid}" type="{KIND}" how="m-f" time="{time}" start="{time}" stale="{stale}">'
        f'<point lat="{latitude:.8f}" lon="{longitude:.8f}" hae="{UNKNOWN}" ce="{_metres(sigma_m)}" le="{UNKNOWN}"/>'
        f'<detail><contact callsign="target {target}"/>{_motion(velocity_m_s)}</detail></event>\n'
    )


def _each_second(tracks: GroundTracks, rows: slice) -> list[int]:
    """At most one row per second; unlike `spaced` without a last row that comes sooner."""
    chosen = tracks.spaced(1.0, rows)
    if len(chosen) > 1 and tracks.time_s[chosen[-1]] - tracks.time_s[chosen[-2]] < 1.0 - 1e-6:
        chosen.pop()
    return chosen


def _metres(sigma: float) -> str:
    return f"{sigma:.2f}" if math.isfinite(sigma) else UNKNOWN


def _motion(velocity_m_s: np.ndarray) -> str:
    east, north = velocity_m_s.tolist()
    if not (math.isfinite(east) and math.isfinite(north)):
        return ""
    course = round(math.degrees(math.atan2(east, north)), 1) % 360
    return f'<track course="{course:.1f}" speed="{math.hypot(east, north):.2f}"/>'
