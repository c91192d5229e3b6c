"""Simulated clips for the studies: their scenarios, and crowds located from the air and from the ground."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.control import StartedSource, fit_settings
from torchvision_dddas.control.rules import every_least
from torchvision_dddas.detection import detect_motion, pixels_per_metre
from torchvision_dddas.geo import (
    AerialLocator,
    GroundLocator,
    LandmarkWatch,
    Site,
    Targets,
    build_site,
    group_crowds,
    to_local,
)
from torchvision_dddas.geo.plane_homography import load_solver
from torchvision_dddas.geometry.projection import shift_origin
from torchvision_dddas.lab.evaluation.metrics.crowds import CrowdScorer, TrueFrame
from torchvision_dddas.lab.simulation import CarPlan, CrowdPlan, Scenario, SimulatorSource, scenario_settings
from torchvision_dddas.lab.simulation.cameras import view_from_pose
from torchvision_dddas.lab.simulation.sensors import SIGMAS_95, Receivers
from torchvision_dddas.people import PersonDetector
from torchvision_dddas.types import Command, FrameResult, Landmarks, Order, Scene, TrackedFrame, Tracks, Truth

Case = dict[str, Any]


# -- one clip, located in several ways ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Way:
    """A way to locate a clip. config: configuration of detection and location. parameters: changes to it.

    gps95_m: 95 % error of the landmarks' receivers, added to the reports. used: rows of the landmarks whose reports are
    used; empty for all.
    """

    gps95_m: float
    config: str | None = None
    parameters: Mapping[str, object] = field(default_factory=dict)
    used: tuple[int, ...] = ()


def usual(
    source: SimulatorSource, config: str | None = None, parameters: Mapping[str, object] | None = None
) -> Settings:
    """Return the settings of `dddas run sim: --config CONFIG` with some changes."""
    settings = fit_settings(load_config(config, (), base=scenario_settings(source.scenario, config)), source)
    return with_parameters(settings, parameters or {})


class ClipLocator:
    """Locates the scenes of a clip and scores the places. Targets are those of single frames, without tracks."""

    def __init__(self, source: SimulatorSource, way: Way) -> None:
        self._source, self._way, self._gps95_m = source, way, way.gps95_m
        self._settings = usual(source, way.config, way.parameters)
        self._error_m = receiver_errors(source.scenario, way.gps95_m, len(source.names), source.count or 0)
        self._local = partial(geometry.east_north, origin_deg=source.scenario.world.origin_deg)
        self._watch: LandmarkWatch | None = None

    def scorer(self) -> CrowdScorer:
        """Return a new scorer in the truth's local metres."""
        return CrowdScorer(self._local)

    def locate(self, scene: Scene, scorers: Sequence[CrowdScorer], truth: Truth) -> float:
        """Locate the targets of the next scene. The scorers already have the truth of its frame.

        Return the error of the picture's map to the ground, metres: the mean distance of the crowds' middles from the
        projections of their pixels, or NaN if unknown.
        """
        site = self._site()
        if self._watch is None:
            locator = AerialLocator.from_site(
                site, self._source.camera, self._settings, load_solver("onboard"), self._source.rate_hz,
                focal_known=True,
            )  # fmt: skip
            self._watch = LandmarkWatch(locator, self._source.colours)
        else:
            self._watch.locator.set_site(site)
        locator = self._watch.locator
        watched = group_crowds(self._watch.update(scene), locator, self._source.rate_hz)
        found = watched.scene.detections
        rows = np.arange(len(found))
        targets = Targets(
            found.box_px, rows + 1, np.zeros(len(found), bool), found.score.clip(0, 1), bodies=True,
            middle_px=found.middle_px if self._settings.crowds.join_m else None,
        )  # fmt: skip
        located = locator.locate_targets(watched.fixed, targets)
        tracks = Tracks(scene.frame.number, rows + 1, found.box_px, found.score, rows)
        tracked = TrackedFrame(scene.frame.number, scene.frame, found, tracks)
        for scorer in scorers:
            scorer.feed(FrameResult(tracked, located, watched.sighted_by))
        return self._picture_error(truth, locator, watched.fixed.fix)

    def _picture_error(self, truth: Truth, locator: AerialLocator, fix: Any) -> float:
        bodies = truth.bodies
        crowds = [bodies.target == number for number in np.unique(bodies.target[bodies.kind == "person"])]
        middle = np.array([bodies.place_m[rows].mean(axis=0) for rows in crowds])
        pixel = view_from_pose(truth.pose, self._source.camera).project(middle)
        inside = ((pixel >= 0) & (pixel <= np.array(self._source.size) - 1)).all(axis=1)
        if not fix.by or not inside.any():
            return math.nan
        places = geometry.lonlat(locator.ground_places(fix, pixel[inside]), locator.site.origin_deg)
        return float(np.linalg.norm(self._local(places) - middle[inside, :2], axis=1).mean())

    def _site(self) -> Site:
        """Return the site by the reports until now, in local metres of the first report, with the elevation."""
        reports, telemetry = self._reports(), self._source.telemetry()
        if self._watch is None:
            site = build_site(reports, telemetry)
            elevation = shift_origin(self._source.elevation, self._local(np.array([site.origin_deg]))[0])
            return replace(site, elevation=elevation, sun_rad=self._source.sun_rad)
        site = self._watch.locator.site
        local = to_local(reports, site.origin_deg), to_local(telemetry, site.origin_deg)
        return replace(site, landmarks=local[0], telemetry=local[1])

    def _reports(self) -> Landmarks:
        """Return the landmarks' reports with the receivers' errors, without planned waypoints."""
        table = self._source.landmarks()
        kept = ~table.planned
        if self._way.used:
            kept &= np.isin(table.landmark, self._way.used)
        frame, which, place, sigma = table.frame[kept], table.landmark[kept], table.place[kept], table.sigma_m[kept]
        if self._gps95_m:
            metres = self._local(place) + self._error_m[np.round(frame).astype(int) - 1, which]
            place = geometry.lonlat(metres, self._source.scenario.world.origin_deg)
            sigma = np.hypot(np.nan_to_num(sigma), self._gps95_m / SIGMAS_95)
        return Landmarks(
            table.names, frame, which, table.image_px[kept], place, sigma, table.planned[kept], table.line[kept], True,
            table.path,
        )  # fmt: skip


def receiver_errors(scenario: Scenario, gps95_m: float, count: int, frames: int) -> np.ndarray:
    """Return errors (F, K, 2) in metres in each frame. Ways differ only in the size of the errors."""
    gps, errors = scenario.gps, []
    receivers = Receivers(
        count, gps95_m, gps.white_share, gps.correlation_s, 0.0, np.random.default_rng([scenario.seed, 77])
    )
    for _ in range(frames):
        errors.append(receivers.error_m)
        receivers.advance(1 / scenario.clip.rate_hz)
    return np.array(errors).reshape(frames, count, 2)


def locate_clip(scenario: Scenario, ways: Mapping[str, Way]) -> Case:
    """Return the scores of each way. Ways with the same configuration share their detections.

    seconds: for each second of the clip, the number of located targets, their mean error and the picture's error, m.
    """
    found: Case = {}
    for config in dict.fromkeys(way.config for way in ways.values()):
        found |= _locate_clip(scenario, config, {name: way for name, way in ways.items() if way.config == config})
    return {name: found[name] for name in ways}


def _locate_clip(scenario: Scenario, config: str | None, ways: Mapping[str, Way]) -> Case:
    source = SimulatorSource(scenario)
    locators = {name: ClipLocator(source, way) for name, way in ways.items()}
    scorers, errors = {name: one.scorer() for name, one in locators.items()}, {name: [] for name in locators}
    by_second: dict[str, dict[int, tuple[CrowdScorer, list[float]]]] = {name: {} for name in locators}
    truths, settings, started = {}, usual(source, config), StartedSource(source)
    if settings.steering.sampling:  # skip as many frames as the closed loop does before its first detection
        scale = pixels_per_metre(scenario.uav.altitude_m, source.camera.focal_px[0])
        least = every_least(scale, source.rate_hz, settings.steering)
        source.steer(Command(every=int(np.clip(round(least), 1, settings.steering.maximum_every))))
    for scene in detect_motion(started, settings, "onboard"):
        truths |= {truth.frame: truth for truth in source.truths()}
        truth = truths.pop(scene.frame.number, None)
        if truth is None:
            continue
        true = TrueFrame(truth)
        for name, one in locators.items():
            now = by_second[name].setdefault(int(truth.time_s), (one.scorer(), []))
            for scorer in (scorers[name], now[0]):
                scorer.feed(true)
            error = one.locate(scene, (scorers[name], now[0]), truth)
            errors[name].append(error)
            now[1].append(error)
    return {
        name: scorer.score().by_name()
        | {"picture_m": _mean(errors[name]), "seconds": [_second(*now) for now in by_second[name].values()]}
        for name, scorer in scorers.items()
    }


def _second(scorer: CrowdScorer, picture_m: list[float]) -> tuple[int, float, float]:
    error = scorer.score().target_error_m
    return error.count, error.mean, _mean(picture_m)


def _mean(values: list[float]) -> float:
    """Return the mean of the finite values, or NaN without any."""
    known = np.array(values)[np.isfinite(values)]
    return float(known.mean()) if len(known) else math.nan


# -- from the ground -------------------------------------------------------------------------------------------------

LOOK_S = 0.5
"""Time between two pictures of a vehicle."""
BESIDE_M = 3.0
"""People located further outside of every crowd count as elsewhere."""
GROUND_WAYS: dict[str, tuple[bool, Case]] = {
    "each vehicle alone, as printed": (False, {"ground.mode": "paper"}),
    "each vehicle alone": (False, {}),
    "all vehicles fused": (True, {}),
}
"""Whether sightings of all vehicles are fused, and the settings."""


def locate_from_ground(scenario: Scenario) -> Case:
    """Return errors of crowds located by the people that ground vehicles see, for each way, without aerial pictures.

    Each vehicle drives as planned and turns its camera to the middle of the nearest crowd. A crowd's place is the mean
    of the people located within its radius plus BESIDE_M.
    """
    source, settings = SimulatorSource(scenario), load_config(None, (), base=scenario_settings(scenario))
    detector, local = (
        PersonDetector(settings, backend="onboard"),
        partial(geometry.east_north, origin_deg=source.origin_deg),
    )
    found: dict[str, list[float]] = {name: [] for name in GROUND_WAYS}
    counts, every = Counter[str](), round(LOOK_S * source.rate_hz)
    for _ in source:
        (truth,) = source.truths()
        bodies = truth.bodies
        person = bodies.kind == "person"
        crowds = [bodies.place_m[person & (bodies.target == n), :2] for n in np.unique(bodies.target[person])]
        middle = np.array([one.mean(axis=0) for one in crowds])
        radius = np.array([np.linalg.norm(one - m, axis=1).max() for one, m in zip(crowds, middle, strict=True)])
        pictures = source.pictures()
        people = detector([picture.image for picture in pictures]) if pictures else []
        counts.update(pictures=len(pictures), people=sum(map(len, people)))
        for name, (fused, parameters) in GROUND_WAYS.items():
            chosen = with_parameters(settings, parameters)
            groups = (
                [slice(0, len(pictures))] if fused and pictures else [slice(k, k + 1) for k in range(len(pictures))]
            )
            for group in groups:
                cameras = [picture.camera for picture in pictures[group]]
                located = GroundLocator(cameras, settings=chosen).locate(people[group], frame=truth.frame).positions
                place = local(located.lonlat_deg) if len(located) else np.zeros((0, 2))
                apart = np.linalg.norm(place[:, None] - middle, axis=2)
                nearest = apart.argmin(axis=1)
                inside = apart[np.arange(len(place)), nearest] <= radius[nearest] + BESIDE_M
                counts.update({f"{name}: located": len(place), f"{name}: elsewhere": int((~inside).sum())})
                for n in np.unique(nearest[inside]):
                    off = place[inside & (nearest == n)].mean(axis=0) - middle[n]
                    found[name].append(float(np.linalg.norm(off)))
        vehicles = bodies.place_m[bodies.kind == "ugv", :2]
        aims = middle[np.linalg.norm(vehicles[:, None] - middle, axis=2).argmin(axis=1)]
        aims = geometry.lonlat(aims, source.origin_deg)
        unchanged = np.full(2, np.nan)
        orders = [Order(name, unchanged, 0.0, aim, True) for name, aim in zip(source.names, aims, strict=True)]
        source.steer(Command(every=every, orders=tuple(orders)))
    return {
        name: {
            "crowd_m": _mean(errors),
            "crowds": len(errors),
            "elsewhere": counts[f"{name}: elsewhere"] / max(counts[f"{name}: located"], 1),
            "people_a_picture": counts["people"] / max(counts["pictures"], 1),
        }
        for name, errors in found.items()
    }


def walking(seed: int, seconds: float, rate_hz: float = 10.0, **tables: dict[str, object]) -> Scenario:
    """Return a scenario of a team and two crowds that walk side by side or past each other through the team's ring.

    tables: further parameters by table, such as `uav={"altitude_m": 200.0}`.
    """
    rng = np.random.default_rng([seed, 5])
    crowds = []
    heading, turn = rng.uniform(0, 360), rng.choice([0.0, 180.0])
    for k, people in enumerate(rng.integers(6, 13, 2).tolist()):
        ahead = np.radians(heading + k * turn + rng.uniform(-10, 10))
        speed = rng.uniform(0.7, 1.4)
        # Let crowds pass each other at a distance, because the study does not test identities in mixed crowds.
        aside = (-1 if k == 0 else 1) * rng.uniform(5, 7) * (1 if turn == 0 or k == 0 else -1)
        way = np.array([np.sin(ahead), np.cos(ahead)])
        # The crowds reach the middle of the ring halfway through the run.
        start = -way * speed * min(seconds / 2, 12) + aside * way[::-1] * (1, -1)
        crowds.append(
            CrowdPlan(
                people=people,
                start_m=(float(start[0]), float(start[1])),
                radius_m=float(rng.uniform(1.5, 2.5)),
                speed_m_s=float(speed),
                way_m=(tuple((start + way * 24).tolist()),),
            )
        )
    car = CarPlan(start_m=(-60.0, float(rng.uniform(18, 22))), heading_deg=90.0, speed_m_s=5.0)
    usual_tables: dict[str, dict[str, object]] = {"clip": {"seconds": seconds, "rate_hz": rate_hz}}
    for name, parameters in tables.items():
        usual_tables[name] = {**usual_tables.get(name, {}), **parameters}
    return Scenario.model_validate({"seed": seed, "crowd": tuple(crowds), "car": (car,), **usual_tables})
