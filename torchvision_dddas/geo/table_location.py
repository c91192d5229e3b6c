"""A table of boxes seen from the air to places on the ground."""

from collections.abc import Iterator

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.aerial_locator import Locator, Targets, chosen_rows
from torchvision_dddas.geo.plane import LEAST, width
from torchvision_dddas.types import AerialLocations, DetectionTable, Landmarks

OUTSIDE = 0.25
"""A landmark or a target may show so far beyond the picture's edge, as a share of the picture's side."""


def locate(table: DetectionTable, locator: Locator) -> Iterator[AerialLocations]:
    """Where the targets of a table stand, in each of its frames and in those between that show landmarks."""
    lasting = table.identity > 0 if table.identity is not None else np.zeros(len(table), bool)
    score = np.clip(table.score, 0, 1) if table.probable else np.ones(len(table))
    for frame in frames_of(table, locator.site.landmarks):
        rows = table.rows(frame)
        targets = Targets(
            table.box_px[rows],
            table.targets[rows],
            lasting[rows],
            score[rows],
            None if table.feet_px is None else table.feet_px[rows],
            table.ours,
        )
        yield locator.ground(locator.look(frame, locator.marks(frame)), targets)


def frames_of(table: DetectionTable, landmarks: Landmarks) -> list[int]:
    """The frames to locate: those of the table, and between its first and last those with landmarks in the picture."""
    seen = landmarks.frame[np.isfinite(landmarks.image_px).all(axis=1)]
    between = seen[(seen >= table.first) & (seen <= table.last)]
    return np.unique(np.concatenate([table.frame, np.round(between).astype(np.int64)])).tolist()


def check_table(table: DetectionTable, locator: Locator) -> None:
    """Raises InputError where the landmarks cannot place any frame of the table, and says what is missing.

    That is: no place in a picture, one far outside of it, no frame in common, and, without telemetry, fewer than four
    landmarks in every frame or all of them on one line.
    """
    site, parameters = locator.site, locator.settings.aerial
    path = site.landmarks.path
    seen = np.isfinite(site.landmarks.image_px).all(axis=1)
    helped = site.telemetry is not None and parameters.mode == "pose"
    if not seen.any():
        raise InputError(f"landmarks {path} say no places in pictures; wanted columns u_px,v_px beside the places")
    _check_pictured(locator)
    if not len(table):
        return
    frames = np.unique(table.frame).tolist()
    marks = [chosen_rows(m, np.isfinite(m.image_px).all(axis=1)) for m in map(locator.marks, frames)]
    counts = np.array([len(m) for m in marks])
    if not counts.any():
        first, last = np.round(site.landmarks.frame[seen][[0, -1]]).astype(int).tolist()
        raise InputError(
            f"the table has frames {table.first} to {table.last}, the landmarks are seen in {first} to {last}: none "
            "in common has a landmark of known place; are both counted from the clip's first frame, as 1?"
        )
    if helped:
        return
    if counts.max() < LEAST:
        best = int(counts.argmax())
        missing = LEAST - int(counts[best])
        raise InputError(
            f"locate needs {LEAST} landmarks not on one line; frame {frames[best]} has {counts[best]}, none more: "
            f"{missing} missing. Give --telemetry, or {missing} landmark{'s' * (missing > 1)} more"
        )
    enough = [k for k, count in enumerate(counts.tolist()) if count >= LEAST]
    if all(width(marks[k]) < parameters.least_spread for k in enough):
        raise InputError(
            f"the {counts[enough[0]]} landmarks of frame {frames[enough[0]]} lie on one line, as in all others; "
            "give --telemetry, or a landmark away from it"
        )


def outside(locator: Locator, pixels: np.ndarray) -> np.ndarray:
    """(N,) bool, which (N, 2) pixels lie beyond the picture's edges by more than OUTSIDE of its sides.

    None does where the size need not be known: a homography needs no camera.
    """
    if locator.settings.aerial.mode != "pose":
        return np.zeros(len(pixels), bool)
    size = np.array(locator.camera.size_px, float)
    beyond: np.ndarray = (pixels < -OUTSIDE * size) | (pixels > (1 + OUTSIDE) * size)
    return np.any(beyond, axis=1)


def _check_pictured(locator: Locator) -> None:
    landmarks = locator.site.landmarks
    away = outside(locator, landmarks.image_px)
    if away.any():
        k = int(np.where(away, landmarks.line, np.iinfo(np.int64).max).argmin())
        (u, v), (columns, rows) = landmarks.image_px[k].tolist(), locator.camera.size_px
        raise InputError(
            f"landmarks {landmarks.path}, line {landmarks.line[k]}: u_px,v_px are {u:g}, {v:g}, far outside the "
            f"camera's pictures of {columns} x {rows} px; give pixels, and the camera's file for this size"
        )
