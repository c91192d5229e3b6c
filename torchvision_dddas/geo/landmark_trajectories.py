"""Where landmarks are in every frame, from reports that may be slow or drop out, and from the waypoints they plan.

Source: appendix A, IV-A: "a GPS dropout costs nothing", as the vehicles share the waypoints that they mean to pass.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from torchvision_dddas.config import LandmarkParameters
from torchvision_dddas.types import Adjustment, LandmarkObservations, Landmarks

# Reports further apart than this many times their usual distance have a dropout between them.
_SLACK = 1.5
# A landmark's velocity is fitted to the reports of this time.
_PACE_S = 5.0
# Hysteresis: landmarks count as well detected again below this share of poor_speed_m_s.
_CALM = 0.8
# Other landmarks replace those in use once they are spread better by this factor.
_BETTER = 1.25
# Of more landmarks than this, only this many that lie far apart are tried.
_TRIED = 12

_Place = tuple[np.ndarray, float]
"""East and north (2,), and its standard deviation in metres."""


@dataclass(frozen=True)
class _Track:
    """Places over time, sorted by frame (R,). values: (3, R) east, north and sigma in metres."""

    frame: np.ndarray
    values: np.ndarray

    def at(self, frame: float) -> _Place | None:
        """Linear between reports; None before the first and after the last."""
        if not len(self.frame) or not self.frame[0] <= frame <= self.frame[-1]:
            return None
        # The sigma is not less between two reports than at them: a receiver's error lasts for longer than that.
        east, north, sigma_m = (np.interp(frame, self.frame, row) for row in self.values)
        return np.array([east, north]), float(sigma_m)


class LandmarkTrajectories:
    """The places of landmarks over a clip; `at` gives those of one frame.

    Between reports a landmark goes straight on. A gap between them that is unusually long is a dropout: there it
    takes its planned waypoints, shifted by how far its reports lay from them; without a plan it goes straight from
    report to report in a gap of up to gap_s, or on as it went for gap_s, its sigma growing by drift_m_s. After that it
    is absent. A landmark's plan alone, without reports, suffices.
    """

    def __init__(self, landmarks: Landmarks, parameters: LandmarkParameters, rate_hz: float) -> None:
        """landmarks: their places in local metres. Raises ValueError for degrees."""
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
        # Longest usual gap; with two reports alone nothing is usual, and no gap up to gap_s is long.
        frames = [reports.frame for reports in self._reports]
        self._near = [_SLACK * float(np.median(np.diff(f))) if len(f) > 2 else self._longest for f in frames]
        seen = np.isfinite(landmarks.image_px).all(axis=1)
        self._seen_frame, self._seen_landmark = landmarks.frame[seen], landmarks.landmark[seen]
        self._seen_px = landmarks.image_px[seen]

    def at(self, frame: int) -> LandmarkObservations:
        """The landmarks of a frame whose places are known.

        Where the table says places in pictures, those that it has for this frame; else all, with image_px NaN.
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

    def speed_m_s(self, frame: int) -> np.ndarray:
        """(K,) how fast each landmark goes over the ground, over the second around a frame; NaN where unknown."""
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
        # A table that begins a little after the clip.
        if after == 0 and ahead <= min(near, longest):
            return self._straight_on(reports, 0, frame)
        return None

    def _planned(self, k: int, frame: float, past: float, ahead: float) -> _Place | None:
        """Along the plan, shifted by how far the reports before and after lay from it."""
        plan, reports = self._plans[k], self._reports[k]
        if (there := plan.at(frame)) is None:
            return None
        place, loose = there
        offsets, weights, sigmas = [], [], []
        # The nearer report counts for more, so that nothing jumps where a dropout ends.
        for distance, weight, at in ((past, ahead, frame - past), (ahead, past, frame + ahead)):
            if np.isfinite(distance) and (meant := plan.at(at)) and (report := reports.at(at)):
                offsets.append(report[0] - meant[0])
                weights.append(weight if np.isfinite(weight) else 1.0)
                sigmas.append(report[1])
        if not offsets:
            return place, loose
        place = place + np.average(offsets, axis=0, weights=weights)
        # How far it strays from its plan grows with time, up to how well it keeps to it at all.
        strayed = min(self._parameters.drift_m_s * min(past, ahead) / self._rate_hz, loose)
        return place, float(np.hypot(np.average(sigmas, weights=weights), strayed))

    def _straight_on(self, reports: _Track, last: int, frame: float) -> _Place:
        """From a report on with the velocity of those around it, before it or after the first."""
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
    """Which landmarks are in use, and whether more than `least` of them may be: their detection is poor."""

    landmark: tuple[int, ...] = ()
    poor: bool = False


def select_landmarks(
    frame: int, now: LandmarkUse, marks: LandmarkObservations, speed_m_s: np.ndarray, parameters: LandmarkParameters
) -> tuple[np.ndarray, LandmarkUse, tuple[Adjustment, ...]]:
    """The rows of `marks` to use, of those in view; what is in use from here on; and the record of a change of number.

    speed_m_s: (n,) over the ground, of the landmarks in marks' order; NaN where unknown.
    rule = all: every landmark in view. Our study finds six never worse than four; the source's finding of the contrary
    is one of its numerics. rule = source: more than `least` only where more are in view and their mean speed is above
    poor_speed_m_s, so that they are detected poorly (appendix A, section V); else those `least` that are best spread.
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
        # Those used already, unless others are spread clearly better.
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
    """(count,) rows of (n, 2) places, sorted, whose smallest triangle is the largest: no three are near one line."""
    # Of many, those far apart are tried: each the one furthest from those before it.
    most = min(max(count, _TRIED), len(places))
    tried = [int(np.linalg.norm(places - places.mean(axis=0), axis=1).argmax())]
    nearest = np.full(len(places), np.inf)
    while len(tried) < most:
        nearest = np.minimum(nearest, np.linalg.norm(places - places[tried[-1]], axis=1))
        nearest[tried] = -1.0  # where several are in one place, each is taken once
        tried.append(int(nearest.argmax()))
    if len(tried) > _TRIED:
        return np.sort(tried[:count])
    sets = np.array(list(combinations(sorted(tried), count)))
    smallest = np.full(len(sets), np.inf)
    for triple in combinations(range(count), 3):
        smallest = np.minimum(smallest, _area(places[sets[:, triple]]))
    # Where all lie on one line, those furthest apart.
    ties = np.flatnonzero(smallest >= smallest.max() * (1 - 1e-9))
    widths = np.ptp(places[sets[ties]], axis=1).sum(axis=1)
    return sets[ties[int(widths.argmax())]]


def spread_m2(places: np.ndarray) -> float:
    """The area of the smallest triangle among (n, 2) places; 0 for fewer than three."""
    triples = np.array(list(combinations(range(len(places)), 3)), int).reshape(-1, 3)
    return float(_area(places[triples]).min()) if len(triples) else 0.0


def _area(corners: np.ndarray) -> np.ndarray:
    """(T,) of triangles (T, 3, 2)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
