"""Where a camera stood in each frame, between the samples of a table."""

from dataclasses import replace

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry.geodesy import wrap_longitude
from torchvision_dddas.types import Camera, Poses, PoseTable


def poses_at(
    camera: Camera, table: PoseTable | None, frame: np.ndarray, rate_hz: float | None = None
) -> tuple[Camera, Poses]:
    """The camera, with the kind of place that its poses have, and where it stood in each frame.

    Between samples place and pitch go straight on, heading and longitude by the shorter way round.
    Raises InputError where the poses do not cover the frames, or are timed and there is no rate.
    """
    n = len(frame)
    place = np.tile(camera.place, (n, 1)).astype(float)
    heading, pitch = np.full(n, float(camera.heading_rad)), np.full(n, float(camera.pitch_rad))
    if table is None:
        return camera, Poses(place, heading, pitch)
    if table.timed and rate_hz is None:
        raise InputError(f"poses {table.path} are by time_s; say with --rate how many frames a second there are")
    at, values = table.at, table.values
    when = (np.asarray(frame) - 1) / rate_hz if table.timed and rate_hz else np.asarray(frame, float)
    outside = (when < at[0] - 1e-6) | (when > at[-1] + 1e-6)
    if outside.any():
        unit = "seconds" if table.timed else "frames"
        first = int(outside.argmax())
        raise InputError(
            f"poses {table.path} cover {unit} {at[0]:g} to {at[-1]:g}; {int(outside.sum())} of {n} rows of "
            f"the table lie outside, the first at frame {frame[first]}. Give poses for all of them"
        )
    if "longitude_deg" in values:
        # A longitude goes on over 180 degrees, not back through 0.
        longitude = np.interp(when, at, np.unwrap(values["longitude_deg"], period=360))
        place = wrap_longitude(np.stack([longitude, np.interp(when, at, values["latitude_deg"])], axis=1))
        camera = replace(camera, geographic=True)
    elif "east_m" in values:
        place = np.stack([np.interp(when, at, values[key]) for key in ("east_m", "north_m")], axis=1)
        camera = replace(camera, geographic=False)
    if "heading_deg" in values:
        heading = np.interp(when, at, np.unwrap(np.radians(values["heading_deg"])))
    if "pitch_deg" in values:
        pitch = np.interp(when, at, np.radians(values["pitch_deg"]))
    return camera, Poses(place, heading, pitch)
