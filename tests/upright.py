"""Upright people on flat ground in a camera's picture, by OpenCV's projection: the truth that ranging must find."""

import cv2
import numpy as np

from torchvision_dddas.types import Camera, Poses


def camera(**known):
    """A camera of 1280×960 pixels, 1.2 m high, level, looking north, unless said otherwise."""
    usual = {"focal_px": (1000.0, 1000.0), "centre_px": (639.5, 479.5), "height_m": 1.2}
    return Camera("test", (1280, 960), **{**usual, **known})


def boxes(people, tall, cam, place=(0.0, 0.0)):
    """(N, 4) boxes of people who stand at (N, 2) east, north, so tall (N,); without any noise."""
    people = np.asarray(people, float)
    ends = [pixels(np.column_stack([people, np.broadcast_to(up, len(people))]), cam, place) for up in (0.0, tall)]
    (u, feet), (_, head) = (end.T for end in ends)
    height = feet - head
    return np.stack([u + 0.5 - 0.2 * height, head + 0.5, 0.4 * height, height], axis=1)


def pixels(points, cam, place=(0.0, 0.0)):
    """(N, 2) pixels of (N, 3) points east, north, up."""
    sin, cos = np.sin, np.cos
    h, p, r = cam.heading_rad, cam.pitch_rad, cam.roll_rad
    right, ahead = np.array([cos(h), -sin(h), 0]), np.array([sin(h) * cos(p), cos(h) * cos(p), -sin(p)])
    down = np.cross(ahead, right)
    rotation = np.array([right * cos(r) + down * sin(r), down * cos(r) - right * sin(r), ahead])
    inner = np.array([[cam.focal_px[0], 0, cam.centre_px[0]], [0, cam.focal_px[1], cam.centre_px[1]], [0, 0, 1]])
    offset = -rotation @ [*place, cam.height_m]
    bend = np.array(cam.distortion)
    return cv2.projectPoints(np.asarray(points, float), cv2.Rodrigues(rotation)[0], offset, inner, bend)[0][:, 0]


def poses(cam, n, place=(0.0, 0.0)):
    """The camera standing still for n rows."""
    return Poses(np.tile(np.asarray(place, float), (n, 1)), np.full(n, cam.heading_rad), np.full(n, cam.pitch_rad))
