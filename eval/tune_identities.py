"""Does tuning the tracker by the likelihood of true links on some sequences help on others? Leave-one-sequence-out.

    python eval/tune_identities.py DATA [--detections] [--interval 5] [--phases 0,2,4] [--pull 0.1] [--json FILE]
        [--search random,optuna] [--only NAME,...] [--skip NAME,...]

DATA: a folder of sequences, as the kinds `motchallenge`, `cvml` and `sdd` of a study have them. Each sequence is
followed by the tracker as it runs (hard decisions, K = 3), with the shipped knobs and with those tuned on all other
sequences: on its true boxes without identities, or with --detections on its public ones. Boxes alone, no pictures: what
is tuned is what is compared. --phases: a sequence is measured from each of these frames on, 0 being the first, and
learned from as --learned says; the mean of its phases is its figure. Sequences that the shipped parameters leave
nothing to gain on (IDF1 of 99.5 % or more) share one fold: they are held out together.

--search: for each fold as many seconds as the descent took, examples among them, go to a search for the best mean IDF1
of the sequences that are not held out, by the same parameters within a factor of 3 of the shipped ones.
"""

import argparse
import itertools
import json
import math
import random
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
import draws
import report
from sequences import identified, idf1

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.evaluation.studies import sweep
from torchvision_dddas.evaluation.studies.search_space import Range
from torchvision_dddas.evaluation.studies.spec import Task
from torchvision_dddas.tuning import tracking
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.parameters import TUNABLE, Parameters
from torchvision_dddas.tuning.tracking import Identities

KNOBS = (
    "track.speed",
    "track.agility",
    "track.tail",
    "track.upright",
    "track.rest_drift",
    "track.rest_price",
    "track.missed",
    "track.births",
    "track.border",
    "track.left",
)
"""Not prior, scatter and size_scatter, the gate: what closes it to false alarms breaks tracks of other sequences."""
PERFECT = 0.995
FACTOR = 3.0


@dataclass(frozen=True)
class Sequences:
    """What is measured: clips by name and phase."""

    clips: Mapping[str, Mapping[int, Clip]]
    task: Task
    interval: int

    def idf1(self, name: str, settings: Settings, phases: Sequence[int]) -> float:
        """The mean of a sequence's phases, hard decisions."""
        clips = [self.clips[name][phase] for phase in phases]
        return float(np.mean([idf1(clip, self.task, settings, self.interval) for clip in clips]))


def main() -> None:
    """Print a table, and write it as JSON."""
    given = _arguments()
    torch.set_num_threads(1)
    tracking.LOOKS = given.looks
    phases, learned = ([int(phase) for phase in text.split(",")] for text in (given.phases, given.learned))
    skipped = given.skip.split(",")
    with tempfile.TemporaryDirectory() as place:
        task: Task = "tracking" if given.detections else "association"
        clips = {
            clip.name: {phase: shifted(replace(clip, pictures=()), phase, Path(place)) for phase in {*phases, *learned}}
            for clip in identified(given.data, ("motchallenge", "cvml", "sdd"))
            if clip.name not in skipped and (clip.given is not None or not given.detections)
        }
        _compare(Sequences(clips, task, given.interval), phases, learned, given)


def _compare(sequences: Sequences, phases: Sequence[int], learned: Sequence[int], given: argparse.Namespace) -> None:
    shipped = {name: sequences.idf1(name, Settings(), phases) for name in sequences.clips}
    family = Identities().at(given.interval, sequences.task)
    for name in ("missed", "wrong", "softness"):
        value = getattr(given, name)
        if value is not None:
            family = replace(family, **{name: (value, value) if name == "softness" else value})
    began = time.perf_counter()
    examples = {
        name: family.examples([clips[phase] for phase in learned], Settings())
        for name, clips in sequences.clips.items()
    }
    prepared_s = time.perf_counter() - began
    easy = tuple(name for name, value in shipped.items() if value >= PERFECT)
    folds = [(name,) for name in sequences.clips if name not in easy] + [easy] * bool(easy)
    parameters, rows = given.parameters.split(","), list[dict[str, Any]]()
    for held in folds:
        if given.only and not set(held) & set(given.only.split(",")):
            continue
        others = [name for name in sequences.clips if name not in held]
        start = time.perf_counter()
        mine = [example for name in others for example in examples[name]]
        plan = Plan(given.steps, given.batch, given.rate, given.seed, look_every=8, pull=given.pull)
        done = descend(family, Parameters(Settings(), parameters), mine, plan)
        seconds = time.perf_counter() - start + prepared_s
        ways: dict[str, dict[str, Any]] = {
            "gradient": {name: getattr(done.settings.track, name.split(".")[1]) for name in parameters}
        }
        points = {"gradient": done.best}
        for way in filter(None, given.search.split(",")):
            ways[way], points[way] = _searched(way, sequences, others, learned, parameters, seconds, given.seed)
        for name in held:
            values = {
                way: sequences.idf1(name, with_parameters(Settings(), found), phases) for way, found in ways.items()
            }
            rows.append({"sequence": name, "shipped": shipped[name], **values, "knobs": ways, "s": seconds})
            told = "  ".join(f"{way} {100 * v:5.1f} {100 * (v - shipped[name]):+5.1f}" for way, v in values.items())
            print(f"{name:24} shipped {100 * shipped[name]:5.1f}  {told}")
        print(f"  {seconds:.0f} s, steps or points {points}: {ways['gradient']}", flush=True)
    text = "\n".join(table(rows, list(ways)))
    print(text)
    if given.json:
        given.json.write_text(json.dumps({"asked": vars(given), "rows": rows}, indent=1, default=str) + "\n")
    if given.write is not None:
        report.put(given.write, "tune_identities", text)


def table(rows: Sequence[Mapping[str, Any]], ways: Sequence[str]) -> list[str]:
    """As Markdown: IDF1 in percent of each sequence held out, and the mean gain of each way."""
    names = ["shipped", *ways]
    lines = [f"| sequence | {' | '.join(names)} |", "| --- |" + " ---: |" * len(names)]
    lines += [f"| {row['sequence']} | " + " | ".join(f"{100 * row[name]:.1f}" for name in names) + " |" for row in rows]
    told = [draws.told([100 * (row[way] - row["shipped"]) for row in rows]) for way in ways]
    return [*lines, "| mean gain, and 95 % of draws of the sequences | | " + " | ".join(told) + " |"]


def _searched(
    way: str,
    sequences: Sequences,
    names: Sequence[str],
    phases: Sequence[int],
    parameters: Sequence[str],
    seconds: float,
    seed: int,
) -> tuple[dict[str, Any], int]:
    """The best point of a search in so many seconds, and how many there were; the one under way at the end counts."""

    def measure(found: Mapping[str, object]) -> tuple[float, str]:
        settings = with_parameters(Settings(), found)
        return float(np.mean([sequences.idf1(name, settings, phases) for name in names])), ""

    axes, many = [_axis(name) for name in parameters], 100_000
    trials = (
        sweep.proposed(axes, Settings(), measure, many, seed, least=False)
        if way == "optuna"
        else _random(axes, measure, seed)
    )
    done, end = list[sweep.Trial](), time.perf_counter() + seconds
    for trial in trials:
        done.append(trial)
        if time.perf_counter() >= end:
            break
    best = sweep.best(done, least=False)
    return dict(best.parameters) if best is not None else {}, len(done)


def _random(axes: Sequence[Range], measure: Any, seed: int) -> Iterator[sweep.Trial]:
    chance = random.Random(seed)
    yield sweep.Trial(0, {}, *measure({}))
    for number in itertools.count(1):
        point = {axis.parameter: math.exp(chance.uniform(math.log(axis.low), math.log(axis.high))) for axis in axes}
        parameters = {name: TUNABLE[name].rounded(value) for name, value in point.items()}
        yield sweep.Trial(number, parameters, *measure(parameters))


def _axis(name: str) -> Range:
    value, tunable = float(getattr(Settings().track, name.split(".")[1])), TUNABLE[name]
    return Range(name, max(value / FACTOR, tunable.low), min(value * FACTOR, tunable.high), 0, log=True)


def shifted(clip: Clip, phase: int, place: Path) -> Clip:
    """The clip without its first frames. place: a folder for what is left of its detections."""
    if not phase:
        return clip
    assert clip.truth is not None and clip.truth.tracks is not None
    truth = replace(
        clip.truth,
        boxes={frame - phase: boxes for frame, boxes in clip.truth.boxes.items() if frame > phase},
        tracks=_later(clip.truth.tracks, phase),
        **{
            name: table and _later(table, phase)
            for name in ("ignored", "others", "regions")
            for table in [getattr(clip.truth, name)]
        },
        length=max(clip.truth.length - phase, 0),
        positions=None,
    )
    found = clip.given
    if found is not None:
        lines = [line.partition(",") for line in found.read_text().splitlines() if line.strip()]
        found = place / f"{clip.name}-{phase}.txt"
        found.write_text("".join(f"{int(f) - phase},{rest}\n" for f, _, rest in lines if int(f) > phase))
    return replace(clip, truth=truth, given=found, frames=max(clip.frames - phase, 0))


def _later(table: TrackTable, phase: int) -> TrackTable:
    kept = table.at(table.frame > phase)
    return kept._replace(frame=kept.frame - phase)


def _arguments() -> argparse.Namespace:
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("data", type=Path)
    ask.add_argument("--detections", action="store_true", help="follow public detections, not true boxes")
    ask.add_argument("--interval", type=int, default=5)
    ask.add_argument("--phases", default="0", help="frames that are left out before what is measured")
    ask.add_argument("--learned", default="0", help="the same of what is learned from, and searched on")
    ask.add_argument("--steps", type=int, default=24)
    ask.add_argument("--batch", type=int, default=4)
    ask.add_argument("--rate", type=float, default=0.2)
    ask.add_argument("--pull", type=float, default=0.1, help="to the shipped parameters; see Plan")
    ask.add_argument("--missed", type=float, help="margin of a true link that lacks; the family's by default")
    ask.add_argument("--wrong", type=float, help="margin of a wrong link; the family's by default")
    ask.add_argument("--softness", type=float, help="of the assignment; the family's by default")
    ask.add_argument("--seed", type=int, default=0)
    ask.add_argument("--knobs", default=",".join(KNOBS))
    ask.add_argument("--search", default="", help="of random,optuna: searches to set beside it, at equal time")
    ask.add_argument("--only", default="", help="names of the sequences to hold out, all by default")
    ask.add_argument("--skip", default="", help="names of sequences to leave out altogether")
    ask.add_argument("--looks", type=int, default=12, help="of a stretch that is learned from")
    ask.add_argument("--json", type=Path)
    ask.add_argument("--write", type=Path, help="a text with marks for the table")
    return ask.parse_args()


if __name__ == "__main__":
    main()
