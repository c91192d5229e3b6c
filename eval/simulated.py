"""Studies on rendered video with known truth. They need no data.

python eval/simulated.py altitude     errors of crowds from video to metres by altitude, and from the ground
                                      (appendix A, Fig. 7)
python eval/simulated.py landmarks    four or six landmarks, by the centres of their colours or of motion (Fig. 8, 9)
python eval/simulated.py loop         the benefit of feedback: closed loop beside open loops
python eval/simulated.py ground       centre and course of crowds by the people seen from the ground (appendix A, III-B)
python eval/simulated.py whole        whole scenarios in the closed loop

Figures are mean ± standard error (range) over seeds. --cache FILE keeps finished cases.
"""

import csv
import math
import tempfile
from collections import Counter
from collections.abc import Iterator
from functools import partial
from itertools import product, zip_longest
from pathlib import Path
from typing import Any

import bench
import cv2
import numpy as np
from bench import Spread
from simulated_clips import GROUND_WAYS, Case, Way, locate_clip, locate_from_ground, walking

from torchvision_dddas import geometry
from torchvision_dddas.config import load_config, with_parameters
from torchvision_dddas.control import StartedSource
from torchvision_dddas.lab.evaluation.metrics.crowds import CrowdScorer
from torchvision_dddas.lab.simulation import SimulatorSource, load_scenario, scenario_settings
from torchvision_dddas.pipeline import Pipeline, assemble_mission
from torchvision_dddas.types import Command, Frame

# -- altitude and landmarks ------------------------------------------------------------------------------------------

GPS = {"exact": 0.0, "3.5 m": 3.5}
RAW: Case = {"aerial.mode": "paper"}
CHAINS: dict[str, tuple[str | None, Case]] = {
    "ours": (None, {}),
    "ours, homography in metres": (None, {"aerial.mode": "homography"}),
    "ours, raw degrees": (None, RAW),
    "source, raw degrees": ("source", RAW),
}
"""Configuration and settings. `ours` locates by the camera's pose."""
SOURCE_M = {50.0: 1.3, 200.0: 3.5}
"""The source's mean errors by altitude, simulated (appendix A, Fig. 7)."""


def measure_altitude(options: bench.Options) -> tuple[str, Any]:
    """Measure errors of crowds located from rendered video, with four exact landmarks and with receivers of 3.5 m.

    targets: distance of each located target from the people in its box. crowds: distance of each crowd from its located
    targets. picture: error of the picture's map to the ground at the crowds, by landmarks and telemetry alone. From the
    ground: by the people whom the same ground vehicles see with cameras turned to the nearest crowd.
    """
    cases = [
        {"seed": seed, "altitude_m": altitude, "seconds": options.seconds, "size": bench.parse_size(options.size)}
        for seed in range(options.seeds)
        for altitude in options.altitudes
    ]
    results = bench.run_cases(cases, fly_altitude, options.jobs, options.cache)
    errors, seen, panels = [], [], []
    for altitude in options.altitudes:
        here = [r for c, r in zip(cases, results, strict=True) if c["altitude_m"] == altitude]
        for chain, gps in product(CHAINS, GPS):
            of = [result[f"{chain}, {gps}"] for result in here]
            target = [Spread(r["target_error_m"][key] for r in of) for key in ("mean", "median", "p95")]
            cells = [target[0].text(), *(one.text(spread=False) for one in target[1:])]
            cells += [Spread(r["inside"] for r in of).text(0, 100, spread=False)]
            cells += [Spread(r["crowd_error_m"]["mean"] for r in of).text(), Spread(r["picture_m"] for r in of).text()]
            source = (
                f"{SOURCE_M[altitude]:g}"
                if altitude in SOURCE_M and gps == "exact" and CHAINS[chain][0] == "source"
                else "–"
            )
            errors.append([f"{altitude:g}", chain, gps, *cells, source])
        lines = {chain: _by_second([r[f"{chain}, exact"] for r in here], 1) for chain in CHAINS}
        panels.append({"title": f"{altitude:g} m, exact GPS", "xlabel": "s", "ylabel": "targets, m", "lines": lines})
        for chain in ("ours", "source, raw degrees"):
            of = [result[f"{chain}, exact"] for result in here]
            cells = [Spread(r[key] for r in of).text(1, 100) for key in ("recall", "recall_moving", "detected")]
            cells += [Spread(r[key] for r in of).text() for key in ("false_blobs", "landmark_blobs")]
            seen.append([f"{altitude:g}", chain.partition(",")[0], *cells])
    ground = [r for c, r in zip(cases, results, strict=True) if c["altitude_m"] == options.altitudes[0]]
    rows = []
    for way, gps in product(GROUND_WAYS, GPS):
        of = [r[f"ground, {gps}"][way] for r in ground]
        cells = [Spread(r["crowd_m"] for r in of).text(), f"{sum(r['crowds'] for r in of)}"]
        rows.append([way, gps, *cells, Spread(r["elsewhere"] for r in of).text(1, 100, spread=False)])
    bench.draw(options.plot, panels)
    head = ["AGL m", "chain", "GPS", "targets: mean error m", "median", "95 %", "in 95 % ellipses, %"]
    text = bench.format_table([*head, "crowds: mean error m", "picture m", "published"], errors, words=3)
    head = ["AGL m", "chain", "recall %", "of moving crowds %", "detected %", "false blobs a frame"]
    text += f"\n\n{bench.format_table([*head, 'landmarks as targets'], seen, words=2)}"
    head = ["from the ground", "GPS", "crowds: mean error m", "crowds located", "people located elsewhere, %"]
    return f"{text}\n\n{bench.format_table(head, rows, words=2)}\n\n{about(options)}", results


def fly_altitude(case: Case) -> Case:
    """Simulate a clip and return its scores by each way of location."""
    cv2.setNumThreads(1)
    width, height = case["size"]
    tables = {"uav": {"altitude_m": case["altitude_m"]}, "camera": {"width_px": width, "height_px": height}}
    scenario = walking(case["seed"], case["seconds"], **tables)
    ways = {
        f"{chain}, {gps}": Way(error95_m, config, parameters)
        for (chain, (config, parameters)), (gps, error95_m) in product(CHAINS.items(), GPS.items())
    }
    found = locate_clip(scenario, ways)
    for gps, error95_m in GPS.items():
        own = walking(case["seed"], case["seconds"], **tables, gps={"error95_m": error95_m})
        found[f"ground, {gps}"] = locate_from_ground(own)
    return found


def _by_second(of: list[Case], column: int) -> dict[str, Any]:
    """Return a line of the mean over seeds, for each second of a clip; of targets (column 1) or of the picture (2)."""
    columns = list(zip_longest(*(r["seconds"] for r in of), fillvalue=(0, math.nan, math.nan)))
    return {"x": list(range(len(columns))), "y": [Spread(one[column] for one in second).mean for second in columns]}


SIX, FOUR = (), (0, 1, 3, 4)
"""Rows of the used landmarks: all six (empty), or four of the ring that form a rectangle."""
SLOW_S = 15
"""Time at which the vehicles slow down, in the source (appendix A, section V) and in `team.patrol = gather`."""
PARTS = {"fast": slice(0, SLOW_S), "slow": slice(SLOW_S, None)}
LANDMARK_CHAINS = ("ours", "ours, raw degrees", "source, raw degrees")
SOURCE_LANDMARKS_M = {4: 2.24, 6: 2.49}
"""The source's mean errors by motion, fast and slow together (appendix A, section V, the text on Fig. 8)."""


def measure_landmarks(options: bench.Options) -> tuple[str, Any]:
    """Measure errors with four or six landmarks, whose image places are the centres of their colours or of motion.

    Six ground vehicles gather about two crowds, fast until t = 15 s and slow afterwards, with exact places unless
    --gps95 is given. With four landmarks, the reports of two vehicles are not used. targets, picture: as in `altitude`,
    means over the seconds. The plot shows the errors by second.
    """
    cases = [
        {"seed": seed, "altitude_m": options.altitude, "seconds": options.seconds, "gps95_m": options.gps95}
        for seed in range(options.seeds)
    ]
    results = bench.run_cases(cases, fly_landmarks, options.jobs, options.cache)
    rows, panels = [], []
    for chain in LANDMARK_CHAINS:
        lines = {}
        for centre, count in product(("colour", "motion"), (4, 6)):
            of = [result[f"{chain}, {centre}, {count}"] for result in results]
            cells = [_part(of, part, column).text() for column in (1, 2) for part in PARTS.values()]
            whole = _part(of, slice(None), 1)
            published = f"{SOURCE_LANDMARKS_M[count]:g}" if centre == "motion" and chain.startswith("source") else "–"
            rows.append([chain, centre, str(count), *cells, whole.text(), published])
            lines[f"{centre}, {count}"] = _by_second(of, 1)
        panels.append({"title": chain, "xlabel": "s", "ylabel": "targets, m", "lines": lines})
    bench.draw(options.plot, panels)
    head = ["chain", "centres", "landmarks", *(f"{of}, {part}: m" for of in ("targets", "picture") for part in PARTS)]
    text = bench.format_table([*head, "targets, all: m", "published"], rows, words=2)
    return f"{text}\n\nAt {options.altitude:g} m, receivers of {options.gps95:g} m in 95 %; {about(options)}", results


def fly_landmarks(case: Case) -> Case:
    """Simulate a clip and return its scores by each way of location."""
    cv2.setNumThreads(1)
    team = {"ugvs": 6, "patrol": "gather", "ring_m": 18.0}
    scenario = walking(case["seed"], case["seconds"], uav={"altitude_m": case["altitude_m"]}, team=team)
    ways = {}
    for chain, centre, (count, used) in product(LANDMARK_CHAINS, ("colour", "motion"), ((4, FOUR), (6, SIX))):
        config, parameters = CHAINS[chain]
        parameters = {**parameters, "landmarks.centre": centre}
        ways[f"{chain}, {centre}, {count}"] = Way(case["gps95_m"], config, parameters, used)
    return locate_clip(scenario, ways)


def _part(of: list[Case], part: slice, column: int) -> Spread:
    """Return the mean over some seconds of each clip. Weight the means of targets by the number of located targets."""
    values = []
    for result in of:
        seconds = np.array(result["seconds"], float)[part]
        known = seconds[np.isfinite(seconds[:, column])]
        weight = known[:, 0] if column == 1 else np.ones(len(known))
        values.append(float(np.average(known[:, column], weights=weight)) if weight.sum() else math.nan)
    return Spread(values)


# -- the loop --------------------------------------------------------------------------------------------------------

OPEN: Case = {"steering.on": False, "interval.rule": False, "track.appearance": "never"}
LOOPS: dict[str, Case] = {
    "closed": {},
    "closed, looks nearer": {"steering.least_move_px": 1.5, "steering.maximum_every": 5},
    "closed, looks further apart": {"steering.least_move_px": 4.0},
    "closed, every frame": {"steering.sampling": False},
    "closed, vehicles as planned": {"steering.look": False, "steering.follow": False},
    **{f"open, every {every}": {**OPEN, "every": every} for every in (1, 2, 3, 5)},
}


class TimedSource:
    """A source that measures its own processor time, mainly for drawing."""

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
    """Measure the error of each crowd's known place at each moment, against processor time per second of clip.

    An unknown crowd counts as 10 m. Open loops fly as planned and process every k-th frame. The time is of one thread,
    without drawing and scoring. "aerial": without people seen from the ground.
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
    """Run a shipped scenario."""
    scene = [f"clip.seconds={case['seconds']}"] if case["seconds"] else []
    return fly(SimulatorSource(load_scenario(case["scenario"], scene, case["seed"]), case["scenario"]), case["set"])


def fly(source: SimulatorSource, changed: Case) -> Case:
    """Run with changed settings. The setting `every` = N processes every N-th frame only."""
    cv2.setNumThreads(1)
    parameters = {name: value for name, value in changed.items() if name != "every"}
    settings = with_parameters(load_config(None, (), base=scenario_settings(source.scenario)), parameters)
    timed: Any = TimedSource(source, changed.get("every", 1))
    started = StartedSource(timed)
    ready = assemble_mission(started, settings, "onboard", by_landmarks=True)
    scorer = CrowdScorer(partial(geometry.east_north, origin_deg=source.origin_deg))
    stages, judging, timed.spent_s, start = Counter[str](), 0.0, 0.0, bench.now()[1]
    for result in Pipeline.from_assembly(ready)(started):
        stages.update(result.locations.seconds if result.locations is not None else result.tracked.seconds)
        before = bench.now()[1]
        for truth in source.truths():
            scorer.feed(truth)
        scorer.feed(result)
        judging += bench.now()[1] - before
    cpu = (bench.now()[1] - start - judging - timed.spent_s) / source.scenario.clip.seconds
    aerial = cpu * (1 - stages.get("people", 0.0) / max(sum(stages.values()), 1e-9))
    return {"score": scorer.score().by_name(), "cpu": float(cpu), "aerial": float(aerial)}


# -- whole scenarios -------------------------------------------------------------------------------------------------


def measure_whole(options: bench.Options) -> tuple[str, Any]:
    """Measure whole scenarios in the closed loop, from video to metres: the final scores of `dddas run sim:NAME`.

    The seed is 11, on which no parameter was chosen.
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
    """Return the scores of a run, by name."""
    from torchvision_dddas.lab.evaluation.simulated_run import run_scenario

    with tempfile.TemporaryDirectory() as out:
        _, score = run_scenario(Path(out), case["scenario"], seed=case["seed"])
    return score.by_name()


# -- crowds by the ground vehicles -----------------------------------------------------------------------------------

FOLLOWS = {"closed loop": True, "the UAV does not follow": False}
"""A UAV that flies as planned loses crowds. Then sightings from the ground steer the ground vehicles."""


def measure_ground(options: bench.Options) -> tuple[str, Any]:
    """Measure errors of crowds.csv: centre and predicted course of a crowd by the people whom ground vehicles see.

    A row of crowds.csv is compared with the true crowd with the nearest centre. steers: rows of crowds that the UAV has
    lost, which steer the ground vehicles. Appendix A, III-B.
    """
    cases = [
        {"scenario": name, "seed": seed, "follow": follow}
        for follow in FOLLOWS.values()
        for name in options.scenarios
        for seed in range(options.seeds)
    ]
    results = bench.run_cases(cases, fly_ground, options.jobs, options.cache)
    rows = []
    for setting, follow in FOLLOWS.items():
        of = [row for c, rows_of in zip(cases, results, strict=True) if c["follow"] == follow for row in rows_of]
        for what, steers in (("all", (0.0, 1.0)), ("steers", (1.0,))):
            table = np.array([row for row in of if row[2] in steers], float).reshape(-1, 3)
            centre, course = table[:, 0], table[np.isfinite(table[:, 1]), 1]
            cells = [f"{np.percentile(x, q):.2f}" if len(x) else "–" for x in (centre, course) for q in (50, 95)]
            known = f"{100 * len(course) / len(table):.0f}" if len(table) else "–"
            rows.append([setting, what, str(len(table)), *cells[:2], known, *cells[2:]])
    head = ["setting", "rows", "count", "centre: median error m", "95 %"]
    text = bench.format_table([*head, "course known, %", "course: median error m/s", "95 %"], rows, words=2)
    return f"{text}\n\n{', '.join(options.scenarios)}; {options.seeds} seeds.", results


def fly_ground(case: Case) -> list[list[float]]:
    """Return the errors of centre and course of each row of crowds.csv, and whether the row steers vehicles."""
    from torchvision_dddas.lab.evaluation.simulated_run import run_scenario

    with tempfile.TemporaryDirectory() as out:
        words = [f"steering.follow={str(case['follow']).lower()}"]
        run_scenario(Path(out), case["scenario"], overrides=words, seed=case["seed"], save=("truth",))
        found, true = _rows(Path(out) / "crowds.csv"), _rows(Path(out) / "truth" / "positions.csv")
    errors = []
    for row in found:
        crowds = [t for t in true if t["frame"] == row["frame"] and t["kind"] == "person"]
        lonlat = np.array([[float(t["longitude_deg"]), float(t["latitude_deg"])] for t in crowds])
        away = np.linalg.norm(
            geometry.east_north(lonlat, (float(row["longitude_deg"]), float(row["latitude_deg"]))), axis=1
        )
        nearest = crowds[int(away.argmin())]
        course = [float(row[f"velocity_{of}_m_s"] or "nan") - float(nearest[f"{of}_m_s"]) for of in ("east", "north")]
        errors.append([float(away.min()), float(np.hypot(*course)), float(row["steers"])])
    return errors


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def about(options: bench.Options) -> str:
    """Return the last line of a study's text."""
    length = f"{options.seconds:g} s each" if options.seconds else "each as long as the scenario says"
    return f"{options.seeds} seeds, {length}: mean ± standard error (range over seeds)."


if __name__ == "__main__":
    common = {"--seeds": 20, "--jobs": 1, "--cache": None}
    scenarios = ["joining", "splitting", "crossing", "random", "border50", "border100", "border200"]
    altitudes = {"--seconds": 6.0, "--altitudes": [50.0, 100.0, 200.0], "--size": "640x480", "--plot": None}
    landmarks = {"--seconds": 19.0, "--altitude": 50.0, "--gps95": 0.0, "--plot": None}
    loop = {"--seconds": 0.0, "--seeds": 10, "--scenarios": ["leaving"], "--plot": None}
    studies = {
        "altitude": (measure_altitude, common | altitudes),
        "landmarks": (measure_landmarks, common | landmarks),
        "loop": (measure_loop, common | loop),
        "ground": (measure_ground, {"--scenarios": ["leaving", "splitting", "crossing"], **common, "--seeds": 3}),
        "whole": (measure_whole, {"--scenarios": scenarios, "--seed": 11, "--jobs": 1, "--cache": None}),
    }
    bench.main(__doc__, studies)
