"""Bodies and their shadows as convex outlines in a picture from the air."""

from typing import NamedTuple

import numpy as np

from torchvision_dddas.simulation.aerial_ground import equal_runs
from torchvision_dddas.simulation.agents import Moment
from torchvision_dddas.simulation.people_shapes import Wardrobe, limb_capsules
from torchvision_dddas.simulation.relief import SHADE_BGR
from torchvision_dddas.simulation.shutter import Shutter
from torchvision_dddas.simulation.vehicle_shapes import COVERED_BGR, car_faces, place_faces, ugv_faces
from torchvision_dddas.simulation.world import World

_SKYLIGHT = 0.45  # how bright a face is that the sun does not reach
_PLAIN_PX_M = 12.0  # where a metre is smaller, a limb has one tone
_THICK_M = 0.055  # and than this out of shadows there
_THIN_M = 0.04  # limbs thinner than this are left out there, and out of all shadows


class Outlines(NamedTuple):
    """Convex outlines in the order to draw them, one row each.

    body: (M,) int, a row of the moment's bodies; those of one body follow each other. points_px: (M, C, 2).
    colour: (M, 3) BGR. up_m: (M,) above the ground.
    """

    body: np.ndarray
    points_px: np.ndarray
    colour: np.ndarray
    up_m: np.ndarray

    @property
    def runs(self) -> list[tuple[int, int]]:
        """The first row of each body and the one after its last."""
        return list(equal_runs(self.body))


class Shapes:
    """Gives bodies their shape: limbs or faces, as lit by the sun."""

    def __init__(self, world: World, shutter: Shutter, seed: int) -> None:
        self._world, self._shutter, self._wardrobe = world, shutter, Wardrobe(seed)

    def outlines(
        self, moment: Moment, rows: np.ndarray, scale_px_m: float, shaded: np.ndarray
    ) -> tuple[Outlines, Outlines]:
        """The outlines of bodies, in the order of rows (N,), and of their shadows on the ground.

        scale_px_m: pixels for each metre at the nearest. shaded: (N,) how much of each stands in other things' shade.
        """
        bodies = moment.bodies
        rank = np.zeros(len(bodies), np.int64)
        rank[rows] = np.arange(len(rows))
        dim = np.ones((len(bodies), 3))
        dim[rows] = 1 - shaded[:, None] * (1 - SHADE_BGR)
        people = rows[bodies.kind[rows] == "person"]
        limb_body, ends, radius, limb_colour = self._limbs(moment, people, scale_px_m)
        face_body, corners, face_colour, seen = self._faces(moment, rows[bodies.kind[rows] != "person"])

        # One projection for all: limbs' ends, corners, and the shadows of both.
        solid = np.concatenate([ends.reshape(-1, 3), corners.reshape(-1, 3)])
        body = np.concatenate([limb_body.repeat(2), face_body.repeat(corners.shape[1])])
        cast = self._cast(solid, bodies.place_m[body, 2])
        velocity = np.c_[bodies.velocity_m_s, np.zeros(len(bodies))][body]
        px, depth = self._shutter.project(moment, np.concatenate([solid, cast]), np.tile(velocity, (2, 1)))
        px, depth = px.reshape(2, -1, 2), depth.reshape(2, -1)
        limbs = 2 * len(ends)
        ends_px = px[:, :limbs].reshape(2, len(ends), 2, 2)
        focal = self._shutter.camera.focal_px[0] * moment.pose.focal
        radius_px = radius * focal / depth[:, :limbs].reshape(2, len(ends), 2)
        corners_px = px[:, limbs:].reshape(2, *corners.shape[:2], 2)

        sun = self._world.to_sun @ moment.pose.axes
        facing = max(-float(sun[2]), 0.0)
        dark, bright = 0.5 + 0.2 * facing, 0.9 + 0.2 * facing
        up = (ends[..., 2] - bodies.place_m[limb_body, 2, None]).mean(axis=1)
        points = 5 if scale_px_m < 30 else 7
        if scale_px_m < _PLAIN_PX_M:
            people_seen = Outlines(
                limb_body,
                limb_capsules(ends_px[0], radius_px[0], points),
                limb_colour * (0.45 * dark + 0.55 * bright),
                up,
            )
        else:
            whole = limb_capsules(ends_px[0], radius_px[0], points)
            part = limb_capsules(ends_px[0] + radius_px[0, ..., None] * sun[:2] * 0.35, radius_px[0] * 0.72, points)
            both = np.stack([whole, part], axis=1).reshape(2 * len(whole), *whole.shape[1:])
            tones = np.stack([limb_colour * dark, limb_colour * bright], axis=1).reshape(-1, 3)
            people_seen = Outlines(limb_body.repeat(2), both, tones, up.repeat(2))
        thick = radius.max(axis=1) > (_THIN_M if scale_px_m >= _PLAIN_PX_M else _THICK_M)
        people_shade = Outlines(
            limb_body[thick], limb_capsules(ends_px[1][thick], radius_px[1][thick], points),
            np.zeros((thick.sum(), 3)), np.zeros(thick.sum()),
        )  # fmt: skip
        middle_up = corners[..., 2].mean(axis=1) - bodies.place_m[face_body, 2]
        faces_seen = Outlines(face_body[seen], corners_px[0][seen], face_colour[seen], middle_up[seen])
        faces_shade = Outlines(face_body, corners_px[1], np.zeros((len(face_body), 3)), np.zeros(len(face_body)))
        solids, shadows = _joined(people_seen, faces_seen, rank), _joined(people_shade, faces_shade, rank)
        return solids._replace(colour=solids.colour * dim[solids.body]), shadows

    def _limbs(
        self, moment: Moment, rows: np.ndarray, scale_px_m: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The limbs of people, far ones first: body (M,), ends (M, 2, 3), radii (M, 2), colour (M, 3)."""
        bodies = moment.bodies
        if not len(rows):
            return np.zeros(0, np.int64), np.zeros((0, 2, 3)), np.zeros((0, 2)), np.zeros((0, 3))
        shape = self._wardrobe.figures_of(bodies, rows)
        # What is not worn has no size.
        thin = _THIN_M if scale_px_m < _PLAIN_PX_M else 0.0
        person, limb = np.nonzero(np.isfinite(shape.radius_m).all(axis=2) & (shape.radius_m.max(axis=2) > thin))
        ends = shape.ends_m[person, limb]
        depth = (ends.mean(axis=1) - moment.pose.place_m) @ moment.pose.axes[:, 2]
        order = np.lexsort((-depth, person))
        person, limb = person[order], limb[order]
        return rows[person], ends[order], shape.radius_m[person, limb], shape.colour[person, limb]

    def _faces(self, moment: Moment, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The faces of vehicles in the order to draw them.

        body (M,), corners (M, C, 3), colour (M, 3), and which are turned to the camera (M,).
        """
        bodies, sun = moment.bodies, self._world.to_sun
        parts = []
        for row in rows:
            faces = car_faces() if bodies.kind[row] == "car" else ugv_faces()
            corners, normal = place_faces(faces, bodies.place_m[row], float(bodies.facing_rad[row]))
            light = np.where(faces.lit, _SKYLIGHT + (1.05 - _SKYLIGHT) * np.maximum(normal @ sun, 0) / sun[2], 1)
            plate = bodies.plate[row]
            plate = COVERED_BGR if bodies.hidden[row] or np.isnan(plate).any() else plate
            colour = faces.colour + faces.paint[:, None] * bodies.colour[row] + faces.plate[:, None] * plate
            middle = corners.mean(axis=1)
            if bodies.kind[row] != "car":
                # Far faces first; the marker lies on top of all.
                order = np.lexsort(((middle - moment.pose.place_m) @ -moment.pose.axes[:, 2], faces.plate))
                corners, normal, middle = corners[order], normal[order], middle[order]
                colour, light = colour[order], light[order]
            seen = np.einsum("fk,fk->f", normal, moment.pose.place_m - middle) > 0
            parts.append((np.full(len(corners), row), corners, colour * light[:, None], seen))
        if not parts:
            return np.zeros(0, np.int64), np.zeros((0, 1, 3)), np.zeros((0, 3)), np.zeros(0, bool)
        most = max(part[1].shape[1] for part in parts)
        corners = np.concatenate([_filled(part[1], most) for part in parts])
        body, colour, seen = (np.concatenate([part[k] for part in parts]) for k in (0, 2, 3))
        return body, corners, colour, seen

    def _cast(self, points_m: np.ndarray, feet_up_m: np.ndarray) -> np.ndarray:
        """Where the shadows of points (N, 3) fall on the ground, (N, 3)."""
        sun = self._world.to_sun
        place, up = points_m[:, :2], feet_up_m
        for _ in range(2):
            # Where the ground rises it is met earlier: once more, from the height that was found.
            place = points_m[:, :2] - (np.maximum(points_m[:, 2] - up, 0) / max(sun[2], 0.1))[:, None] * sun[:2]
            up = self._world.up_m(place)
        return np.c_[place, up]


def _joined(some: Outlines, others: Outlines, rank: np.ndarray) -> Outlines:
    """All outlines, the bodies in the order of their rank."""
    most = max(some.points_px.shape[1], others.points_px.shape[1])
    body = np.concatenate([some.body, others.body])
    order = np.argsort(rank[body], kind="stable")
    points = np.concatenate([_filled(some.points_px, most), _filled(others.points_px, most)])
    colour, up = (np.concatenate([getattr(some, name), getattr(others, name)]) for name in ("colour", "up_m"))
    return Outlines(body[order], points[order], colour[order], up[order])


def _filled(outlines: np.ndarray, corners: int) -> np.ndarray:
    """Outlines (M, C, n) with the last corner repeated up to `corners`."""
    missing = corners - outlines.shape[1]
    return outlines if missing == 0 else np.concatenate([outlines, outlines[:, -1:].repeat(missing, axis=1)], axis=1)
