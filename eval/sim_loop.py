"""What feedback buys: a run in a closed loop beside open loops, in accuracy and in processing time.

    python eval/sim_loop.py --jobs 2 --cache FILE --write eval/README.md --plot docs/sim_loop.png

closed: `dddas run sim:` with its shipped configuration; what is found steers which frames are looked at, where the
vehicles go and when appearances are compared. Beside it the closed loop without one of these. Open loops fly as
planned, look at every k-th frame, compare appearances always or never, and keep their detection interval.

The figure of merit is CrowdScore.knowledge_m: how far off is what is known of every crowd at every moment, in the
picture or not, looked at or not; a crowd of which nothing is known costs 10 m. Time is the processor's, of one thread,
for each second of the clip, drawing and judging not among it: on a quiet machine it is what the stages of a run take,
which other programs disturb. What the aerial camera takes is told apart from what people seen from the ground take, by
its share of the stages: open loops do without these, and know nothing of who is human.
"""

import sys
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import cv2
import numpy as np
from sim_runs import Case, Over, finish, options, pyplot, run_all, table
from sim_scenes import CONFIG

from torchvision_dddas import geometry
from torchvision_dddas.config import load_config, with_parameters
from torchvision_dddas.control import StartedSource, build_mission
from torchvision_dddas.detection import load_engine
from torchvision_dddas.evaluation.metrics.crowds import CrowdScorer
from torchvision_dddas.pipeline import Pipeline
from torchvision_dddas.simulation import SimulatorSource, scenario_settings
from torchvision_dddas.simulation import load_scenario as load_scenario
from torchvision_dddas.types import Command, Frame

OPEN: Case = {"steering.on": False, "interval.rule": False}


def ways() -> dict[str, Case]:
    """Settings by name; every: of so many frames an open loop looks at one."""
    found: dict[str, Case] = {
        "closed": {},
        "closed, every frame": {"steering.sampling": False},
        "closed, vehicles as planned": {"steering.look": False, "steering.follow": False},
        "closed, UAV as planned": {"steering.follow": False},
    }
    for every in (1, 2, 3, 5):
        for appearance in ("always", "never"):
            found[f"open, every {every}, appearance {appearance}"] = {
                **OPEN, "every": every, "track.appearance": appearance,
            }  # fmt: skip
    for frames in (5, 8):
        found[f"open, every 1, interval {frames}"] = {
            **OPEN, "every": 1, "track.appearance": "never",
            "interval.frames": frames, "interval.maximum_frames": max(frames, 8),
        }  # fmt: skip
    return found


class Timed:
    """A source whose own time, drawing above all, is known and told apart."""

    def __init__(self, source: SimulatorSource, every: int) -> None:
        self._source, self._every = source, every
        self.cpu_s = 0.0
        self.looks = 0

    def __iter__(self) -> Iterator[Frame]:
        frames = iter(self._source)
        while True:
            start = time.process_time()
            frame = next(frames, None)
            self.cpu_s += time.process_time() - start
            if frame is None:
                return
            if self.looks == 0 and self._every > 1:
                self._source.steer(Command(every=self._every))
            self.looks += 1
            yield frame

    def __getattr__(self, name: str) -> object:
        return getattr(self._source, name)


def work(case: Case) -> Case:
    """One run."""
    cv2.setNumThreads(1)
    scene = [f"clip.seconds={case['seconds']}"] if case["seconds"] else []
    source = SimulatorSource(load_scenario(case["scenario"], scene, case["seed"]), case["scenario"])
    parameters = {name: value for name, value in case["set"].items() if name != "every"}
    settings = with_parameters(load_config(CONFIG, (), scenario_settings(source.scenario)), parameters)
    timed = Timed(source, case["set"].get("every", 1))
    begun = StartedSource(timed)
    mission = build_mission(begun, settings, "onboard")
    engine = load_engine("onboard", mission.settings)
    scorer = CrowdScorer(partial(geometry.east_north, origin_deg=source.origin_deg))
    stages: Counter[str] = Counter()
    judging = 0.0
    timed.cpu_s, start = 0.0, time.process_time()
    pipeline = Pipeline.from_parts(engine, mission.settings, None, mission.watch, 1, mission)
    for surveyed in pipeline(begun):
        grounded = surveyed.grounded
        stages.update(grounded.seconds if grounded is not None else surveyed.followed.seconds)
        before = time.process_time()
        for truth in source.truths():
            scorer.feed(truth)
        scorer.feed(surveyed)
        judging += time.process_time() - before
    spent = time.process_time() - start - judging - timed.cpu_s
    clip_s = source.scenario.clip.seconds
    return {
        "score": scorer.score().by_name(),
        "looks": timed.looks,
        "cpu": spent / clip_s,
        "stages": {stage: seconds / clip_s for stage, seconds in stages.items()},
    }


def time_of(result: Case, ground: bool = True) -> float:
    """Seconds a second of the clip; ground: with people seen from the ground."""
    stages = result["stages"]
    share = 0.0 if ground else stages.get("people", 0.0) / max(sum(stages.values()), 1e-9)
    return float(result["cpu"] * (1 - share))


def figures(results: list[Case]) -> dict[str, Over]:
    """Of one way, over seeds and scenarios."""
    score = [result["score"] for result in results]
    return {
        "knowledge": Over(s["knowledge_m"] for s in score),
        "known": Over(s["known"] for s in score),
        "recall": Over(s["recall"] for s in score),
        "error": Over(s["crowd_error_m"]["mean"] for s in score),
        "false": Over(s["false_blobs"] for s in score),
        "switches": Over(s["switches_a_minute"] for s in score),
        "kinds": Over(s["kind_right"] for s in score),
        "time": Over(time_of(result) for result in results),
        "aerial": Over(time_of(result, ground=False) for result in results),
        "stages": Over(sum(result["stages"].values()) for result in results),
        "looks": Over(float(result["looks"]) for result in results),
    }


def tables(found: dict[str, list[Case]]) -> str:
    """A row a way, then the closed loop beside each open one, seed by seed."""
    rows, pairs = [], []
    for name, results in found.items():
        of = figures(results)
        rows.append([
            name, of["knowledge"].text(), of["known"].text(0, 100, False), of["recall"].text(1, 100, False),
            of["error"].text(2, 1, False), of["false"].text(2, 1, False), of["switches"].text(1, 1, False),
            of["kinds"].text(0, 100, False), of["time"].text(2, 1, False), of["aerial"].text(2, 1, False),
            of["stages"].text(2, 1, False), of["looks"].text(0, 1, False),
        ])  # fmt: skip
        if name.startswith("open") and "closed" in found:
            closed = found["closed"]
            better = Over(
                there["score"]["knowledge_m"] - here["score"]["knowledge_m"]
                for here, there in zip(closed, results, strict=True)
            )
            share = Over(time_of(here) / time_of(there) for here, there in zip(closed, results, strict=True))
            aerial = Over(
                time_of(here, False) / time_of(there, False) for here, there in zip(closed, results, strict=True)
            )
            pairs.append([name, better.text(), share.text(2), aerial.text(2)])
    whole = table(
        ["setting", "known to within m", "of moments %", "recall %", "error where found m", "false blobs",
         "switches a minute", "human or not %", "s/s", "aerial s/s", "stages s/s", "looks"],
        rows,
    )  # fmt: skip
    beside = table(["closed beside", "better by m", "of its time", "of its aerial time"], pairs)
    return whole + "\n\n" + beside


def draw(found: dict[str, list[Case]], path: Path) -> None:
    """Merit against time, all settings in one plot: all time, and the aerial camera's."""
    plt = pyplot()
    # What all open loops share need not be said of each.
    appearances = {name.rpartition("appearance ")[2] for name in found if "appearance " in name}
    shared = appearances.pop() if len(appearances) == 1 else ""
    figure, axes = plt.subplots(1, 2, figsize=(11.5, 5.2), constrained_layout=True, sharey=True)
    for axis, key, title in zip(axes, ("time", "aerial"), ("all", "without people seen from the ground"), strict=True):
        front = []
        for name, results in found.items():
            of = figures(results)
            closed, x, y = name.startswith("closed"), of[key], of["knowledge"]
            colour = "#0b6e99" if closed else "#d9730d"
            axis.errorbar(
                x.mean, y.mean, np.nan_to_num(y.error), np.nan_to_num(x.error),
                fmt="*" if name == "closed" else "o", ms=14 if name == "closed" else 6, color=colour, capsize=2,
            )  # fmt: skip
            label = name.replace("appearance ", "app. ").replace("open, ", "").replace("closed, ", "")
            if shared:
                label = label.removesuffix(f", app. {shared}")
            axis.annotate(label, (x.mean, y.mean), xytext=(6, 4), textcoords="offset points", fontsize=7, color=colour)
            if not closed:
                front.append((x.mean, y.mean))
        # The best that an open loop does in so much time.
        best, line = np.inf, []
        for x_mean, y_mean in sorted(front):
            if y_mean < best:
                line += [(x_mean, best)] * bool(line) + [(x_mean, y_mean)]
                best = y_mean
        if line:
            right = axis.get_xlim()[1]
            axis.plot(*np.array([*line, (right, best)]).T, color="#d9730d", lw=1, alpha=0.6, label="best open loop")
        axis.set(xlabel=f"processing time, s for each second of the clip: {title}", xlim=(0, None))
    top = max(figures(results)["knowledge"].mean for results in found.values())
    axes[0].set_ylim(0, 1.12 * top if top > 0 else None)
    axes[0].set_ylabel("what is known of all crowds at all times: m off")
    axes[0].plot([], [], "*", color="#0b6e99", ms=12, label="closed loop")
    axes[0].plot([], [], "o", color="#d9730d", label="open loops")
    axes[0].legend(frameon=False)
    figure.suptitle("What feedback buys", fontsize=13, weight="bold")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run what is missing, print the tables, and write what was asked for."""
    parser = options(__doc__, seeds=20, seconds=0.0)
    parser.add_argument("--scenarios", nargs="+", default=["joining"], metavar="NAME", help="names or files; joining")
    parser.add_argument(
        "--only", nargs="+", metavar="WORD", help="settings of these names, or whose names hold a word that is none"
    )
    asked = parser.parse_args()
    words = [word for word in asked.only or () if word not in ways()]
    named = [name for name in ways() if name in (asked.only or ()) or any(word in name for word in words)]
    chosen = {name: parameters for name, parameters in ways().items() if not asked.only or name in named}
    # The settings in turns, so that what else the machine does is spread over them.
    cases = [
        {"scenario": scenario, "seed": seed, "seconds": asked.seconds, "name": name, "set": parameters}
        for scenario in asked.scenarios
        for seed in range(asked.seeds)
        for name, parameters in chosen.items()
    ]
    results = run_all(cases, work, asked.cache, asked.jobs)
    found = {name: [r for c, r in zip(cases, results, strict=True) if c["name"] == name] for name in chosen}
    note = f"{', '.join(asked.scenarios)}; {asked.seeds} seeds each: mean ± standard error (range)."
    runs = [{**case, **result} for case, result in zip(cases, results, strict=True)]
    finish(asked, "sim-loop", tables(found) + "\n\n" + note, {"runs": runs}, partial(draw, found))


if __name__ == "__main__":
    main()
