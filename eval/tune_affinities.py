"""Does tuning the source's association on some sequences raise IDF1 on others? Beside random search of equal time.

    python eval/tune_affinities.py DATA [--interval 5] [--rule dispersion] [--folds 3] [--steps 20] [--json FILE]

DATA: a folder of sequences, as the kinds `motchallenge` and `cvml` of a study have them; pictures are used where they
are there. Windows of two frames. Each fold is held out in turn (0 folds: each sequence alone). Random search measures
the hard tracker's mean IDF1 on the other sequences for as many seconds as the gradient took, examples among them.
"""

import argparse
import json
import random
import sys
import time
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
import draws
from sequences import identified, idf1

from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.parameters import TUNABLE, Parameters
from torchvision_dddas.tuning.source_association import Affinities

KNOBS = {
    "dispersion": ("paper.threshold", "paper.lowest_dispersion", "paper.location_cut", "paper.appearance_cut"),
    "fixed": ("paper.threshold", "paper.weight"),
}


def main() -> None:
    """Print a table, and write it as JSON."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("data", type=Path)
    ask.add_argument("--interval", type=int, default=5)
    ask.add_argument("--rule", choices=tuple(KNOBS), default="dispersion")
    ask.add_argument("--folds", type=int, default=3)
    ask.add_argument("--steps", type=int, default=20)
    ask.add_argument("--rate", type=float, default=0.4)
    ask.add_argument("--seed", type=int, default=0)
    ask.add_argument("--only", default="", help="names of the sequences, all by default")
    ask.add_argument("--json", type=Path)
    given = ask.parse_args()
    torch.set_num_threads(1)
    shipped = with_parameters(load_config("paper"), {"paper.window": 2, "paper.rule": given.rule})
    clips = {
        clip.name: clip
        for clip in identified(given.data, ("motchallenge", "cvml"))
        if not given.only or clip.name in given.only.split(",")
    }
    family, names, examples, took = Affinities(interval=given.interval), KNOBS[given.rule], {}, {}
    for name, clip in clips.items():
        began = time.perf_counter()
        examples[name] = family.examples([clip], shipped)
        took[name] = time.perf_counter() - began
    folds = given.folds or len(clips)
    rows = []
    for fold in (list(clips)[first::folds] for first in range(folds)):
        learned = [name for name in clips if name not in fold]
        began = time.perf_counter()
        plan = Plan(given.steps, 8, given.rate, given.seed, look_every=5, most_watched=16)
        done = descend(family, Parameters(shipped, names), [one for name in learned for one in examples[name]], plan)
        seconds = time.perf_counter() - began + sum(took[name] for name in learned)
        found = _searched([clips[name] for name in learned], shipped, names, given.interval, seconds, given.seed)
        parameters = {name: getattr(done.settings.paper, name.split(".")[1]) for name in names}
        print(f"step {done.best}, {seconds:.0f} s: {parameters}", flush=True)
        for name in fold:
            values = [
                idf1(clips[name], "association", each, given.interval) for each in (shipped, done.settings, found)
            ]
            rows.append({"sequence": name, **dict(zip(("shipped", "tuned", "random"), values, strict=True))})
            print(f"{name:24}" + "".join(f"{100 * value:7.1f}" for value in values), flush=True)
    for way in ("tuned", "random"):
        gains = [100 * (row[way] - row["shipped"]) for row in rows]
        print(f"{way}: mean gain in points of IDF1, and 95 % of draws of the sequences: {draws.told(gains)}")
    if given.json:
        given.json.write_text(json.dumps({**vars(given), "data": "", "json": "", "rows": rows}, indent=1) + "\n")


def _searched(
    clips: list[Clip], shipped: Settings, names: tuple[str, ...], interval: int, seconds: float, seed: int
) -> Settings:
    """The best of random points, evenly in the knobs' ranges, that were measured in so many seconds; shipped first."""
    chance, best, most, end = random.Random(seed), shipped, -1.0, time.perf_counter() + seconds
    settings = shipped
    while True:
        mean = float(np.mean([idf1(clip, "association", settings, interval) for clip in clips]))
        if mean > most:
            best, most = settings, mean
        if time.perf_counter() >= end:
            return best
        drawn = {name: TUNABLE[name].rounded(chance.uniform(TUNABLE[name].low, TUNABLE[name].high)) for name in names}
        settings = with_parameters(shipped, drawn)


if __name__ == "__main__":
    main()
