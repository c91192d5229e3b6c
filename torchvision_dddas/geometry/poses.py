"""Interpolate the poses of a camera between the rows of a table."""

from dataclasses import replace

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry.geodesy import wrap_longitude
from torchvision_dddas.types import Camera, Poses, PoseTable


def poses_at(
    camera: Camera, table: PoseTable | None, frame: np.ndarray, rate_hz: float | None = None
) -> tuple[Camera, Poses]:
    """Return the camera, marked as geographic if its poses are, and its poses in each frame.

    Position and pitch are interpolated linearly between rows, heading and longitude along the shorter arc. table: None
    gives the camera's own pose in every frame. frame: (N,) numbers from 1.
    Raises InputError if the poses do not cover the frames, or are by time and there is no rate.
    """
    n = len(frame)
    place = np.tile(camera.place, (n, 1)).astype(float)
    heading, pitch = np.full(n, float(camera.heading_rad)), np.full(n, float(camera.pitch_rad))
    if table is None:
        return camera, Poses(place, heading, pitch)
    if table.timed and rate_hz is None:
        raise InputError(f"poses {table.path} are by time_s; give the number of frames a second with --rate")
    at, values = table.at, table.values
    when = (np.asarray(frame) - 1) / rate_hz if table.timed and rate_hz else np.asarray(frame, float)
    outside = (when < at[0] - 1e-6) | (when > at[-1] + 1e-6)
    if outside.any():
        unit = "seconds" if table.timed else "frames"
        first = int(outside.argmax())
        raise InputError(
            f"poses {table.path} cover {unit} {at[0]:g} to {at[-1]:g}; {int(outside.sum())} of {n} rows of "
            f"the table lie outside, the first at frame {frame[first]}. Give poses for all frames"
        )
    if "longitude_deg" in values:
        # Unwrap the longitude, so that interpolation across 180 degrees does not pass through 0.
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
