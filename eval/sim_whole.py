"""Whole scenarios in the closed loop, from video to metres: what `dddas run sim:NAME --seed 11` tells at its end.

usage: python eval/sim_whole.py [--scenarios NAME...] [--seed 11] [--jobs 1] [--cache FILE] [--json FILE]
       [--write README.md]

Nothing was chosen on seed 11. A minute or two a scenario. --write: the table, between the marks `sim_whole`.
"""

import argparse
import json
import tempfile
from pathlib import Path

import report
import sim_runs
from sim_runs import Case

SCENARIOS = ("joining", "splitting", "crossing", "random", "border50", "border100", "border200")
HEAD = (
    "scenario",
    "crowds found and located",
    "false blobs a frame",
    "error of a target",
    "switches a crowd and minute",
    "human or not, right",
)


def fly(case: Case) -> Case:
    """The score of one run, by name."""
    from torchvision_dddas.cli.mission import fly_into

    with tempfile.TemporaryDirectory() as out:
        _, score = fly_into(Path(out), case["scenario"], seed=case["seed"], quiet=True)
    return score.by_name()


def row(name: str, score: Case) -> tuple[str, ...]:
    """A scenario's cells."""
    right = round((score["kind_right"] or 0) * score["kinds"])
    return (
        name,
        f"{100 * score['recall']:.1f} %",
        f"{score['false_blobs']:.2f}",
        f"{score['target_error_m']['mean']:.2f} m",
        f"{score['switches'] / score['crowd_minutes']:.1f}",
        f"{right} of {score['kinds']}",
    )


def in_all(scores: list[Case]) -> str:
    """The same over all scenarios, each weighing as much as it is long."""
    crowds, frames = sum(s["crowd_frames"] for s in scores), sum(s["frames"] for s in scores)
    recall = sum(s["recall"] * s["crowd_frames"] for s in scores) / crowds
    false = sum(s["false_blobs"] * s["frames"] for s in scores) / frames
    switches = sum(s["switches"] for s in scores) / sum(s["crowd_minutes"] for s in scores)
    right = sum(round((s["kind_right"] or 0) * s["kinds"]) for s in scores)
    return (
        f"In all {100 * recall:.1f} % found and located, {false:.2f} false blobs a frame, {switches:.2f} switches a "
        f"crowd and minute, {right} of {sum(s['kinds'] for s in scores)} right."
    )


def main() -> None:
    """Run what is asked for, and tell it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", nargs="+", default=SCENARIOS)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--cache", type=Path, help="a file of finished runs, added to")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--write", type=Path)
    asked = parser.parse_args()
    cases = [{"scenario": name, "seed": asked.seed} for name in asked.scenarios]
    scores = sim_runs.run_all(cases, fly, asked.cache, asked.jobs)
    rows = [row(name, score) for name, score in zip(asked.scenarios, scores, strict=True)]
    text = f"{sim_runs.table(HEAD, rows)}\n\n{in_all(scores)}"
    print(text)
    if asked.json:
        figures = {
            "study": "sim_whole",
            "seed": asked.seed,
            "scenarios": dict(zip(asked.scenarios, scores, strict=True)),
        }
        asked.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    if asked.write:
        report.put(asked.write, "sim_whole", text)


if __name__ == "__main__":
    main()
