"""What the search in regions saves and loses: `python eval/people_regions.py DATA [--frames N] [--set KNOB=VALUE]`.

DATA holds PETS09-S2L1 and TUD-Stadtmitte: gt/gt.txt (MOTChallenge text) beside a video. The same frames, from the first
on, are searched everywhere; in regions (`people.search = regions`); around what moves alone (`--around` of dddas people
with the table of dddas detect, here the same detections in memory); and in both. Recall is that of detections with a
probability of at least 0.5, at an IoU of 0.5, in percent of the true boxes and of what is found everywhere; time is the
median over frames of a frame's ratio to the whole search, all four taken in turn frame by frame. Prints Markdown.
"""

import argparse
import sys
from collections.abc import Iterator
from itertools import islice, tee
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import report
from footage import film_of, truth_of
from people_curves import CLIPS, matched

from torchvision_dddas.cli.progress import progress
from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.people.detector import WindowScorer, detect_in_clip, load_scorer
from torchvision_dddas.types import DetectionTable, Frame, PeopleFrame

LIKELY = 0.5
MODES = {
    "everywhere": ("everywhere", False),
    "regions": ("regions", False),
    "around what moves": ("everywhere", True),
    "regions, and around what moves": ("regions", True),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--frames", type=int, default=200, help="of each clip, from the first on")
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--set", action="append", default=[], metavar="KNOB=VALUE", help="for all four")
    parser.add_argument("--write", type=Path, help="a text file with the people-regions marks, such as eval/README.md")
    options = parser.parse_args()
    places = [options.data / name for name in CLIPS if (options.data / name / "gt/gt.txt").is_file()]
    if not places:
        sys.exit(f"{options.data} holds neither {' nor '.join(CLIPS)}; nothing was measured")
    settings = load_config(overrides=options.set)
    engine = load_scorer(settings.people, options.backend)
    rows = [
        "| clip | searched | recall % | of everywhere % | false boxes a frame | windows % | time |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for place in places:
        rows += of_clip(place, settings, engine, options.frames)
    text = "\n".join(rows)
    print(text)
    if options.write:
        report.put(options.write, "people-regions", text)


def of_clip(place: Path, settings: Settings, engine: WindowScorer, count: int) -> list[str]:
    """The rows of a clip."""
    tracks, video = truth_of(place).tracks, str(film_of(place))
    assert tracks is not None
    rate_hz = open_source(video).rate_hz
    moving = movers(islice(iter(open_source(video)), count), settings, rate_hz)
    clips = tee(islice(iter(open_source(video)), count), len(MODES))
    runs = [
        detect_in_clip(
            clip, engine, with_parameters(settings, {"people.search": search}), moving if around else None, batch=1
        )
        for clip, (search, around) in zip(clips, MODES.values(), strict=True)
    ]
    hits, false, share = np.zeros(len(MODES)), np.zeros(len(MODES)), np.zeros(len(MODES))
    people, times = 0, []
    with progress(place.name, count, quiet=False) as tick:
        for made in zip(*runs, strict=True):
            true_px = tracks.box_px[tracks.frame == made[0].frame.number] - (1, 1, 0, 0)
            people += len(true_px)
            for i, one in enumerate(made):
                right = hit(one, true_px)
                hits[i] += right.sum()
                false[i] += (~right).sum()
                share[i] += one.share
            spent = [sum(one.seconds.get(stage, 0.0) for stage in ("plan", "score", "people")) for one in made]
            times.append([seconds / spent[0] for seconds in spent])
            tick()
    looked, ratio = len(times), np.median(times, axis=0)
    return [
        f"| {place.name}, {looked} frames | {name} | {100 * hits[i] / people:.1f} | {100 * hits[i] / hits[0]:.1f} "
        f"| {false[i] / looked:.2f} | {100 * share[i] / looked:.1f} | {ratio[i]:.2f} |"
        for i, name in enumerate(MODES)
    ]


def hit(recognized: PeopleFrame, true_px: np.ndarray) -> np.ndarray:
    """Which of the likely people are true."""
    likely = recognized.people.score >= LIKELY
    return matched((recognized.people.box_px[likely], recognized.people.score[likely]), true_px) >= 0


def movers(frames: Iterator[Frame], settings: Settings, rate_hz: float) -> DetectionTable:
    """What `dddas detect` finds, as a table."""
    found = [
        (scene.frame.number, *box)
        for scene in detect_motion(frames, settings, "onboard", rate_hz)
        for box in scene.detections.box_px
    ]
    rows = np.array(found, float).reshape(-1, 5)
    every = np.arange(1, len(rows) + 1)
    return DetectionTable("movers", rows[:, 0].astype(np.int64), rows[:, 1:], np.ones(len(rows)), every, own=True)


if __name__ == "__main__":
    main()
