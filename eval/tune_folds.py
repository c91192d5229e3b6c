"""Does tuning what moves on some clips help on others? Each clip left out in turn; hard figures on the one left out.

    python eval/tune_folds.py STUDY.toml [--config fast] --knobs difference.threshold,difference.gradient_share

Every clip with masks is held out once; clips in which nothing moves are learned from in every fold, and told how many
of their frames are alarmed. Of clips with many labelled frames about `--frames` are learned from, evenly spaced; judged
is every labelled frame. A last fold holds nothing out: its parameters are what would be shipped.
"""

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).parent))
import report

from torchvision_dddas.config import Settings, load_config
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.runner import plan_study, run_study
from torchvision_dddas.evaluation.studies.spec import Spec, read_spec
from torchvision_dddas.evaluation.studies.summary import measures
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.motion import Masks
from torchvision_dddas.tuning.parameters import Parameters, chosen

MEAN = "mean"


def main() -> None:
    """Print a table, and write it as JSON."""
    given = _arguments()
    torch.set_num_threads(1)
    spec = replace(read_spec(given.study), overrides=tuple(given.set or ()), tasks=("motion",))
    spec = replace(spec, config=given.config) if given.config else spec
    settings, names = load_config(spec.config, spec.overrides), chosen(given.parameters.split(","))
    judged = Judge(spec, given.study.parent, given.jobs)
    clips = {job.clip.name: job.clip for job in plan_study(spec, given.study.parent, []).jobs}
    learned = {name: Masks().examples([thinned(clip, given.frames)], settings) for name, clip in clips.items()}
    before, alarmed = judged.f({})
    rows: list[dict[str, Any]] = [{"held_out": "", "knobs": _values(settings, names), "f": before, "alarmed": alarmed}]
    for held in [*before, None]:
        began = time.perf_counter()
        examples = [example for name, mine in learned.items() if name != held for example in mine]
        how = Plan(given.steps, given.batch, given.rate, given.seed, watched=given.watched, pull=given.pull)
        found = descend(Masks(), Parameters(settings, names), examples, how)
        spent, parameters = time.perf_counter() - began, _values(found.settings, names)
        after, alarmed = judged.f(parameters)
        row = {"held_out": held, "knobs": parameters, "f": after, "alarmed": alarmed, "step": found.best, "s": spent}
        rows.append(row)
        print(_line(held or "none", before, after, alarmed, parameters), flush=True)
    text = "\n".join(table(rows))
    print(text)
    if given.json:
        told = {"study": spec.name, "asked": {key: str(value) for key, value in vars(given).items()}, "rows": rows}
        given.json.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    if given.write is not None:
        report.put(given.write, f"tune_folds_{Path(given.config or 'default').stem}", text)


class Judge:
    """The whole pipeline with hard operations, as `dddas evaluate --dataset` runs it."""

    def __init__(self, spec: Spec, base: Path, jobs: int | None) -> None:
        self._spec, self._base, self._jobs = spec, base, jobs

    def f(self, parameters: Mapping[str, object]) -> tuple[dict[str, float], float]:
        """F of each clip with masks, and the share of frames with an alarm where nothing moves."""
        changed = tuple(f"{name}={value}" for name, value in parameters.items())
        spec = replace(self._spec, overrides=(*self._spec.overrides, *changed))
        found, alarmed, frames = {}, 0.0, 0.0
        for case in run_study(spec, self._base, self._workers).cases:
            if case.scored is None:
                raise SystemExit(f"{case.clip.name}: {case.cause}")
            told = measures([case.scored])
            if "pixels" in told:
                found[case.clip.name] = float(told["pixels"]["f"])
            if "still" in told:
                alarmed, frames = alarmed + told["still"]["n_alarmed"], frames + told["still"]["n_frames"]
        return found, alarmed / frames if frames else float("nan")


def thinned(clip: Clip, frames: int) -> Clip:
    """The clip with about so many of its labelled frames."""
    if clip.truth is None or len(clip.truth.masks) <= frames:
        return clip
    kept = sorted(clip.truth.masks)[:: len(clip.truth.masks) // frames]
    return replace(clip, truth=replace(clip.truth, masks={number: clip.truth.masks[number] for number in kept}))


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """As Markdown: of each clip F as shipped, tuned on the others, tuned on all."""
    before, everywhere = rows[0]["f"], rows[-1]["f"]
    held = {row["held_out"]: row["f"][row["held_out"]] for row in rows[1:-1]}
    lines = ["| clip | as it was | tuned on the others | tuned on all |", "| --- | ---: | ---: | ---: |"]
    lines += [f"| {name} | {before[name]:.3f} | {held[name]:.3f} | {everywhere[name]:.3f} |" for name in before]
    means = " | ".join(f"{sum(part.values()) / len(part):.3f}" for part in (before, held, everywhere))
    return [*lines, f"| {MEAN} | {means} |"]


def _line(held: str, before: Mapping[str, float], after: Mapping[str, float], alarmed: float, parameters: Any) -> str:
    gain = f", F {before[held]:.4f} to {after[held]:.4f}" if held in before else ""
    others = [after[name] - before[name] for name in before if name != held]
    told = ", ".join(f"{name} {value:g}" for name, value in parameters.items())
    return f"held out {held}{gain}; the others {sum(others) / len(others):+.4f}; alarmed {alarmed:.2f}; {told}"


def _values(settings: Settings, names: Sequence[str]) -> dict[str, Any]:
    dumped = settings.model_dump()
    return {name: dumped[name.split(".")[0]][name.split(".")[1]] for name in names}


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path, help="the TOML of a study of clips with masks")
    parser.add_argument("--knobs", required=True, help="names with commas between")
    parser.add_argument("--config", help="where all begin, in place of the study's")
    parser.add_argument("--set", action="append", metavar="KNOB=VALUE")
    parser.add_argument("--frames", type=int, default=12, help="labelled ones of a clip that are learned from, about")
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--rate", type=float, default=0.05)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--watched", type=float, default=0.0, help="share of each clip that is not learned from")
    parser.add_argument("--pull", type=float, default=0.0)
    parser.add_argument("--jobs", type=int)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--write", type=Path, help="a text with marks for the table")
    return parser.parse_args()


if __name__ == "__main__":
    main()
