"""Tuning by gradient beside random search and Optuna: same knobs, clips and seconds, hard figures on held-out clips.

    python eval/tune_compare.py STUDY.toml --knobs difference.threshold,gates.min_area_px --holdout 'bms_cars6' \
        --seconds 120 --json FILE

Every way begins with the settings of the study and has the same seconds of one process, its preparations among them.
The gradient goes down the loss of soft masks; the others measure the study itself, as `dddas sweep` does, and keep
what they have computed in a cache that is thrown away. Their points lie within a factor about each knob's value.
"""

import argparse
import json
import math
import random
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.evaluation.studies import sweep as sweeping
from torchvision_dddas.evaluation.studies.search_space import Range, why_impossible
from torchvision_dddas.evaluation.studies.spec import read_spec
from torchvision_dddas.evaluation.studies.sweep import StudyMeasure
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.family import Prepared, prepare
from torchvision_dddas.tuning.parameters import TUNABLE

MOST = 100_000


def main() -> None:
    args = _arguments()
    spec = replace(read_spec(args.study), overrides=tuple(args.set or ()))
    names, holdout = args.parameters.split(","), args.holdout.split(",")
    base = args.study.parent
    with tempfile.TemporaryDirectory() as place:
        began = time.perf_counter()
        ready = prepare(spec, base, names, holdout)
        prepared_s = time.perf_counter() - began
        settings = load_config(spec.config, spec.overrides)
        rows: dict[str, Any] = {}
        judge = StudyMeasure(ready.spec, base, replace(ready.goal, by="mean"), cache=Path(place) / "judge")
        rows["as it was"] = _judged(judge, {}, ready, 0, 0.0)
        for way in ("gradient", "random", "optuna"):
            for seed in range(args.seeds):
                began = time.perf_counter()
                # A cache of its own: no way is to profit from what another has computed.
                tried = replace(judge, cache=Path(place) / f"{way}{seed}")
                if way == "gradient":
                    best, count = _gradient(spec, base, names, holdout, seed, args.seconds - prepared_s, args.rate)
                else:
                    best, count = _search(way, tried, ready, settings, args.factor, seed, args.seconds)
                spent = time.perf_counter() - began
                rows[f"{way}, seed {seed}"] = _judged(judge, best, ready, count, spent)
                print(f"{way}, seed {seed}: {rows[f'{way}, seed {seed}']}", flush=True)
    print(_table(rows, ready))
    if args.json:
        told = {"clips": ready.tuned, "held_out": ready.held, "seconds": args.seconds, "ways": rows}
        args.json.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")


def _gradient(
    spec: Any, base: Path, names: Sequence[str], holdout: Sequence[str], seed: int, seconds: float, rate: float
) -> tuple[dict[str, object], int]:
    """The parameters after so many seconds of steps. The examples' time was taken off before."""
    ready = prepare(spec, base, names, holdout)
    # Annealed over as many steps as there is time for: the first two tell how many.
    began = time.perf_counter()
    descend(ready.family, prepare_parameters(ready), ready.examples, Plan(steps=2, seed=seed, rate=rate, look_every=2))
    each = (time.perf_counter() - began) / 4  # two steps, and two looks that cost about as much
    steps = max(int((seconds - 4 * each) / (1.3 * each)), 1)
    plan = Plan(steps=steps, seed=seed, rate=rate, most_s=max(seconds - 4 * each, 0.1))
    found = descend(ready.family, ready.parameters, ready.examples, plan)
    return _values(found.settings, ready.parameters.names), found.history[-1].step


def prepare_parameters(ready: Prepared) -> Any:
    return type(ready.parameters)(ready.parameters.base, ready.parameters.names)


def _search(
    way: str, tried: StudyMeasure, ready: Prepared, settings: Settings, factor: float, seed: int, seconds: float
) -> tuple[dict[str, object], int]:
    """The best point that was measured in so many seconds; the point under way at the end still counts."""
    axes = [_axis(name, settings, factor) for name in ready.parameters.names]

    def measure(parameters: Mapping[str, object]) -> sweeping.Measured:
        return tried.measure(parameters, ready.tuned)

    least = ready.goal.minimize
    trials = (
        sweeping.search_ranges(axes, settings, measure, MOST, seed, least)
        if way == "optuna"
        else _random(axes, settings, measure, seed)
    )
    done, end = [], time.perf_counter() + seconds
    for trial in trials:
        done.append(trial)
        if time.perf_counter() >= end:
            break
    best = sweeping.best(done, least)
    return dict(best.parameters) if best else {}, len(done)


def _random(axes: Sequence[Range], settings: Settings, measure: Any, seed: int) -> Iterator[sweeping.Trial]:
    chance = random.Random(seed)
    yield sweeping.Trial(0, {}, *measure({}))
    for number in range(1, MOST):
        parameters: dict[str, object] = {}
        for axis in axes:
            value = math.exp(chance.uniform(math.log(axis.low), math.log(axis.high)))
            parameters[axis.parameter] = TUNABLE[axis.parameter].rounded(value)
        if not why_impossible(settings, parameters):
            yield sweeping.Trial(number, parameters, *measure(parameters))


def _axis(name: str, settings: Settings, factor: float) -> Range:
    tunable, value = TUNABLE[name], float(_values(settings, [name])[name])  # type: ignore[arg-type]
    value = max(value, tunable.offset, 1e-6)
    low, high = max(value / factor, tunable.low, 1e-6), min(value * factor, tunable.high)
    if tunable.rounding == "none":
        return Range(name, low, high, 0, log=True)
    step = 2 if tunable.rounding == "odd" else 1
    return Range(name, tunable.rounded(max(low, 1)), tunable.rounded(high), step, log=False)


def _judged(
    judge: StudyMeasure, parameters: Mapping[str, object], ready: Prepared, count: int, spent: float
) -> dict[str, Any]:
    with_parameters(load_config(judge.spec.config, judge.spec.overrides), parameters)
    tuned, held = (judge.measure(parameters, clips)[0] for clips in (ready.tuned, ready.held))
    return {"tuned": tuned, "held_out": held, "points": count, "seconds": spent, "knobs": dict(parameters)}


def _values(settings: Settings, names: Sequence[str]) -> dict[str, object]:
    dumped = settings.model_dump()
    return {name: dumped[name.split(".")[0]][name.split(".")[1]] for name in names}


def _table(rows: Mapping[str, Mapping[str, Any]], ready: Prepared) -> str:
    measure = ready.goal.measure
    lines = [f"| way | mean {measure}, tuned on | mean {measure}, held out | points or steps | s |", "|" + " --- |" * 5]
    for name, row in rows.items():
        figures = f"{row['tuned']:.3f} | {row['held_out']:.3f} | {row['points']} | {row['seconds']:.0f}"
        lines.append(f"| {name} | {figures} |")
    return "\n".join(lines)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path, help="the TOML of a study")
    parser.add_argument("--knobs", required=True, help="names with commas between")
    parser.add_argument("--holdout", required=True, help="patterns of clips that nothing is learned from")
    parser.add_argument("--seconds", type=float, default=120, help="that each way has")
    parser.add_argument("--seeds", type=int, default=1, help="times that each way is tried")
    parser.add_argument("--factor", type=float, default=4, help="how far the searches look from each knob's value")
    parser.add_argument("--rate", type=float, default=0.1, help="of the gradient's steps")
    parser.add_argument("--set", action="append", metavar="KNOB=VALUE", help="where all of them begin")
    parser.add_argument("--json", type=Path)
    return parser.parse_args()


if __name__ == "__main__":
    main()
