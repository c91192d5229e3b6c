"""Does tuning the tracker by the likelihood of true links on some sequences help on others? Leave-one-sequence-out.

    python eval/tune_identities.py DATA [--interval 5] [--steps 40] [--json FILE] [--looks 25] [--only NAME,...]

DATA: a folder of sequences, as the kinds `motchallenge`, `cvml` and `sdd` of a study have them. Each sequence is
followed by the tracker as it runs (hard decisions, K = 3) on its true boxes without identities, with the shipped knobs
and with those tuned on all other sequences. Boxes alone, no pictures: what is tuned is what is compared. Sequences that
the shipped knobs leave nothing to gain on (IDF1 of 99.5 % or more) share one fold: they are held out together.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from torchvision_dddas.datasets.kinds import read
from torchvision_dddas.datasets.record import Clip
from torchvision_dddas.modules.tunable import Knobs
from torchvision_dddas.settings import Settings
from torchvision_dddas.studies.record import Source
from torchvision_dddas.studies.scoring import score
from torchvision_dddas.studies.stages import find
from torchvision_dddas.studies.summary import measures
from torchvision_dddas.tuning import identities
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.identities import Identities

KNOBS = (
    "track.speed",
    "track.agility",
    "track.scatter",
    "track.size_scatter",
    "track.births",
    "track.prior",
    "track.tail",
    "track.upright",
    "track.rest_drift",
    "track.rest_price",
    "track.missed",
    "track.border",
    "track.left",
)
PERFECT = 0.995


def main() -> None:
    """Print a table, and write it as JSON."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("data", type=Path)
    ask.add_argument("--interval", type=int, default=5)
    ask.add_argument("--steps", type=int, default=40)
    ask.add_argument("--batch", type=int, default=6)
    ask.add_argument("--rate", type=float, default=0.2)
    ask.add_argument("--seed", type=int, default=0)
    ask.add_argument("--knobs", default=",".join(KNOBS))
    ask.add_argument("--only", default="", help="names of the sequences to hold out, all by default")
    ask.add_argument("--looks", type=int, default=identities.LOOKS, help="of a stretch that is learned from")
    ask.add_argument("--json", type=Path)
    given = ask.parse_args()
    torch.set_num_threads(1)
    identities.LOOKS = given.looks
    clips = {clip.name: clip for clip in _clips(given.data)}
    shipped = {name: _idf1(clip, Settings(), given.interval) for name, clip in clips.items()}
    family = Identities(interval=given.interval)
    examples = {name: family.examples([clip], Settings()) for name, clip in clips.items()}
    easy = tuple(name for name, value in shipped.items() if value >= PERFECT)
    folds = [(name,) for name in clips if name not in easy] + [easy] * bool(easy)
    rows = []
    for held in folds:
        if given.only and not set(held) & set(given.only.split(",")):
            continue
        start = time.perf_counter()
        learned = [example for name in clips if name not in held for example in examples[name]]
        plan = Plan(given.steps, given.batch, given.rate, given.seed, look_every=10)
        done = descend(family, Knobs(Settings(), given.knobs.split(",")), learned, plan)
        seconds = time.perf_counter() - start
        values = {name: getattr(done.settings.track, name.split(".")[1]) for name in done.knobs.names}
        for name in held:
            tuned = _idf1(clips[name], done.settings, given.interval)
            rows.append({"sequence": name, "shipped": shipped[name], "tuned": tuned, "knobs": values, "s": seconds})
            print(f"{name:24} {100 * shipped[name]:6.1f} {100 * tuned:6.1f} {100 * (tuned - shipped[name]):+6.1f}")
        print(f"  step {done.best}, {seconds:.0f} s: {values}", flush=True)
    gain = np.array([100 * (row["tuned"] - row["shipped"]) for row in rows])
    drawn = np.random.default_rng(0).choice(gain, (10_000, len(gain))).mean(axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    print(f"mean gain {gain.mean():+.2f} points of IDF1, 95 % of draws of the sequences {low:+.2f} to {high:+.2f}")
    if given.json:
        given.json.write_text(json.dumps({"interval": given.interval, "rows": rows}, indent=1) + "\n")


def _clips(data: Path) -> list[Clip]:
    """The sequences with true identities of several targets, without their pictures."""
    found = {}
    for kind in ("motchallenge", "cvml", "sdd"):
        for clip in read(Source(kind, data), data).clips:
            if clip.truth is not None and clip.truth.tracks is not None:
                found.setdefault(clip.name, replace(clip, pictures=()))
    return list(found.values())


def _idf1(clip: Clip, settings: Settings, interval: int) -> float:
    found = find(clip, "association", settings, "onboard", interval)
    return float(measures([score(clip, "association", found, interval)])["tracks"]["idf1"])


if __name__ == "__main__":
    main()
