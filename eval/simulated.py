"""Studies on rendered video with known truth; no data needed.

python eval/simulated.py altitude     errors of crowds from video to metres by altitude (appendix A, Fig. 7)
python eval/simulated.py loop         what feedback buys: closed loop beside open loops
python eval/simulated.py interval     what the detection interval buys (appendix B, eq. 2)
python eval/simulated.py whole        whole scenarios in the closed loop

Figures are mean ± standard error (range) over seeds. --cache FILE keeps finished cases.
"""

import math
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import bench
import cv2
import numpy as np
from bench import Spread

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.control import StartedSource, build_mission, fit_settings
from torchvision_dddas.control.rules import every_least
from torchvision_dddas.detection import MotionDetector, detect_motion, load_engine, pixels_per_metre
from torchvision_dddas.evaluation.metrics import boxes as box_metrics
from torchvision_dddas.evaluation.metrics import pixels as pixel_metrics
from torchvision_dddas.evaluation.metrics.crowds import CrowdScorer, TrueFrame
from torchvision_dddas.evaluation.metrics.pixels import add_counts
from torchvision_dddas.geo import AerialLocator, LandmarkWatch, Site, Targets, build_site, group_crowds, to_local
from torchvision_dddas.geo.colours import load_colours
from torchvision_dddas.geo.plane_homography import load_solver
from torchvision_dddas.geo.projection import shift_origin
from torchvision_dddas.pipeline import Pipeline
from torchvision_dddas.simulation import CarPlan, CrowdPlan, Scenario, SimulatorSource, load_scenario, scenario_settings
from torchvision_dddas.simulation.cameras import view_from_pose
from torchvision_dddas.simulation.sensors import SIGMAS_95, Receivers
from torchvision_dddas.types import Command, Frame, FrameResult, Landmarks, Scene, TrackedFrame, Tracks, Truth

CONFIG = "patrol"
"""The shipped configuration of a team that watches crowds."""
Case = dict[str, Any]


# -- one clip, located in several ways ------------------------------------------------------------------------------


def usual(source: SimulatorSource) -> Settings:
    """The settings of `dddas run sim:`."""
    return fit_settings(load_config(CONFIG, (), scenario_settings(source.scenario)), source)


class ClipLocator:
    """Locates the scenes of a clip, and scores that. Targets are those of single frames, without tracks.

    gps95_m: error of the landmarks' receivers in 95 %, added to the reports.
    """

    def __init__(self, source: SimulatorSource, gps95_m: float) -> None:
        self._source, self._gps95_m, self._settings = source, gps95_m, usual(source)
        self._error_m = receiver_errors(source.scenario, gps95_m, len(source.names), source.count or 0)
        self._local = partial(geometry.east_north, origin_deg=source.scenario.world.origin_deg)
        self._watch: LandmarkWatch | None = None

    def scorer(self) -> CrowdScorer:
        """A new one in the truth's metres."""
        return CrowdScorer(self._local)

    def locate(self, scene: Scene, scorer: CrowdScorer, truth: Truth) -> float:
        """Locate the targets of the next scene; the truth of its frame has been fed to the scorer.

        Returns the error of the picture on the ground, m: mean over the crowds of the distance between their middle and
        the place to which its pixel is projected; NaN where that is not known.
        """
        site = self._site()
        if self._watch is None:
            locator = AerialLocator.from_site(
                site, self._source.camera, self._settings, load_solver("onboard"), self._source.rate_hz,
                focal_known=True,
            )  # fmt: skip
            self._watch = LandmarkWatch(locator, self._source.colours, load_colours("onboard"))
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
        """What was reported until now, in the metres of the first report, with the ground's elevation."""
        reports, telemetry = self._reports(), self._source.telemetry()
        if self._watch is None:
            site = build_site(reports, telemetry)
            elevation = shift_origin(self._source.elevation, self._local(np.array([site.origin_deg]))[0])
            return replace(site, elevation=elevation, sun_rad=self._source.sun_rad)
        site = self._watch.locator.site
        local = to_local(reports, site.origin_deg), to_local(telemetry, site.origin_deg)
        return replace(site, landmarks=local[0], telemetry=local[1])

    def _reports(self) -> Landmarks:
        """The landmarks' reports with the receivers' errors; without planned waypoints."""
        table = self._source.landmarks()
        kept = ~table.planned
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
    """(F, K, 2) errors in metres in each frame: the same for all ways, except for their size."""
    gps, errors = scenario.gps, []
    receivers = Receivers(
        count, gps95_m, gps.white_share, gps.correlation_s, 0.0, np.random.default_rng([scenario.seed, 77])
    )
    for _ in range(frames):
        errors.append(receivers.error_m)
        receivers.advance(1 / scenario.clip.rate_hz)
    return np.array(errors).reshape(frames, count, 2)


def locate_clip(scenario: Scenario, gps95_m: Mapping[str, float]) -> Case:
    """The scores with each error of the receivers, in the same detections."""
    source = SimulatorSource(scenario)
    locators = {name: ClipLocator(source, error) for name, error in gps95_m.items()}
    scorers, errors = {name: one.scorer() for name, one in locators.items()}, {name: [] for name in locators}
    truths, settings, started = {}, usual(source), StartedSource(source)
    # As many frames are left out as the closed loop leaves out before anything is found.
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
            scorers[name].feed(true)
            errors[name].append(one.locate(scene, scorers[name], truth))
    return {
        name: scorer.score().by_name() | {"picture_m": float(np.nanmean(errors[name]))}
        for name, scorer in scorers.items()
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


# -- altitude and landmarks ------------------------------------------------------------------------------------------

GPS = {"exact": 0.0, "3.5 m": 3.5}
SOURCE_M = {50.0: 1.3, 200.0: 3.5}
"""The source's mean errors by altitude, simulated (appendix A, Fig. 7)."""


def measure_altitude(options: bench.Options) -> tuple[str, Any]:
    """Errors of crowds located from rendered video, with exact places of four landmarks and receivers of 3.5 m.

    targets: of each located target from the people in its box. crowds: of each crowd from what was located of it.
    picture: of the picture on the ground where the crowds are, by landmarks and telemetry alone.
    """
    cases = [
        {"seed": seed, "altitude_m": altitude, "seconds": options.seconds, "size": bench.parse_size(options.size)}
        for seed in range(options.seeds)
        for altitude in options.altitudes
    ]
    results = bench.run_cases(cases, fly_altitude, options.jobs, options.cache)
    errors, seen = [], []
    for altitude in options.altitudes:
        here = [r for c, r in zip(cases, results, strict=True) if c["altitude_m"] == altitude]
        for gps in GPS:
            of = [result[gps] for result in here]
            target = [Spread(r["target_error_m"][key] for r in of) for key in ("mean", "median", "p95")]
            cells = [target[0].text(), *(one.text(spread=False) for one in target[1:])]
            cells += [Spread(r["inside"] for r in of).text(0, 100, spread=False)]
            cells += [Spread(r["crowd_error_m"]["mean"] for r in of).text(), Spread(r["picture_m"] for r in of).text()]
            source = f"{SOURCE_M[altitude]:g}" if altitude in SOURCE_M and gps == "exact" else "–"
            errors.append([f"{altitude:g}", gps, *cells, source])
        of = [result["exact"] for result in here]
        cells = [Spread(r[key] for r in of).text(1, 100) for key in ("recall", "recall_moving", "detected")]
        cells += [Spread(r[key] for r in of).text() for key in ("false_blobs", "landmark_blobs")]
        seen.append([f"{altitude:g}", *cells])
    head = ["AGL m", "GPS", "targets: mean error m", "median", "95 %", "in 95 % ellipses, %", "crowds: mean error m"]
    text = bench.format_table([*head, "picture m", "source"], errors, words=2)
    head = ["AGL m", "recall %", "of moving crowds %", "detected %", "false blobs a frame", "landmarks as targets"]
    return f"{text}\n\n{bench.format_table(head, seen)}\n\n{about(options)}", results


def fly_altitude(case: Case) -> Case:
    """One clip, located in both ways."""
    width, height = case["size"]
    scenario = walking(
        case["seed"], case["seconds"], uav={"altitude_m": case["altitude_m"]},
        camera={"width_px": width, "height_px": height},
    )  # fmt: skip
    return locate_clip(scenario, GPS)


# -- the loop --------------------------------------------------------------------------------------------------------

OPEN: Case = {"steering.on": False, "interval.rule": False, "track.appearance": "never"}
LOOPS: dict[str, Case] = {
    "closed": {},
    "closed, every frame": {"steering.sampling": False},
    "closed, vehicles as planned": {"steering.look": False, "steering.follow": False},
    **{f"open, every {every}": {**OPEN, "every": every} for every in (1, 2, 3, 5)},
}


class TimedSource:
    """A source whose own processor time, drawing above all, is known."""

    def __init__(self, source: SimulatorSource, every: int) -> None:
        self._source, self._every = source, every
        self.spent_s, self.frames = 0.0, 0

    def __iter__(self) -> Iterator[Frame]:
        frames = iter(self._source)
        while True:
            start = bench.now()[1]
            frame = next(frames, None)
            self.spent_s += bench.now()[1] - start
            if frame is None:
                return
            if self.frames == 0 and self._every > 1:
                self._source.steer(Command(every=self._every))
            self.frames += 1
            yield frame

    def __getattr__(self, name: str) -> object:
        return getattr(self._source, name)


def measure_loop(options: bench.Options) -> tuple[str, Any]:
    """Error of the known place of every crowd at every moment, against processor time a second of clip.

    A crowd of which nothing is known costs 10 m. Open loops fly as planned and look at every k-th frame. Time is of one
    thread, without drawing and judging; "aerial": without people seen from the ground.
    """
    cases = [
        {"scenario": name, "seed": seed, "seconds": options.seconds, "set": LOOPS[loop]}
        for loop in LOOPS
        for name in options.scenarios
        for seed in range(options.seeds)
    ]
    results = bench.run_cases(cases, fly_loop, options.jobs, options.cache)
    rows, lines = [], {}
    for loop, settings in LOOPS.items():
        of = [r for c, r in zip(cases, results, strict=True) if c["set"] == settings]
        score = [r["score"] for r in of]
        known, times = (
            Spread(s["knowledge_m"] for s in score),
            [Spread(r[key] for r in of) for key in ("cpu", "aerial")],
        )
        cells = [Spread(s[key] for s in score).text(1, 100, False) for key in ("known", "recall", "kind_right")]
        cells += [Spread(s[key] for s in score).text(2, 1, False) for key in ("false_blobs", "switches_a_minute")]
        rows.append([loop, known.text(), *cells, *(one.text(2, 1, False) for one in times)])
        lines[loop] = {"x": [times[0].mean], "y": [known.mean], "error": [known.error], "style": "o"}
    bench.draw(options.plot, [{"xlabel": "s of processor a s", "ylabel": "known to within, m", "lines": lines}])
    head = ["setting", "known to within m", "of moments %", "recall %", "human or not %", "false blobs"]
    head += ["switches a minute", "s/s", "aerial s/s"]
    return f"{bench.format_table(head, rows)}\n\n{', '.join(options.scenarios)}; {about(options)}", results


def fly_loop(case: Case) -> Case:
    """One run of a shipped scenario."""
    scene = [f"clip.seconds={case['seconds']}"] if case["seconds"] else []
    return fly(SimulatorSource(load_scenario(case["scenario"], scene, case["seed"]), case["scenario"]), case["set"])


def fly(source: SimulatorSource, changed: Case) -> Case:
    """One run with changed settings; `every` of them: look at every so many frames."""
    cv2.setNumThreads(1)
    parameters = {name: value for name, value in changed.items() if name != "every"}
    settings = with_parameters(load_config(CONFIG, (), scenario_settings(source.scenario)), parameters)
    timed: Any = TimedSource(source, changed.get("every", 1))
    started = StartedSource(timed)
    mission = build_mission(started, settings, "onboard")
    engine = load_engine("onboard", mission.settings)
    scorer = CrowdScorer(partial(geometry.east_north, origin_deg=source.origin_deg))
    stages, judging, timed.spent_s, start = Counter[str](), 0.0, 0.0, bench.now()[1]
    for result in Pipeline.from_parts(engine, mission.settings, None, mission.watch, 1, mission)(started):
        stages.update(result.locations.seconds if result.locations is not None else result.tracked.seconds)
        before = bench.now()[1]
        for truth in source.truths():
            scorer.feed(truth)
        scorer.feed(result)
        judging += bench.now()[1] - before
    cpu = (bench.now()[1] - start - judging - timed.spent_s) / source.scenario.clip.seconds
    aerial = cpu * (1 - stages.get("people", 0.0) / max(sum(stages.values()), 1e-9))
    return {"score": scorer.score().by_name(), "cpu": float(cpu), "aerial": float(aerial)}


# -- the detection interval ------------------------------------------------------------------------------------------

ALTITUDES_M, SPEEDS_M_S = (50.0, 100.0, 200.0), (2.0, 5.0, 10.0)
INTERVALS = (1, 2, 3, 5, 8)
LOOKED: dict[str, Case] = {
    "closed loop": {"steering.follow": False, "steering.look": False},
    **{str(every): {"steering.on": False, "interval.rule": False, "every": every} for every in INTERVALS},
}
COMPARED: dict[str, Case] = {
    "by the rule": {"interval.rule": True},
    **{str(frames): {"interval.rule": False, "interval.frames": frames} for frames in INTERVALS},
}
MEASURED = {"source": ("F of pixels", "f"), "patrol": ("F1 of boxes", "box_f1")}
"""What is measured of a configuration: boxes of crowds, or the people in them where boxes are not a crowd's."""


def measure_interval(options: bench.Options) -> tuple[str, Any]:
    """Accuracy against processor time by detection interval: its rules beside fixed ones, by altitude and speed.

    First table: one of so many frames is looked at; to how many metres every crowd is known at every moment (10 m where
    nothing is known), and processor time a second of clip. The closed loop chooses the frames; vehicles fly as planned,
    with exact instruments, so that the error is that of detection and of the time between looks. Other tables: every
    frame is looked at, and the interval says how far apart the frames are that are compared; ms of processor a frame.
    """
    flights = [(altitude, speed) for altitude in ALTITUDES_M for speed in SPEEDS_M_S]
    studies = {"looked": [[way] for way in LOOKED], **{config: [list(COMPARED)] for config in options.configs}}
    cases = [
        {"study": study, "ways": ways, "altitude_m": a, "speed_m_s": s, "seed": seed, "seconds": options.seconds}
        for study, parts in studies.items()
        for a, s in flights
        for seed in range(options.seeds)
        for ways in parts
    ]
    results = bench.run_cases(cases, fly_interval, options.jobs, options.cache)
    tables = []
    for study in studies:
        ways, digits, what = LOOKED, 2, "known to within m / s a s"
        if study != "looked":
            ways, digits, what = COMPARED, 0, f"`{study}`: {MEASURED[study][0]} / ms"
        rows = []
        for of in (*flights, None):
            here = [
                result
                for case, result in zip(cases, results, strict=True)
                if case["study"] == study and of in (None, (case["altitude_m"], case["speed_m_s"]))
            ]
            cells = []
            for way in ways:
                a, b = (Spread(result[way][k] for result in here if way in result) for k in (0, 1))
                cells.append(f"{a.text(spread=False)} / {b.text(digits, spread=False)}")
            rows.append(["all" if of is None else "{:g} m, {:g} m/s".format(*of), *cells])
        tables.append(bench.format_table([what, *ways], rows))
    return "\n\n".join([*tables, f"Flights of {options.seconds:g} s, {options.seeds} a row."]), results


def fly_interval(case: Case) -> Case:
    """[accuracy, time] in some ways to choose the interval, on one flight to and fro over two crowds."""
    uav = {"altitude_m": case["altitude_m"], "speed_m_s": case["speed_m_s"]}
    uav |= {"start_m": (-15.0, 0.0), "way_m": ((15.0, 0.0),)}
    uav |= {"place_error95_m": 0.0, "angle_error_deg": 0.0, "heading_error_deg": 0.0, "altitude_error": 0.0}
    source = SimulatorSource(
        walking(
            case["seed"], case["seconds"], uav=uav, team={"ugvs": 0},
            clip={"seconds": case["seconds"], "located_by": "telemetry"},
        )
    )  # fmt: skip
    if case["study"] == "looked":
        (way,) = case["ways"]
        run = fly(source, LOOKED[way])
        return {way: [run["score"]["knowledge_m"], run["cpu"]]}
    cv2.setNumThreads(1)
    frames, truths, found = list(source), source.truths(), {}
    for way in case["ways"]:
        settings = with_parameters(fit_settings(load_config(case["study"]), source), COMPARED[way])
        detector = MotionDetector(settings, "onboard", source.rate_hz, source.telemetry())
        start = bench.now()[1]
        scenes = [scene for frame in frames for scene in detector.update(frame)] + detector.flush()
        spent_ms = 1e3 * float(bench.now()[1] - start) / len(frames)
        found[way] = [score_scenes(scenes, truths)[MEASURED[case["study"]][1]], spent_ms]
    return found


def score_scenes(scenes: list[Scene], truths: list[Truth]) -> dict[str, float]:
    """Measures of masks, and the F1 of boxes at an IoU of 0.5."""
    pixels, boxes = pixel_metrics.Pixels(), box_metrics.Boxes()
    for scene, truth in zip(scenes, truths, strict=True):
        pixels = add_counts(pixels, pixel_metrics.count(scene.mask, truth.mask))
        true = box_metrics.boxes_of(truth.mask)
        boxes = add_counts(boxes, box_metrics.match(scene.detections.box_px, true))
    return {**pixel_metrics.measures(pixels), "box_f1": box_metrics.measures(boxes)["f1"]}


def measure_whole(options: bench.Options) -> tuple[str, Any]:
    """Whole scenarios in the closed loop, from video to metres: what `dddas run sim:NAME --seed 11` says at its end.

    Nothing was chosen on seed 11.
    """
    cases = [{"scenario": name, "seed": options.seed} for name in options.scenarios]
    scores = bench.run_cases(cases, fly_whole, options.jobs, options.cache)
    rows = []
    for case, s in zip(cases, scores, strict=True):
        right = f"{round((s['kind_right'] or 0) * s['kinds'])} of {s['kinds']}"
        cells = [f"{100 * s['recall']:.1f} %", f"{s['false_blobs']:.2f}", f"{s['target_error_m']['mean']:.2f} m"]
        rows.append([case["scenario"], *cells, f"{s['switches'] / s['crowd_minutes']:.1f}", right])
    head = ["scenario", "crowds found and located", "false blobs a frame", "error of a target"]
    return bench.format_table([*head, "switches a crowd and minute", "human or not, right"], rows), scores


def fly_whole(case: Case) -> Case:
    """The score of one run, by name."""
    from torchvision_dddas.evaluation.simulated_run import run_scenario

    with tempfile.TemporaryDirectory() as out:
        _, score = run_scenario(Path(out), case["scenario"], seed=case["seed"])
    return score.by_name()


def about(options: bench.Options) -> str:
    """The last line of a text."""
    return f"{options.seeds} seeds, {options.seconds:g} s each: mean ± standard error (range over seeds)."


if __name__ == "__main__":
    common = {"--seeds": 20, "--jobs": 1, "--cache": None}
    scenarios = ["joining", "splitting", "crossing", "random", "border50", "border100", "border200"]
    altitudes = {"--seconds": 6.0, "--altitudes": [50.0, 100.0, 200.0], "--size": "640x480"}
    loop = {"--seconds": 0.0, "--seeds": 10, "--scenarios": ["leaving"], "--plot": None}
    studies = {
        "altitude": (measure_altitude, common | altitudes),
        "loop": (measure_loop, common | loop),
        "interval": (measure_interval, common | {"--seeds": 1, "--seconds": 5.0, "--configs": list(MEASURED)}),
        "whole": (measure_whole, {"--scenarios": scenarios, "--seed": 11, "--jobs": 1, "--cache": None}),
    }
    bench.main(__doc__, studies)
