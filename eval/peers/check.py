"""Are our tracking measures TrackEval's? `python eval/peers/check.py [DATA]`, run by `make peers`.

Sets results of many kinds against the truth of made-up walkers, and of the sequences under DATA (folders with
gt/gt.txt and det/det.txt in MOTChallenge 2015 text), and compares every figure of every sequence and of all together
with what TrackEval gives in its own environment: once as `dddas evaluate TRUTH RESULT` reads the files, and once as a
study of whole data sets scores what it holds. Prints a table; ends with 1 if any figure differs by more than 1e-6.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from jobs import PYTHON, Table, check_environments, run_peer

from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.evaluate import evaluate
from torchvision_dddas.lab.evaluation.metrics import truth as true_boxes
from torchvision_dddas.lab.evaluation.studies.records import Findings, round_as_written
from torchvision_dddas.lab.evaluation.studies.scoring import score
from torchvision_dddas.lab.evaluation.studies.summary import measures

HERE = Path(__file__).resolve().parent
MOST = 1e-6
DISTRACTOR = 8

Tables = dict[str, np.ndarray]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?")
    parser.add_argument("--json", type=Path, help="write TrackEval's figures of the made-up walkers here")
    options = parser.parse_args()
    check_environments()
    worst = 0.0
    print("| sequences | rows marked 0 | every | result | figures | largest difference |")
    print("| --- | --- | ---: | --- | ---: | ---: |")
    for label, truths, boxes in sets(options.data):
        found = {name: results(truth) for name, truth in truths.items()}
        for name, table in sort(truths, boxes).items():
            found[name]["SORT"] = table
        for ignoring, interval in (("dropped", 1), ("removed", 1), ("dropped", 5)):
            with tempfile.TemporaryDirectory() as folder:
                theirs, ours, studied = both(Path(folder), truths, found, ignoring, interval)
            for result, clips in theirs.items():
                gaps = differences(clips, ours[result]) + differences(clips, studied[result])
                worst = max([worst, *gaps])
                print(f"| {label} | {ignoring} | {interval} | {result} | {len(gaps)} | {max(gaps):.1e} |")
            if options.json and label == "made up" and ignoring == "dropped" and interval == 1:
                options.json.write_text(json.dumps(theirs, indent=1) + "\n")
    print(f"\nlargest difference of all: {worst:.1e}")
    sys.exit(int(worst > MOST))


def sets(data: Path | None) -> Iterator[tuple[str, Tables, Tables]]:
    """Truths by sequence, (N, 10) each, and the boxes that SORT gets."""
    made = {f"walkers-{seed}": walkers(seed) for seed in range(3)}
    yield "made up", made, {name: results(truth)["loose, missed"] for name, truth in made.items()}
    if data is None:
        return
    names = sorted(f.parents[1].name for f in data.glob("*/gt/gt.txt") if (f.parents[1] / "det/det.txt").is_file())
    if not names:
        print(f"{data} holds no SEQUENCE/gt/gt.txt with det/det.txt: checked on made-up walkers alone", file=sys.stderr)
        return
    real, boxes = (
        {name: np.loadtxt(data / name / file, delimiter=",") for name in names} for file in ("gt/gt.txt", "det/det.txt")
    )
    yield f"{len(names)} real", real, boxes


def sort(truths: Tables, boxes: Tables) -> Tables:
    """What SORT at its defaults makes of boxes."""
    given = {name: table[table[:, 0] <= truths[name][:, 0].max()] for name, table in boxes.items()}
    tables = []
    with tempfile.TemporaryDirectory() as folder:
        for name, table in given.items():
            write(file := Path(folder, f"{name}-boxes.txt"), table)
            tables.append(Table(file, 1, int(truths[name][:, 0].max())))
        (found,) = run_peer("SORT", [{}], tables, Path(folder))
    return {
        name: np.c_[table[:, 0], identity, table[:, 2:6], np.ones(len(table)), np.full((len(table), 3), -1)][
            identity > 0
        ]
        for (name, table), identity in zip(given.items(), found, strict=True)
    }


def walkers(seed: int, frames: int = 60, people: int = 8) -> np.ndarray:
    """(N, 10) truth of people who come, stray, hide and go; some of their rows are marked 0."""
    rng = np.random.default_rng(seed)
    rows = []
    for person in rng.permutation(3 * people)[:people]:
        place, speed, size = rng.uniform(0, 300, 2), rng.normal(0, 3, 2), rng.uniform([15, 40], [30, 90])
        begin, end = np.sort(rng.integers(1, frames + 1, 2))
        hidden = set(rng.integers(begin, end + 1, 5).tolist())
        for frame in range(begin, end + 1):
            place, speed = place + speed, speed + rng.normal(0, 0.5, 2)
            if frame not in hidden:
                rows.append([frame, person, *place.round(2), *size.round(2), float(rng.random() > 0.1), -1, -1, -1])
    return np.array(rows)


def results(truth: np.ndarray, seed: int = 0) -> Tables:
    """Results of many kinds, (M, 10) each."""
    rng = np.random.default_rng(seed)
    n, counted = len(truth), truth[truth[:, 6] != 0]
    loose, hurried, random = truth.copy(), truth.copy(), truth.copy()
    loose[:, 2:6] += rng.normal(0, 0.06, (n, 4)) * truth[:, [5]]
    loose[:, 4:6] = np.maximum(loose[:, 4:6], 1)
    loose[:, 1] = np.where(rng.random(n) < 0.03, 5000 + np.arange(n), loose[:, 1])
    for frame in np.unique(truth[:, 0]):
        here = truth[:, 0] == frame
        random[here, 1] = rng.permutation(2 * here.sum())[: here.sum()]
        if frame % 7 == 0:  # everyone swaps from here on
            names = np.unique(truth[:, 1])
            renamed = dict(zip(names, rng.permutation(names), strict=True))
            later = hurried[:, 0] >= frame
            hurried[later, 1] = [renamed[name] for name in truth[later, 1]]
    found = loose[rng.random(n) < 0.8]
    return {
        "perfect": counted,
        "every row": truth,
        "other order": truth[rng.permutation(n)],
        "swaps": hurried,
        "loose, missed": found[rng.permutation(len(found))],
        "random ids": random,
        "empty": truth[:0],
    }


def both(folder: Path, truths: Tables, found: dict[str, Tables], ignoring: str, interval: int) -> tuple[dict, ...]:
    """TrackEval's figures, those of our files, and those of our studies, by result and sequence."""
    lengths = {name: int(truth[:, 0].max()) for name, truth in truths.items()}
    for name, truth in truths.items():
        place = folder / "ours" / name / "gt.txt"
        write(place, truth)
        marked = truth.copy()
        if ignoring == "removed":  # how a benchmark that removes distractors says the same
            marked[:, 7] = np.where(truth[:, 6] == 0, DISTRACTOR, 1)
        write(folder / "gt" / name / "gt/gt.txt", thinned(marked, interval))
        for result, table in found[name].items():
            # To hundredths of a pixel, as the program writes and a study scores them.
            table = np.c_[table[:, :2], round_as_written(table[:, 2:6]), table[:, 6], np.full((len(table), 3), -1)]
            write(folder / "found" / result / f"{name}.txt", table)
            write(folder / "results" / result / "data" / f"{name}.txt", thinned(table, interval))
    (folder / "lengths.json").write_text(json.dumps({n: (f - 1) // interval + 1 for n, f in lengths.items()}))
    benchmark = "MOT17" if ignoring == "removed" else "MOT15"
    words = [PYTHON, HERE / "trackeval_figures.py", folder, folder / "theirs.json", benchmark]
    subprocess.run([str(w) for w in words], check=True)
    theirs = json.loads((folder / "theirs.json").read_text())
    ours = {}
    for result in theirs:
        report = evaluate(folder / "ours", folder / "found" / result, interval=interval, ignoring=ignoring)
        ours[result] = {name: clip["tracks"] for name, clip in report["clips"].items()}
        ours[result]["COMBINED"] = report["pooled"]["tracks"]
    return theirs, ours, {result: studied(folder, result, truths, found, ignoring, interval) for result in theirs}


def studied(folder: Path, result: str, truths: Tables, found: dict[str, Tables], ignoring: str, interval: int) -> dict:
    """The figures of a study by sequence, from tables that it holds."""
    scored = {}
    for name, truth in truths.items():
        known = replace(true_boxes.load_truth(folder / "ours" / name / "gt.txt"), ignoring=ignoring)
        table = thinned_only(found[name][result], interval)
        count = len(table)
        held = Findings(
            table[:, 0].astype(np.int64),
            table[:, 2:6],
            table[:, 6],
            table[:, 1].astype(np.int64),
            np.full((count, 2), np.nan),
            np.full((count, 2, 2), np.nan),
            np.arange(1, int(truth[:, 0].max()) + 1, interval),
        )
        scored[name] = score(Clip(name, folder, truth=known), "tracking", held, interval)
    figures = {name: measures([one])["tracks"] for name, one in scored.items()}
    return figures | {"COMBINED": measures([scored[name] for name in sorted(scored)])["tracks"]}


def thinned_only(table: np.ndarray, interval: int) -> np.ndarray:
    """Every interval-th frame, in order, with its own number."""
    kept = table[(table[:, 0] - 1) % interval == 0]
    return kept[np.argsort(kept[:, 0], kind="stable")]


def thinned(table: np.ndarray, interval: int) -> np.ndarray:
    """Every interval-th frame, renumbered from 1, as TrackEval knows no interval."""
    kept = table[(table[:, 0] - 1) % interval == 0].copy()
    kept[:, 0] = (kept[:, 0] - 1) // interval + 1
    return kept


def write(place: Path, table: np.ndarray) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(place, table, delimiter=",", fmt="%.10g")


def differences(theirs: dict, ours: dict) -> list[float]:
    return [abs(ours[clip][name] - value) for clip, by in theirs.items() for name, value in by.items()]


if __name__ == "__main__":
    main()
