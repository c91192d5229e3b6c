"""How far what was located is from the truth, in metres: on the Earth, and relative to the team of landmarks."""

from typing import TYPE_CHECKING

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.metrics import metres
from torchvision_dddas.metrics.metres import Located
from torchvision_dddas.metrics.truth import Positions
from torchvision_dddas.studies.scored import Scored
from torchvision_dddas.targets import geodesy

if TYPE_CHECKING:
    from torchvision_dddas.datasets.record import Clip
    from torchvision_dddas.studies.record import Found

MarkPlaces = tuple[np.ndarray, np.ndarray, np.ndarray]


def score_places(clip: "Clip", found: "Found") -> Scored:
    """Score the places of a clip in frames that were looked at.

    A place is that of the target whose true box its box is; without boxes, that of the target nearest to it. Degrees
    are compared where both sides have them, for each may count its metres from an origin of its own. The error
    relative to the team is what is left without the mean error of the landmarks' own reports.
    Raises InputError where the truth has no places, or none of a frame that was looked at.
    """
    truth = clip.truth
    if truth is None or truth.positions is None:
        raise InputError(f"{clip.name} has no true places; nothing can be scored in metres")
    true_m, place_m, marks = _in_metres(clip, truth.positions, found)
    seen = np.isin(truth.positions.frame, found.looked)
    if not seen.any():
        raise InputError(f"{clip.name}: no frame that was looked at has a true place")
    rows = np.flatnonzero(np.isfinite(place_m).all(axis=1))
    frame, notes = found.frame[rows], []
    boxes = truth.tracks if truth.tracks is not None and np.isfinite(found.box_px[rows]).all() else None
    if boxes is not None and len(boxes.frame):
        key = dict(zip(zip(truth.positions.frame.tolist(), truth.positions.identity.tolist(), strict=True),
                       range(len(seen)), strict=True))  # fmt: skip
        labelled = [key.get(pair, -1) for pair in zip(boxes.frame.tolist(), boxes.identity.tolist(), strict=True)]
        row_of = np.append(np.array(labelled, np.int64), -1)
        whose = row_of[metres.by_boxes(frame, found.box_px[rows], boxes)]
        wanted = np.unique(row_of[row_of >= 0])  # what a picture shows; others nobody can locate
        wanted = wanted[seen[wanted]]
    else:
        whose = metres.by_places(frame, place_m[rows], truth.positions.frame, true_m)
        wanted = np.flatnonzero(seen)
        notes.append(f"{clip.name}: no boxes to tell targets by; the nearest within {metres.FARTHEST_M:g} m is taken")
    mine = rows[whose >= 0]
    off = place_m[mine] - true_m[whose[whose >= 0]]
    relative, ellipse = np.full_like(off, np.nan), np.full((len(mine), 2, 2), np.nan)
    if marks is not None:
        at, shift = metres.shared_error(*marks, truth.positions.frame, truth.positions.identity, true_m)
        if len(at):
            shared = [np.interp(found.frame[mine], at, shift[:, k]) for k in range(2)]
            relative = off - np.stack(shared, axis=1)
            ellipse = found.more.get("relative_m2", np.full((len(found.frame), 2, 2), np.nan))[mine]
    frames = np.unique(found.looked)
    each = {
        "targets": _per_frame(frames, truth.positions.frame[wanted]),
        "told": _per_frame(frames, found.frame[mine]),
        "strays": _per_frame(frames, frame[whose < 0]),
    }
    samples = {
        "frame": found.frame[mine],
        "identity": truth.positions.identity[whose[whose >= 0]],
        "error_m": np.hypot(*off.T),
        "inside": metres.inside(off, found.covariance_m2[mine]),
        "relative_error_m": np.hypot(*relative.T),
        "relative_inside": metres.inside(relative, ellipse),
        "east_m": off[:, 0],
        "north_m": off[:, 1],
    }
    counts = Located(len(wanted), len(mine), int((whose < 0).sum()))
    return Scored(frames, {"location": counts}, {"location": each}, {}, samples, tuple(notes))


def _per_frame(frames: np.ndarray, found: np.ndarray) -> np.ndarray:
    return np.bincount(np.searchsorted(frames, found), minlength=len(frames))[: len(frames)].astype(float)


def _in_metres(clip: "Clip", true: Positions, found: "Found") -> tuple[np.ndarray, np.ndarray, MarkPlaces | None]:
    """True places (P, 2), told ones (N, 2) and what landmarks report, all from one origin."""
    degrees = found.more.get("lonlat_deg")
    marks = _marks(clip)
    if true.lonlat_deg is not None and degrees is not None and len(true.lonlat_deg):
        origin = float(true.lonlat_deg[0, 0]), float(true.lonlat_deg[0, 1])
        if marks is not None:
            frame, mark, place, geographic = marks
            kept = (frame, mark, geodesy.east_north(place, origin)) if geographic else None
        else:
            kept = None
        return geodesy.east_north(true.lonlat_deg, origin), geodesy.east_north(degrees, origin), kept
    plain = None if marks is None or marks[3] else marks[:3]
    return true.east_north_m, found.east_north_m, plain


def _marks(clip: "Clip") -> tuple[np.ndarray, np.ndarray, np.ndarray, bool] | None:
    """What the clip's landmarks report: frames, which, (N, 2) where, and whether in degrees; None without any."""
    if clip.landmarks is None:
        return None
    from torchvision_dddas.sources.landmarks import read_landmarks

    table = read_landmarks(clip.landmarks, clip.rate_hz)
    kept = ~table.planned & np.isfinite(table.place).all(axis=1) & (table.frame == np.round(table.frame))
    return table.frame[kept], table.landmark[kept], table.place[kept], table.geographic
