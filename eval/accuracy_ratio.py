"""The source's accuracy ratio of whole tracks, over all windows: `python eval/accuracy_ratio.py DATA [--interval 5]`.

DATA holds sequences: folders with gt/gt.txt (MOTChallenge text) and a video. Their true boxes, without identities, are
followed by the default tracker along the clip, by the same without the clip, and by `--config paper` with windows of
two and three frames. An interval of D has D phases: looks at 1, 1 + D, ..., at 2, 2 + D, ... Each is followed for
itself, and AR_2 and AR_3 (appendix C, eq. 11) are means over the windows of all of them; identity switches and IDF1
(in percent, matched at an IoU of 0.9) are given as the mean over the phases and the worst. Looked at: the percentage of
pictures whose targets were compared. Prints Markdown.
"""

import argparse
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import report
from footage import film_of, sequences, truth_of

from torchvision_dddas.config import Settings, load_config
from torchvision_dddas.detection import load_engine
from torchvision_dddas.evaluation.metrics import accuracy_ratio as windows
from torchvision_dddas.evaluation.metrics import tracking
from torchvision_dddas.evaluation.metrics.accuracy_ratio import Windows
from torchvision_dddas.evaluation.metrics.matching import TrackTable, pair
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.tracking import CameraMotion, FrameTracker
from torchvision_dddas.types import Detections, TrackedFrame, Tracks

SAME = 0.9
PAPER = ["track.mode=paper"]
TRACKERS: dict[str, tuple[bool, list[str]]] = {
    "default, with the clip": (True, []),
    "default, boxes alone": (False, []),
    "default, with the clip, always looking": (True, ["track.appearance=always"]),
    "default, with the clip, deciding at once": (True, ["track.look_ahead=false"]),
    "paper, K = 2": (True, [*PAPER, "paper.window=2"]),
    "paper, K = 2, weight 0.7": (True, [*PAPER, "paper.window=2", "paper.rule=fixed"]),
    "paper, K = 3": (True, PAPER),
    "paper, K = 3, weight 0.7": (True, [*PAPER, "paper.rule=fixed"]),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--interval", type=int, default=5)
    parser.add_argument("--only", default="", help="trackers whose name begins with this")
    parser.add_argument("--write", type=Path, help="a text file with the accuracy_ratio marks, such as README.md")
    options = parser.parse_args()
    filmed = [(place, film) for place in sequences(options.data) if (film := film_of(place))]
    if not filmed:
        sys.exit(f"{options.data} holds no sequences with gt/gt.txt and a video; nothing was measured")
    lines = [
        f"| interval {options.interval} | tracker | windows of 3 | AR_2 | AR_3 | switches | IDF1 | looked at |",
        "| --- | --- " + "| ---: " * 6 + "|",
    ]
    for place, clip in filmed:
        for name, (pictures, overrides) in TRACKERS.items():
            if name.startswith(options.only):
                found = measured(place, clip if pictures else None, options.interval, load_config(overrides=overrides))
                lines.append(f"| {place.name} | {name} | {found} |")
                print(lines[-1], file=sys.stderr, flush=True)
    print("\n".join(lines))
    if options.write:
        report.put(options.write, "accuracy_ratio", "\n".join(lines))


def measured(place: Path, clip: Path | None, interval: int, settings: Settings) -> str:
    """The cells of a row."""
    truth = truth_of(place).tracks
    assert truth is not None
    links, switches, idf1 = [Windows(), Windows()], [], []
    tracks, looked = followed(truth, clip, interval, settings)
    for phase, found in enumerate(tracks):
        both = pair(truth.at((truth.frame - 1) % interval == phase), found)
        links = [known.plus(windows.count(both, interval, size)) for known, size in zip(links, (2, 3), strict=True)]
        switches.append(tracking.count_clear(both, SAME).switches)
        idf1.append(100 * tracking.identity_measures(tracking.count_identity(both, SAME))["idf1"])
    ratios = " | ".join(f"{100 * known.mean:.2f}" for known in links)
    spread = f"{np.mean(switches):.1f} ({max(switches)}) | {np.mean(idf1):.1f} ({min(idf1):.1f})"
    return f"{links[1].windows} | {ratios} | {spread} | {100 * looked:.0f}"


def followed(truth: TrackTable, clip: Path | None, interval: int, settings: Settings) -> tuple[list[TrackTable], float]:
    """The tracks of each phase, all fed in one run through the clip, and the share of frames that were looked at."""
    # Rows in another order in each frame, so that order tells nothing.
    order = np.random.default_rng(7).permutation(len(truth.frame))
    truth = truth.at(order[np.argsort(truth.frame[order], kind="stable")])
    last, source = int(truth.frame.max()), open_source(str(clip)) if clip else None
    size = source.size if source else tuple((truth.box_px[:, :2] + truth.box_px[:, 2:]).max(axis=0).tolist())
    engine = load_engine("onboard", settings) if source else None
    followers = [FrameTracker(settings, interval, size) for _ in range(interval)]
    cameras = [CameraMotion(engine) for _ in range(interval)] if engine else []
    looked = 0

    def counted(look: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Callable:
        def likeness(image: np.ndarray, box_px: np.ndarray) -> np.ndarray:
            nonlocal looked
            looked += 1
            return look(image, box_px)

        return likeness

    for follower in followers:
        follower.likeness = counted(follower.likeness)
    settled: list[list[Tracks]] = [[] for _ in range(interval)]
    for frame in source or range(1, last + 1):
        number = frame if isinstance(frame, int) else frame.number
        if number > last:
            break
        phase = (number - 1) % interval
        picture = None if isinstance(frame, int) else frame
        step = cameras[phase].step(picture.image)[0] if picture else None
        given = TrackedFrame(number, picture, boxes(truth, number), Tracks(number), step)
        settled[phase] += [f.tracks for f in followers[phase].update(given)]
    for phase, follower in enumerate(followers):
        settled[phase] += [f.tracks for f in follower.flush()]
    return [table(tracks) for tracks in settled], looked / last


def boxes(truth: TrackTable, frame: int) -> Detections:
    """The true boxes of a frame, each certain."""
    box_px = truth.box_px[slice(*np.searchsorted(truth.frame, [frame, frame + 1]))]
    unknown = np.full(len(box_px), np.nan)
    return Detections(box_px, np.ones(len(box_px)), box_px[:, 2] * box_px[:, 3], unknown, unknown, kind="given")


def table(frames: Iterable[Tracks]) -> TrackTable:
    frames = list(frames)
    number = np.concatenate([np.full(len(t), t.frame) for t in frames])
    return TrackTable(number, np.concatenate([t.identity for t in frames]), np.concatenate([t.box_px for t in frames]))


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main()
