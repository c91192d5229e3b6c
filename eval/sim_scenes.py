"""One simulated clip, drawn and searched for what moves once, and located in several ways: what the studies share."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.control import StartedSource, fit_settings
from torchvision_dddas.control.rules import every_least
from torchvision_dddas.detection import detect_motion, pixels_per_metre
from torchvision_dddas.evaluation.metrics.crowd_frames import shown
from torchvision_dddas.evaluation.metrics.crowds import CrowdScorer
from torchvision_dddas.geo import AerialLocator, LandmarkWatch, Site, Targets, build_site, group_crowds, to_local
from torchvision_dddas.geo.colours import load_colours
from torchvision_dddas.geo.plane_solvers import load_solver
from torchvision_dddas.geo.terrain import shift_origin
from torchvision_dddas.simulation import CarPlan, CrowdPlan, Scenario, SimulatorSource, scenario_settings
from torchvision_dddas.simulation.drawing import view_from_pose
from torchvision_dddas.simulation.sensor_errors import SIGMAS_95, Receivers
from torchvision_dddas.types import (
    Colours,
    Command,
    Elevation,
    Fix,
    Frame,
    FrameResult,
    Landmarks,
    Scene,
    TrackedFrame,
    Tracks,
    Truth,
)

CONFIG = "patrol"
"""The shipped configuration of a team that watches crowds."""


@dataclass(frozen=True)
class Way:
    """A way to locate the same pictures. landmarks: which of the team's, by row; empty: all.

    gps95_m: error of their receivers that is added to the reports, in 95 %; 0: none. settings: parameters beside the
    usual.
    """

    name: str
    landmarks: tuple[int, ...] = ()
    gps95_m: float = 0.0
    settings: dict[str, object] = field(default_factory=dict)


def usual(source: SimulatorSource, more: dict[str, object] | None = None) -> Settings:
    """What `dddas run sim:` takes, and more."""
    return with_parameters(
        fit_settings(load_config(CONFIG, (), scenario_settings(source.scenario)), source), more or {}
    )


class OnceAFrame:
    """A search for all colours of a team, done once for all that look at the same picture for some of them."""

    name = "onboard"

    def __init__(self, colours: Colours) -> None:
        self._finder, self._colours = load_colours("onboard"), colours
        self._image: np.ndarray | None = None
        self._masks = np.zeros((0, 0, 0), np.uint8)

    def masks(self, image: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """As every `ColourFinder`."""
        if image is not self._image:
            self._image, self._masks = image, self._finder.masks(image, self._colours.low, self._colours.high)
        same = (low[:, None] == self._colours.low).all(axis=2) & (high[:, None] == self._colours.high).all(axis=2)
        return self._masks[same.argmax(axis=1)]


class Eye:
    """Locates the scenes of a clip in one way, and scores that. Targets are those of single frames: nobody follows."""

    def __init__(self, source: SimulatorSource, way: Way, finder: OnceAFrame) -> None:
        self._source, self._way, self._finder = source, way, finder
        self._settings = usual(source, way.settings)
        self._kept = way.landmarks or tuple(range(len(source.names)))
        self._error_m = _errors(source.scenario, way.gps95_m, len(source.names), source.count or 0)
        self._watch: LandmarkWatch | None = None
        origin = source.scenario.world.origin_deg
        self._local = partial(geometry.east_north, origin_deg=origin)

    def step(self, scene: Scene, scorer: CrowdScorer, truth: Truth | None = None) -> float:
        """Locate the targets of the next scene; the truth of its frame has been fed to the scorer.

        Returns how far off the picture itself lies on the ground, where crowds truly are: the mean over them of the
        distance to where the pixel of their middle is laid, m; NaN where that is not known.
        """
        site = self._site()
        if self._watch is None:
            self._watch = self._made(site)
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
        grounded = locator.locate_targets(watched.fixed, targets)
        tracks = Tracks(scene.frame.number, rows + 1, found.box_px, found.score, rows)
        scorer.feed(
            FrameResult(TrackedFrame(scene.frame.number, scene.frame, found, tracks), grounded, watched.sighted_by)
        )
        return math.nan if truth is None else self._astray(truth, locator, watched.fixed.fix)

    def _astray(self, truth: Truth, locator: AerialLocator, fix: Fix) -> float:
        bodies = truth.bodies
        crowds = [bodies.target == number for number in np.unique(bodies.target[bodies.kind == "person"])]
        middle = np.array([bodies.place_m[rows].mean(axis=0) for rows in crowds])
        pixel = view_from_pose(truth.pose, self._source.camera).project(middle)
        width, height = self._source.size
        inside = ((pixel >= 0) & (pixel <= (width - 1, height - 1))).all(axis=1)
        if not fix.by or not inside.any():
            return math.nan
        origin = locator.site.origin_deg
        assert origin is not None
        laid = self._local(geometry.lonlat(locator.ground_places(fix, pixel[inside]), origin))
        return float(np.linalg.norm(laid - middle[inside, :2], axis=1).mean())

    def scorer(self) -> CrowdScorer:
        """A new one in the truth's metres."""
        return CrowdScorer(self._local)

    def _made(self, site: Site) -> LandmarkWatch:
        source = self._source
        locator = AerialLocator.from_site(
            site, source.camera, self._settings, load_solver("onboard"), source.rate_hz, focal_known=True
        )
        colours = source.colours
        rows = np.array(self._kept)
        some = Colours(tuple(colours.names[k] for k in rows), colours.low[rows], colours.high[rows])
        return LandmarkWatch(locator, some, self._finder)

    def _site(self) -> Site:
        """What was reported until now, in the metres of the first report, with the ground's elevation."""
        reports = self._reports()
        telemetry = self._source.telemetry()
        if self._watch is None:
            site = build_site(reports, telemetry)
            return replace(site, elevation=self._elevation(site), sun_rad=self._source.sun_rad)
        site = self._watch.locator.site
        assert site.origin_deg is not None
        return replace(
            site, landmarks=to_local(reports, site.origin_deg), telemetry=to_local(telemetry, site.origin_deg)
        )

    def _elevation(self, site: Site) -> Elevation:
        elevation, origin = self._source.elevation, site.origin_deg
        assert origin is not None
        return shift_origin(elevation, self._local(np.array([origin]))[0])

    def _reports(self) -> Landmarks:
        """Those of the landmarks in use, with the receivers' errors; without planned waypoints."""
        table = self._source.landmarks()
        kept = np.isin(table.landmark, self._kept) & ~table.planned
        frame, which, place, sigma = table.frame[kept], table.landmark[kept], table.place[kept], table.sigma_m[kept]
        if self._way.gps95_m:
            metres = self._local(place) + self._error_m[np.round(frame).astype(int) - 1, which]
            place = geometry.lonlat(metres, self._source.scenario.world.origin_deg)
            sigma = np.hypot(np.nan_to_num(sigma), self._way.gps95_m / SIGMAS_95)
        return Landmarks(
            tuple(table.names[k] for k in self._kept), frame, np.searchsorted(self._kept, which),
            table.image_px[kept], place, sigma, table.planned[kept], table.line[kept], True, table.path,
        )  # fmt: skip


def _errors(scenario: Scenario, gps95_m: float, count: int, frames: int) -> np.ndarray:
    """(F, K, 2) metres, the receivers' errors in each frame: the same for all ways, but for their size."""
    gps = scenario.gps
    rng = np.random.default_rng([scenario.seed, 77])
    receivers = Receivers(count, gps95_m, gps.white_share, gps.correlation_s, 0.0, rng)
    errors = []
    for _ in range(frames):
        errors.append(receivers.error_m)
        receivers.advance(1 / scenario.clip.rate_hz)
    return np.array(errors).reshape(frames, count, 2)


def located(scenario: Scenario, ways: Sequence[Way], parts_s: Sequence[float] = ()) -> dict[str, list[dict[str, Any]]]:
    """The scores of each way, by its name: one for each part of the clip. parts_s: where later parts begin.

    A score is CrowdScore's figures by name, and picture_m: how far off the picture lies on the ground, see Eye.step.
    """
    source = SimulatorSource(scenario)
    finder = OnceAFrame(source.colours)
    eyes = {way.name: Eye(source, way, finder) for way in ways}
    edges = [*parts_s, np.inf]
    scorers = {name: [eye.scorer() for _ in edges] for name, eye in eyes.items()}
    astray: dict[str, list[list[float]]] = {name: [[] for _ in edges] for name in eyes}
    truths: dict[int, Truth] = {}
    settings = usual(source)
    # As many frames are left out as the closed loop does before anything is found.
    begun: Any = StartedSource(source)
    scale = pixels_per_metre(scenario.uav.altitude_m, source.camera.focal_px[0])
    least = every_least(scale, source.rate_hz, settings.steering)
    source.steer(Command(every=int(np.clip(round(least), 1, settings.steering.maximum_every))))
    for scene in detect_motion(begun, settings, "onboard"):
        truths |= {truth.frame: truth for truth in source.truths()}
        truth = truths.pop(scene.frame.number, None)
        if truth is None:
            continue
        true, part = shown(truth), int(np.searchsorted(edges, scene.frame.time_s, side="right"))
        for name, eye in eyes.items():
            scorers[name][part].feed(true)
            astray[name][part].append(eye.step(scene, scorers[name][part], truth))
    return {
        name: [
            {**scorer.score().by_name(), "picture_m": float(np.nanmean(off)) if np.isfinite(off).any() else None}
            for scorer, off in zip(parts, astray[name], strict=True)
        ]
        for name, parts in scorers.items()
    }


def walking(seed: int, seconds: float, rate_hz: float = 10.0, **tables: dict[str, object]) -> Scenario:
    """A team about two crowds that walk side by side through its ring, to one side or past one another.

    tables: parameters beside the usual ones, by table: `uav={"altitude_m": 200.0}`.
    """
    rng = np.random.default_rng([seed, 5])
    crowds = []
    heading, turn = rng.uniform(0, 360), rng.choice([0.0, 180.0])
    for k, people in enumerate(rng.integers(6, 13, 2).tolist()):
        ahead = np.radians(heading + k * turn + rng.uniform(-10, 10))
        speed = rng.uniform(0.7, 1.4)
        # They pass one another at some distance: who is who where they meet is another question.
        aside = (-1 if k == 0 else 1) * rng.uniform(5, 7) * (1 if turn == 0 or k == 0 else -1)
        way = np.array([np.sin(ahead), np.cos(ahead)])
        # In the middle of the ring halfway through the run.
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


class Kept:
    """All frames of a scenario that flies as planned, drawn once, to be searched several times.

    truths: by the number of the frame. log: the telemetry of the whole run.
    """

    def __init__(self, source: SimulatorSource) -> None:
        self.rate_hz, self.size = source.rate_hz, source.size
        self.frames: list[Frame] = []
        self.truths: dict[int, Truth] = {}
        for frame in source:
            self.frames.append(frame)
            self.truths |= {truth.frame: truth for truth in source.truths()}
        self.last = source.last
        # A method of that name would be asked at every frame what was reported so far.
        self.log = source.telemetry()

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)
