"""Places of landmarks in every frame, from reports that may be slow or drop out, and from planned waypoints.

Source: appendix A, IV-A: "a GPS dropout costs nothing", because the vehicles share the waypoints of their plan.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from torchvision_dddas.config import LandmarkParameters
from torchvision_dddas.types import Adjustment, LandmarkObservations, Landmarks

# A dropout lies between reports that are further apart than this many times their usual distance.
_SLACK = 1.5
# A landmark's velocity is fitted to the reports of this time span.
_PACE_S = 5.0
# Hysteresis: landmarks count as well detected again below this share of poor_speed_m_s.
_CALM = 0.8
# Other landmarks replace those in use if their spread is better by this factor.
_BETTER = 1.25
# If there are more landmarks than this, only this many, far apart, are tried.
_TRIED = 12

_Place = tuple[np.ndarray, float]
"""East and north (2,), and their standard deviation in metres."""


@dataclass(frozen=True)
class _Track:
    """Places over time, sorted by frame (R,). values: (3, R) east, north and sigma in metres."""

    frame: np.ndarray
    values: np.ndarray

    def at(self, frame: float) -> _Place | None:
        """Interpolate linearly between reports; None before the first and after the last."""
        if not len(self.frame) or not self.frame[0] <= frame <= self.frame[-1]:
            return None
        # The sigma is not smaller between two reports, because a receiver's error lasts longer than that interval.
        east, north, sigma_m = (np.interp(frame, self.frame, row) for row in self.values)
        return np.array([east, north]), float(sigma_m)


class LandmarkTrajectories:
    """The places of landmarks over a clip; `at` returns the landmarks of one frame.

    Between reports a landmark goes straight on. An unusually long gap is a dropout. In a dropout the landmark follows
    its planned waypoints, shifted by the distance of its reports from them. Without a plan it goes straight from report
    to report if the gap is at most gap_s; otherwise it continues for gap_s, with a sigma that grows by drift_m_s, and
    is absent after that. A plan without any report suffices.
    """

    def __init__(self, landmarks: Landmarks, parameters: LandmarkParameters, rate_hz: float) -> None:
        """landmarks: places in local metres. Raise ValueError for degrees."""
        if landmarks.geographic:
            raise ValueError("these landmarks are in degrees; wanted local metres")
        self._count, self._parameters, self._rate_hz = len(landmarks.names), parameters, rate_hz
        self._longest = parameters.gap_s * rate_hz
        known = np.isfinite(landmarks.place).all(axis=1)
        sigma = np.where(np.isfinite(landmarks.sigma_m), landmarks.sigma_m, parameters.sigma_m)

        def track(landmark: int, planned: bool) -> _Track:
            rows = known & (landmarks.landmark == landmark) & (landmarks.planned == planned)
            return _Track(landmarks.frame[rows], np.stack([*landmarks.place[rows].T, sigma[rows]]))

        self._reports = [track(k, False) for k in range(self._count)]
        self._plans = [track(k, True) for k in range(self._count)]
        # Longest usual gap. Two reports define no usual distance, so gaps up to gap_s are then usual.
        frames = [reports.frame for reports in self._reports]
        self._near = [_SLACK * float(np.median(np.diff(f))) if len(f) > 2 else self._longest for f in frames]
        rows = [(landmarks.landmark == k) & np.isfinite(landmarks.elevation_m) for k in range(self._count)]
        self._elevations = [(landmarks.frame[of], landmarks.elevation_m[of]) for of in rows]
        seen = np.isfinite(landmarks.image_px).all(axis=1)
        self._seen_frame, self._seen_landmark = landmarks.frame[seen], landmarks.landmark[seen]
        self._seen_px = landmarks.image_px[seen]

    def at(self, frame: int) -> LandmarkObservations:
        """Return the landmarks of a frame whose places are known.

        If the table gives pixels, return the landmarks with a pixel in this frame; otherwise all, with image_px NaN.
        """
        if len(self._seen_frame):
            rows = slice(*np.searchsorted(self._seen_frame, [frame - 0.5, frame + 0.5]))
            landmark, image = self._seen_landmark[rows], self._seen_px[rows]
        else:
            landmark, image = np.arange(self._count), np.full((self._count, 2), np.nan)
        places = [self._place(k, float(frame)) for k in landmark.tolist()]
        kept = np.array([place is not None for place in places], bool)
        known = [place for place in places if place is not None]
        return LandmarkObservations(
            landmark[kept].astype(np.int64),
            image[kept],
            np.array([place for place, _ in known], float).reshape(-1, 2),
            np.array([sigma for _, sigma in known], float),
            np.full(len(known), self._parameters.pixel_sigma),
            np.full(len(known), self._parameters.height_m),
        )

    def elevation_m(self, frame: int) -> np.ndarray:
        """Return the (K,) height above the sea of the ground at each landmark, NaN without a report."""
        known = [np.interp(frame, *reports) if len(reports[0]) else np.nan for reports in self._elevations]
        return np.array(known, float)

    def speed_m_s(self, frame: int) -> np.ndarray:
        """Return the (K,) speed of each landmark over the second around a frame; NaN if unknown."""
        half = self._rate_hz / 2
        speeds = np.full(self._count, np.nan)
        for k in range(self._count):
            ends = [(at, place[0]) for at in (frame - half, frame, frame + half) if (place := self._place(k, at))]
            if len(ends) > 1:
                (before, a), (after, b) = ends[0], ends[-1]
                speeds[k] = np.linalg.norm(b - a) / (after - before) * self._rate_hz
        return speeds

    def _place(self, k: int, frame: float) -> _Place | None:
        reports, near, longest = self._reports[k], self._near[k], self._longest
        after = int(np.searchsorted(reports.frame, frame))
        past = frame - reports.frame[after - 1] if after > 0 else np.inf
        ahead = reports.frame[after] - frame if after < len(reports.frame) else np.inf
        if ahead == 0 or past + ahead <= near:
            return reports.at(frame)
        if planned := self._planned(k, frame, past, ahead):
            return planned
        if past + ahead <= longest and (chord := reports.at(frame)):
            return chord[0], self._grown(chord[1], min(past, ahead))
        if past <= longest:
            return self._straight_on(reports, after - 1, frame)
        # The table begins shortly after the clip.
        if after == 0 and ahead <= min(near, longest):
            return self._straight_on(reports, 0, frame)
        return None

    def _planned(self, k: int, frame: float, past: float, ahead: float) -> _Place | None:
        """Return the place on the plan, shifted by the distance of the reports before and after from the plan."""
        plan, reports = self._plans[k], self._reports[k]
        if (there := plan.at(frame)) is None:
            return None
        place, loose = there
        offsets, weights, sigmas = [], [], []
        # The nearer report gets more weight, so that the place does not jump at the end of a dropout.
        for distance, weight, at in ((past, ahead, frame - past), (ahead, past, frame + ahead)):
            if np.isfinite(distance) and (meant := plan.at(at)) and (report := reports.at(at)):
                offsets.append(report[0] - meant[0])
                weights.append(weight if np.isfinite(weight) else 1.0)
                sigmas.append(report[1])
        if not offsets:
            return place, loose
        place = place + np.average(offsets, axis=0, weights=weights)
        # The deviation from the plan grows with time, up to the stated accuracy of the plan.
        strayed = min(self._parameters.drift_m_s * min(past, ahead) / self._rate_hz, loose)
        return place, float(np.hypot(np.average(sigmas, weights=weights), strayed))

    def _straight_on(self, reports: _Track, last: int, frame: float) -> _Place:
        """Extrapolate from a report with the velocity of the reports up to it, or after it if it is the first."""
        usual = _SLACK * float(np.median(np.diff(reports.frame))) if len(reports.frame) > 1 else 0
        gone = frame - reports.frame[last]
        away = (reports.frame[last] - reports.frame) * (1 if gone >= 0 else -1)
        rows = (away >= 0) & (away <= max(_PACE_S * self._rate_hz, usual))
        velocity = np.zeros(2)
        if rows.sum() > 1:
            velocity = np.polyfit(reports.frame[rows] - reports.frame[last], reports.values[:2, rows].T, 1)[0]
        east_north, sigma_m = reports.values[:2, last], float(reports.values[2, last])
        return east_north + velocity * gone, self._grown(sigma_m, abs(gone))

    def _grown(self, sigma_m: float, frames: float) -> float:
        return float(np.hypot(sigma_m, self._parameters.drift_m_s * frames / self._rate_hz))


@dataclass(frozen=True)
class LandmarkUse:
    """The landmarks in use, and whether more than `least` may be used because their detection is poor."""

    landmark: tuple[int, ...] = ()
    poor: bool = False


def select_landmarks(
    frame: int, now: LandmarkUse, marks: LandmarkObservations, speed_m_s: np.ndarray, parameters: LandmarkParameters
) -> tuple[np.ndarray, LandmarkUse, tuple[Adjustment, ...]]:
    """Return the rows of `marks` to use, the new state of use, and a record if the number of landmarks changes.

    speed_m_s: (n,) speed over the ground of each landmark; NaN if unknown.
    rule = all: use every landmark in view. In our study six were never worse than four; the source's contrary finding
    comes from its numerics. rule = source: use more than `least` only if more are in view and their mean speed exceeds
    poor_speed_m_s, which means poor detection (appendix A, section V); otherwise the `least` with the best spread.
    """
    view = np.flatnonzero(np.isfinite(marks.image_px).all(axis=1) & np.isfinite(marks.east_north_m).all(axis=1))
    if parameters.rule == "all":
        return view, LandmarkUse(tuple(marks.landmark[view].tolist())), ()
    least, limit, low = parameters.least, parameters.poor_speed_m_s, _CALM * parameters.poor_speed_m_s
    known = np.asarray(speed_m_s, float)[view]
    speed = float(np.mean(known[np.isfinite(known)])) if np.isfinite(known).any() else np.nan
    poor, cause = now.poor, ""
    if poor and speed < low:
        poor, cause = False, f"below {low:.2g}: they are detected well"
    elif not poor and speed > limit and len(view) > least:
        poor, cause = True, f"above {limit:g}: they are detected poorly"
    rows = view
    if not poor and len(view) > least:
        # Keep the landmarks in use, unless others are clearly better spread.
        places = marks.east_north_m[view]
        best = best_spread(places, least)
        held = np.flatnonzero(np.isin(marks.landmark[view], now.landmark))
        keep = len(held) == least and spread_m2(places[best]) <= _BETTER * spread_m2(places[held])
        rows = view[held if keep else best]
    use = LandmarkUse(tuple(marks.landmark[rows].tolist()), poor)
    if not cause or len(rows) == len(now.landmark):
        return rows, use, ()
    why = f"{len(view)} landmarks in view go at {speed:.1f} m/s on average, {cause}"
    return rows, use, (Adjustment(frame, "landmarks.used", len(now.landmark) or least, len(rows), why),)


def best_spread(places: np.ndarray, count: int) -> np.ndarray:
    """Return (count,) sorted rows of (n, 2) places whose smallest triangle is largest: no three are near one line."""
    # Of many places, try those far apart: each is the furthest from those chosen before it.
    most = min(max(count, _TRIED), len(places))
    tried = [int(np.linalg.norm(places - places.mean(axis=0), axis=1).argmax())]
    nearest = np.full(len(places), np.inf)
    while len(tried) < most:
        nearest = np.minimum(nearest, np.linalg.norm(places - places[tried[-1]], axis=1))
        nearest[tried] = -1.0  # places that coincide are each taken once
        tried.append(int(nearest.argmax()))
    if len(tried) > _TRIED:
        return np.sort(tried[:count])
    sets = np.array(list(combinations(sorted(tried), count)))
    smallest = np.full(len(sets), np.inf)
    for triple in combinations(range(count), 3):
        smallest = np.minimum(smallest, _area(places[sets[:, triple]]))
    # If all lie on one line, choose the places furthest apart.
    ties = np.flatnonzero(smallest >= smallest.max() * (1 - 1e-9))
    widths = np.ptp(places[sets[ties]], axis=1).sum(axis=1)
    return sets[ties[int(widths.argmax())]]


def spread_m2(places: np.ndarray) -> float:
    """Return the area of the smallest triangle among (n, 2) places; 0 for fewer than three."""
    triples = np.array(list(combinations(range(len(places)), 3)), int).reshape(-1, 3)
    return float(_area(places[triples]).min()) if len(triples) else 0.0


def _area(corners: np.ndarray) -> np.ndarray:
    """Return the (T,) areas of triangles (T, 3, 2)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
