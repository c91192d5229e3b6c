"""How far what was located is from the truth, in metres: on the Earth, and relative to the team of landmarks."""

from typing import TYPE_CHECKING

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics import metres
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.evaluation.metrics.metres import GroundLocations
from torchvision_dddas.evaluation.metrics.truth import Positions, Truth
from torchvision_dddas.evaluation.studies.scored import Scored

if TYPE_CHECKING:
    from torchvision_dddas.evaluation.datasets.record import Clip
    from torchvision_dddas.evaluation.studies.record import Found

_NOBODY, _NOT_ASKED = -1, -2
"""In place of a row: a place that is nobody's; one of a target that does not count."""


def score_places(clip: "Clip", found: "Found") -> Scored:
    """Score the places of a clip in frames that were looked at.

    A place is that of the target whose true box its box is; without boxes, that of the target nearest to it. Degrees
    are compared where both sides have them, for each may count its metres from an origin of its own. The error
    relative to the team is what is left without the mean error of the landmarks' own reports, where the truth knows
    where they were.
    Raises InputError where the truth has no places, or none of a frame that was looked at.
    """
    truth = clip.truth
    if truth is None or truth.positions is None:
        raise InputError(f"{clip.name} has no true places; nothing can be scored in metres")
    origin = _origin(truth.positions, found)
    true_m = _in_metres(truth.positions, origin)
    place_m = found.east_north_m if origin is None else geometry.east_north(found.more["lonlat_deg"], origin)
    seen = np.isin(truth.positions.frame, found.looked)
    if not seen.any():
        raise InputError(f"{clip.name}: no frame that was looked at has a true place")
    rows = np.flatnonzero(np.isfinite(place_m).all(axis=1))
    frame, box_px, notes = found.frame[rows], found.box_px[rows], []
    whose, shown = whose_places(truth, truth.positions, true_m, frame, box_px, place_m[rows])
    if shown is None:
        wanted = np.flatnonzero(seen)
        notes.append(f"{clip.name}: no boxes to tell targets by; the nearest within {metres.FARTHEST_M:g} m is taken")
    else:
        wanted = shown[seen[shown]]  # what a picture shows; others nobody can locate
    mine, true_row = rows[whose >= 0], whose[whose >= 0]
    off = place_m[mine] - true_m[true_row]
    relative, ellipse = np.full_like(off, np.nan), np.full((len(mine), 2, 2), np.nan)
    at, shift = _shared(clip, truth.fleet, origin)
    if len(at):
        relative = off - np.stack([np.interp(found.frame[mine], at, shift[:, k]) for k in range(2)], axis=1)
        ellipse = found.more.get("relative_m2", np.full((len(found.frame), 2, 2), np.nan))[mine]
    frames = np.unique(found.looked)
    each = {
        "targets": _per_frame(frames, truth.positions.frame[wanted]),
        "told": _per_frame(frames, found.frame[mine]),
        "strays": _per_frame(frames, frame[whose == _NOBODY]),
    }
    samples = {
        "frame": found.frame[mine],
        "identity": truth.positions.identity[true_row],
        "error_m": np.hypot(*off.T),
        "inside": metres.inside(off, found.covariance_m2[mine]),
        "relative_error_m": np.hypot(*relative.T),
        "relative_inside": metres.inside(relative, ellipse),
        "east_m": off[:, 0],
        "north_m": off[:, 1],
    }
    counts = GroundLocations(len(wanted), len(mine), int((whose == _NOBODY).sum()))
    return Scored(frames, {"location": counts}, {"location": each}, {}, samples, tuple(notes))


def whose_places(
    truth: Truth, places: Positions, true_m: np.ndarray, frame: np.ndarray, box_px: np.ndarray, place_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """(N,) the row of the true place of each located box, below 0 for none; and the rows whose boxes count.

    The latter None where the truth has no boxes, and the nearest places are taken. true_m: of all places, (P, 2), in
    the metres of place_m, (N, 2).
    """
    if truth.tracks is not None and len(truth.tracks.frame) and np.isfinite(box_px).all():
        return _by_boxes(truth, truth.tracks, places, frame, box_px)
    return metres.by_places(frame, place_m, places.frame, true_m), None


def _per_frame(frames: np.ndarray, found: np.ndarray) -> np.ndarray:
    return np.bincount(np.searchsorted(frames, found), minlength=len(frames))[: len(frames)].astype(float)


def _by_boxes(
    truth: Truth, boxes: TrackTable, places: Positions, frame: np.ndarray, box_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) the row of the true place of each found box; and the rows of all places whose boxes count, in order."""
    row = {key: i for i, key in enumerate(zip(places.frame.tolist(), places.identity.tolist(), strict=True))}
    row_of = [row.get(key, _NOBODY) for key in zip(boxes.frame.tolist(), boxes.identity.tolist(), strict=True)]
    labelled, ignored = boxes, truth.ignored
    if ignored is not None:
        labelled = TrackTable(*(np.concatenate(pair) for pair in zip(boxes, ignored, strict=True)))
        row_of += [_NOT_ASKED] * len(ignored.frame)
    rows = np.array([*row_of, _NOBODY], np.int64)  # the last is for boxes that are none of them: -1
    return rows[metres.by_boxes(frame, box_px, labelled)], np.unique(rows[rows >= 0])


def _origin(true: Positions, found: "Found") -> tuple[float, float] | None:
    """Longitude and latitude from which metres are counted; None where both sides' own metres are compared."""
    if true.lonlat_deg is None or "lonlat_deg" not in found.more or not len(true.lonlat_deg):
        return None
    return float(true.lonlat_deg[0, 0]), float(true.lonlat_deg[0, 1])


def _in_metres(true: Positions, origin: tuple[float, float] | None) -> np.ndarray:
    if origin is None or true.lonlat_deg is None:
        return true.east_north_m
    return geometry.east_north(true.lonlat_deg, origin)


def _shared(clip: "Clip", fleet: Positions | None, origin: tuple[float, float] | None) -> tuple[np.ndarray, np.ndarray]:
    """Frames, and how far the landmarks' reports are off in them together; none where it cannot be known."""
    marks = None if fleet is None else _marks(clip)
    if marks is None or fleet is None or marks[3] != (origin is not None):
        return np.zeros(0), np.zeros((0, 2))
    frame, mark, place, _ = marks
    reported = place if origin is None else geometry.east_north(place, origin)
    return metres.shared_error(frame, mark, reported, fleet.frame, fleet.identity, _in_metres(fleet, origin))


def _marks(clip: "Clip") -> tuple[np.ndarray, np.ndarray, np.ndarray, bool] | None:
    """What the clip's landmarks report: frames, which, (N, 2) where, and whether in degrees; None without any."""
    if clip.landmarks is None:
        return None
    from torchvision_dddas.io.ground_tables import read_landmarks

    table = read_landmarks(clip.landmarks, clip.rate_hz)
    kept = ~table.planned & np.isfinite(table.place).all(axis=1) & (table.frame == np.round(table.frame))
    return table.frame[kept], table.landmark[kept], table.place[kept], table.geographic
