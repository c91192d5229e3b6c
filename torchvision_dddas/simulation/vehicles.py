"""Cars and ground vehicles as flat faces, laid out once about their middle and then placed."""

from functools import cache
from typing import NamedTuple

import numpy as np

from torchvision_dddas.simulation.bodies import Body, car_faces

# A rover of the size of a small buggy: its plate still has some 20 pixels at 200 m in a picture 640 wide.
UGV_LENGTH_M, UGV_WIDTH_M, UGV_HEIGHT_M = 2.4, 1.7, 0.95
PLATE_M = (1.9, 1.5)  # the coloured marker on top: along, across
COVERED = np.array([118.0, 122.0, 124.0])  # BGR of a marker that is covered


class Faces(NamedTuple):
    """Faces of a vehicle, each a flat convex outline of corners about its middle: ahead, left, up in metres.

    corners_m: (F, C, 3), the last corner repeated where there are fewer than C. normal: (F, 3) outwards. colour:
    (F, 3) BGR where the paint is black; paint, plate: (F,) how much of those colours is added. lit: (F,) bool,
    whether the sun shades it.
    """

    corners_m: np.ndarray
    normal: np.ndarray
    colour: np.ndarray
    paint: np.ndarray
    plate: np.ndarray
    lit: np.ndarray


@cache
def car() -> Faces:
    """A car, as bodies draws it."""
    black, white = (car_faces(Body("car", np.zeros(2), np.zeros(2), (tone,) * 3), 0.0) for tone in (0.0, 1.0))
    corners = _stacked([face[0] for face in black])
    colour = np.array([face[2] for face in black])
    paint = np.array([face[2][0] for face in white]) - colour[:, 0]
    normal = np.array([face[1] for face in black])
    return Faces(corners, normal, colour, paint, np.zeros(len(paint)), np.array([face[3] for face in black]))


@cache
def ugv() -> Faces:
    """A ground vehicle: six wheels, a hull, and the marker on top in its middle."""
    rows: list[tuple[np.ndarray, np.ndarray, float, float]] = []

    def box(middle: tuple[float, float, float], size: tuple[float, float, float], tone: float, paint: float) -> None:
        for axis in range(3):
            for sign in (-1.0, 1.0):
                if axis == 2 and sign < 0:
                    continue
                a, b = (k for k in range(3) if k != axis)
                corners = np.zeros((4, 3))
                corners[:, axis] = sign
                corners[:, a], corners[:, b] = (1, 1, -1, -1), (1, -1, -1, 1)
                normal = np.zeros(3)
                normal[axis] = sign
                rows.append((np.array(middle) + corners * np.array(size) / 2, normal, tone, paint))

    for along in (-0.82, 0.0, 0.82):
        for aside in (-0.7, 0.7):
            box((along, aside, 0.33), (0.66, 0.3, 0.66), 34.0, 0.0)
    box((0.0, 0.0, 0.5), (UGV_LENGTH_M, 1.08, 0.5), 12.0, 0.9)
    box((1.0, 0.0, 0.95), (0.16, 0.3, 0.5), 40.0, 0.0)
    top = np.array([(1, 1, 0), (1, -1, 0), (-1, -1, 0), (-1, 1, 0)]) * [PLATE_M[0] / 2, PLATE_M[1] / 2, 0]
    rows.append((top + np.array([0, 0, UGV_HEIGHT_M]), np.array([0.0, 0.0, 1.0]), 0.0, 0.0))
    plate = np.zeros(len(rows))
    plate[-1] = 1
    return Faces(
        np.stack([row[0] for row in rows]),
        np.stack([row[1] for row in rows]),
        np.array([[row[2]] * 3 for row in rows]),
        np.array([row[3] for row in rows]),
        plate,
        np.ones(len(rows), bool),
    )


def placed(faces: Faces, place_m: np.ndarray, facing_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners (F, C, 3) and normals (F, 3) of a vehicle that stands at a place (3,) and faces so, from north."""
    sine, cosine = np.sin(facing_rad), np.cos(facing_rad)
    local_from_body = np.array([[sine, -cosine, 0.0], [cosine, sine, 0.0], [0.0, 0.0, 1.0]])
    return faces.corners_m @ local_from_body.T + place_m, faces.normal @ local_from_body.T


def _stacked(outlines: list[np.ndarray]) -> np.ndarray:
    most = max(len(outline) for outline in outlines)
    return np.stack([np.pad(outline, ((0, most - len(outline)), (0, 0)), mode="edge") for outline in outlines])
