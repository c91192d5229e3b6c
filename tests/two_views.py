"""Walkers on a plane as two cameras see them, each with its own numbers, for tests of shared identities."""

import numpy as np

from torchvision_dddas.geometry import transfer
from torchvision_dddas.types import Positions, Tracks

SIZE = (1280, 720)


def camera(heading_deg, east=0.0, north=0.0, height_m=30.0, tilt_deg=50.0):
    """(3, 3) picture from ground, of a camera that looks at a place."""
    yaw, tilt = np.radians([heading_deg, tilt_deg])
    ahead = np.array([np.sin(yaw), np.cos(yaw), 0])
    forward = np.cos(tilt) * ahead - [0, 0, np.sin(tilt)]
    right = np.array([np.cos(yaw), -np.sin(yaw), 0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    centre = np.array([east, north, height_m]) - ahead * height_m / np.tan(tilt)
    inner = np.array([[950, 0, 639.5], [0, 950, 359.5], [0, 0, 1]])
    return (inner @ np.c_[rotation, -rotation @ centre])[:, [0, 1, 3]]


def walk(frames=80, count=24, seed=0):
    """(T, N, 2) places, metres."""
    rng = np.random.default_rng(seed)
    angle, speed = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.05, 0.3, count)
    step = np.c_[np.cos(angle), np.sin(angle)] * speed[:, None]
    return rng.uniform(-12, 12, (count, 2)) + step * (np.arange(frames)[:, None, None] - frames / 2)


def boxes(places, picture_from_ground, first, frame):
    """The tracks of those in the picture, numbered from `first` in the places' order, people of 2 m by 0.7 m."""
    foot = transfer(picture_from_ground, places)
    depth = np.c_[places, np.ones(len(places))] @ picture_from_ground[2]
    size = 950 * np.array([0.7, 1.4]) / depth[:, None]
    box = np.c_[foot + 0.5 - size * (0.5, 1), size]
    rows = np.flatnonzero(((box[:, :2] > 0) & (box[:, :2] + box[:, 2:] < SIZE)).all(1))
    return Tracks(frame, first + rows, box[rows])


def metres(places, first, frame, shift=(0.0, 0.0), seed=0):
    """The same as positions, with errors of 0.3 m and a common shift."""
    rng = np.random.default_rng([seed, frame, first])
    number = np.arange(len(places))
    return Positions(
        np.full(len(places), frame),
        first + number,
        places + shift + rng.normal(0, 0.3, places.shape),
        np.tile(0.09 * np.eye(2), (len(places), 1, 1)),
    )
