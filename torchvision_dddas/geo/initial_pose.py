"""Poses to begin with, where telemetry does not tell all: from what it tells of the tilt, or from a homography."""

from dataclasses import fields, replace

import numpy as np

from torchvision_dddas.geo.pose_estimation import HEADING, Expected, Solution, fit_pose, moved
from torchvision_dddas.geo.projection import lifted, rays
from torchvision_dddas.geometry import turned
from torchvision_dddas.types import Bool, Camera, CameraPose, LandmarkObservations

HEADINGS = 8
"""So many are tried where nothing else tells one."""


def find_pose(
    marks: LandmarkObservations, camera: Camera, expected: Expected, used: Bool[np.ndarray, "n"] | None = None
) -> Solution | None:
    """The likeliest of the poses that the starts at hand lead to; None where none does.

    used: the landmarks whose pixels count; all without it.
    """
    used = np.ones(len(marks), bool) if used is None else used
    known = expected.known
    if known.all():
        first = fit_pose(marks, camera, expected, used=used)
        if first is not None:
            return first
    seen = rows(marks, used)
    starts = [] if known.all() else _turned_about_up(seen, camera, expected)
    if len(seen) >= 4 and not (starts and known[:2].all() and known[5]):
        starts += of_homography(_plain(seen, camera), camera, seen.east_north_m, seen.up_m)
    if not starts and known[[0, 1, 3, 4, 5]].all():
        starts = _all_headings(expected)
    found = [one for start in starts if (one := fit_pose(marks, camera, expected, start, used)) is not None]
    return min(found, key=lambda one: one.cost) if found else None


def rows(marks: LandmarkObservations, which: np.ndarray) -> LandmarkObservations:
    """Some of the landmarks of a frame: by their numbers or a (n,) bool."""
    return replace(marks, **{column.name: getattr(marks, column.name)[which] for column in fields(marks)})


def _turned_about_up(marks: LandmarkObservations, camera: Camera, expected: Expected) -> list[CameraPose]:
    """With a known tilt the pixels lie on the ground but for turn, size and place, which the landmarks tell."""
    known, pose = expected.known, moved(expected.reference, expected.mean[:7])
    if not known[:2].all() or len(marks) == 0:
        return []
    way = rays(marks.image_px, pose, camera)
    if not (way[:, 2] < -1e-3 * np.linalg.norm(way, axis=1)).all():
        return []
    east_north = marks.east_north_m
    height = pose.place_m[2] - marks.up_m if known[5] else np.ones(len(marks))
    seen = (way[:, :2] * (-height / way[:, 2])[:, None]) @ [1, 1j]
    there = east_north @ [1, 1j]
    seen_apart, there_apart = seen - seen.mean(), there - there.mean()
    size = float((np.abs(seen_apart) ** 2).sum())
    if size < 1e-12 and not (known[HEADING] and known[5]):
        return []
    across = complex(seen_apart.conj() @ there_apart) / max(size, 1e-12)
    if not known[5] and known[HEADING]:
        grown = max(across.real, 1e-6)
    else:
        grown = 1.0 if known[5] else abs(across)
    turn = 0.0 if known[HEADING] else float(np.angle(across))
    middle = there.mean() - grown * np.exp(1j * turn) * seen.mean()
    place = pose.place_m.copy()
    if not known[5]:
        place[2] = grown + float(marks.up_m.mean())
    place[:2] = np.where(known[3:5], place[:2], [middle.real, middle.imag])
    axes = turned(np.array([0.0, 0.0, turn])) @ pose.axes
    return [CameraPose(place, axes, pose.focal)]


def _all_headings(expected: Expected) -> list[CameraPose]:
    """With all known but the heading: looking every way."""
    pose = moved(expected.reference, expected.mean[:7])
    turns = np.linspace(0, 2 * np.pi, HEADINGS, endpoint=False)
    return [replace(pose, axes=turned(np.array([0.0, 0.0, turn])) @ pose.axes) for turn in turns]


def of_homography(flat_from_ground: np.ndarray, camera: Camera, east_north_m: np.ndarray, up_m: np.ndarray) -> list:
    """Poses that see the ground as a homography says, and as its mirror does that is hard to tell from afar.

    flat_from_ground: (3, 3) from local metres to metres right and down a metre of depth.
    """
    middle = east_north_m.mean(axis=0)
    shift = np.eye(3)
    shift[:2, 2] = middle
    matrix = flat_from_ground @ shift
    if not np.isfinite(matrix).all():
        return []
    scale = np.sqrt(np.linalg.norm(matrix[:, 0]) * np.linalg.norm(matrix[:, 1]))
    if not scale > 0:
        return []
    matrix = matrix / scale
    # The ground's middle is before the camera.
    matrix = matrix if matrix[2, 2] > 0 else -matrix
    two, _, other = np.linalg.svd(matrix[:, :2], full_matrices=False)
    east_north = two @ other
    first = np.column_stack([east_north, np.cross(east_north[:, 0], east_north[:, 1])])  # camera axes from the world's
    poses = [_seen_so(first, matrix[:, 2], middle, float(up_m.mean()))]
    # The mirror: the ground's normal reflected at the line of sight to its middle.
    sight = matrix[:, 2] / np.linalg.norm(matrix[:, 2])
    normal = first[:, 2]
    mirrored = 2 * (sight @ normal) * sight - normal
    axis = np.cross(normal, mirrored)
    sine = np.linalg.norm(axis)
    if sine > 1e-6:
        turn = turned(axis / sine * np.arctan2(sine, normal @ mirrored))
        poses.append(_seen_so(turn @ first, matrix[:, 2], middle, float(up_m.mean())))
    # Seen from below the ground it is no picture from the air.
    return [pose for pose in poses if pose.place_m[2] > 0]


def _seen_so(camera_from_world: np.ndarray, middle_seen: np.ndarray, middle: np.ndarray, up_m: float) -> CameraPose:
    place = np.array([*middle, up_m]) - camera_from_world.T @ middle_seen
    return CameraPose(place, camera_from_world.T)


def _plain(marks: LandmarkObservations, camera: Camera) -> np.ndarray:
    """(3, 3) homography from local metres to metres right and down a metre of depth, unweighed: a start."""
    ground, flat = marks.east_north_m, lifted(marks.image_px, 1.0, camera)
    middle, size = ground.mean(axis=0), max(float(np.abs(ground - ground.mean(axis=0)).max()), 1e-9)
    x, y = ((ground - middle) / size).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    u, v = flat.T
    rows = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=1),
        ]
    )
    matrix = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    return matrix @ np.array([[1 / size, 0, -middle[0] / size], [0, 1 / size, -middle[1] / size], [0, 0, 1]])
