"""What the registration is worth to the tracker: `python eval/camera_motion.py DATA [--write eval/README.md]`.

DATA holds, at any depth, sequences (gt/gt.txt in MOTChallenge text beside a video) and clips (frames/ with masks/ or
boxes_xywh.txt). Prints two tables in Markdown, the same every time; without any of these only the demo's scenes.

1. True boxes of each sequence, every fifth frame, as a simulated camera that swings sees them. The tracker is told the
   whole motion, what it does to the middle of the picture, or nothing. In the last column nobody tells: the pictures
   are filmed by the same camera, and `dddas track` registers them. Appearance is off, so that nothing else can help.
2. The project's own detections on the clips and the demo's scenes. They are the same in all columns, and found with
   the registration: only the tracker is told less.
"""

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import report
from footage import film_of, sequences, truth_of
from simulated_camera import CAMERAS, Filmed, flight, seen, translation
from synthetic import LEAST_PX, SIZE, render

from torchvision_dddas.config import load_config
from torchvision_dddas.detection import detect_motion, load_engine
from torchvision_dddas.evaluation.metrics import tracking
from torchvision_dddas.evaluation.metrics import truth as truths
from torchvision_dddas.evaluation.metrics.matching import LEAST, TrackTable, pair
from torchvision_dddas.evaluation.metrics.tracking import ONE_TARGET_LEAST
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.tracking import FrameTracker, track_clip, track_scenes
from torchvision_dddas.types import DetectionTable, Frame, Scene, TrackedFrame, Tracks

Step = np.ndarray | None
Told = Callable[[Step, tuple[int, int]], Step]

INTERVAL = 5
TOLD: dict[str, Told] = {
    "all": lambda step, size: step,
    "translation": lambda step, size: None if step is None else translation(step, size),
    "nothing": lambda step, size: None,
}
_SEEDS = range(4)  # scenes of the demo
_NO_LOOKS = load_config(overrides=["track.appearance=never"])


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--write", type=Path, help="a text file with the camera-motion marks, such as eval/README.md")
    options = parser.parse_args()
    text = "\n".join([*of_sequences(options.folder), "", *of_clips(options.folder)])
    print(text)
    if options.write:
        report.put(options.write, "camera-motion", text)


# -- true boxes under a simulated camera -----------------------------------------------------------------------------


def of_sequences(folder: Path) -> list[str]:
    """The table of the sequences."""
    rows = [
        f"True boxes at an interval of {INTERVAL}, no appearance: switches / IDF1 in %. Told:",
        "",
        "| sequence | camera, at most in a frame | all | translation | nothing | what it measures itself |",
        "| --- | --- | ---: | ---: | ---: | ---: |",
    ]
    for place in sequences(folder):
        truth, video = truth_of(place).tracks, film_of(place)
        if truth is None or video is None:
            continue
        size = open_source(str(video)).size
        for name, camera in CAMERAS.items():
            maps = flight(int(truth.frame.max()), size, camera)
            table = _detections(seen(truth, maps))
            runs: list[Iterable[TrackedFrame]] = [_told(table, maps, told, size) for told in TOLD.values()]
            runs.append(_measured(table, Filmed(video, maps)))
            cells = [_switches_and_idf1(seen(truth, maps).every(INTERVAL), _table(run)) for run in runs]
            rows.append(f"| {place.name} | {name} | {' | '.join(cells)} |")
            print(rows[-1], file=sys.stderr, flush=True)
    return rows


def _told(table: DetectionTable, maps: np.ndarray, told: Told, size: tuple[int, int]) -> Iterator[TrackedFrame]:
    follower = FrameTracker(_NO_LOOKS, INTERVAL, size)
    for number in range(1, table.last + 1, INTERVAL):
        step = maps[number - 1] @ np.linalg.inv(maps[number - 1 - INTERVAL]) if number > 1 else None
        yield from follower.update(TrackedFrame(number, None, table.at(number), Tracks(number), told(step, size)))
    yield from follower.flush()


def _measured(table: DetectionTable, source: Filmed) -> Iterator[TrackedFrame]:
    return track_clip(source, table, load_engine("onboard", _NO_LOOKS), _NO_LOOKS, INTERVAL)


def _detections(truth: TrackTable) -> DetectionTable:
    order = np.argsort(truth.frame, kind="stable")
    rows = len(order)
    return DetectionTable("truth", truth.frame[order], truth.box_px[order], np.ones(rows), np.arange(rows) + 1)


def _switches_and_idf1(truth: TrackTable, found: TrackTable) -> str:
    both = pair(truth, found)
    idf1 = tracking.identity_measures(tracking.count_identity(both))["idf1"]
    return f"{tracking.count_clear(both, LEAST).switches} / {100 * idf1:.1f}"


# -- own detections --------------------------------------------------------------------------------------------------


def of_clips(folder: Path) -> list[str]:
    """The table of the project's own detections."""
    rows = [
        "Own detections: switches, labelled boxes under their target's main identity (IoU ≥ 0.3), identities. Told:",
        "",
        "| clip | interval | labelled boxes | all | translation | nothing |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name, found, truth, size in _clips(folder):
        for interval in (1, 5):
            labelled = truth.every(interval)
            cells = [_own(found, labelled, told, interval, size) for told in TOLD.values()]
            rows.append(f"| {name} | {interval} | {len(labelled.frame)} | {' | '.join(cells)} |")
            print(rows[-1], file=sys.stderr, flush=True)
    return rows


def _own(found: list[Scene], truth: TrackTable, told: Told, interval: int, size: tuple[int, int]) -> str:
    tracks = _table(track_scenes((_less(scene, told, size) for scene in found), load_config(), interval, size))
    # Elsewhere nothing is labelled, so that nothing there is wrong.
    both = pair(truth, tracks.at(np.isin(tracks.frame, truth.frame)))
    switches = tracking.count_clear(both, ONE_TARGET_LEAST).switches
    right = tracking.count_identity(both, ONE_TARGET_LEAST).idtp / max(len(truth.frame), 1)
    return f"{switches}, {100 * right:.0f} %, {len(np.unique(tracks.identity))}"


def _less(scene: Scene, told: Told, size: tuple[int, int]) -> Scene:
    """A scene with what the tracker is told of its step."""
    if scene.step is None:
        return scene
    step = told(scene.step.later_from_earlier, size)
    return replace(scene, step=None if step is None else replace(scene.step, later_from_earlier=step))


def _clips(folder: Path) -> Iterator[tuple[str, list[Scene], TrackTable, tuple[int, int]]]:
    settings = load_config()
    for place in sorted(path.parent for path in folder.rglob("frames") if path.is_dir()):
        if truths.find(place) is not None:
            truth, source = truths.load(place), open_source(str(place / "frames"))
            labels = truth.tracks or _boxes({n: truths.read_mask(path) for n, path in truth.masks.items()})
            yield place.name, list(detect_motion(source, settings, "onboard")), labels, source.size
    for seed in _SEEDS:
        clip = render(seed)
        frames = [Frame(number, (number - 1) / 10, image) for number, image in enumerate(clip.images, 1)]
        found = list(detect_motion(frames, settings, "onboard"))
        yield f"demo, scene {seed}", found, _boxes(dict(enumerate(clip.masks, 1))), SIZE


def _boxes(masks: dict[int, np.ndarray]) -> TrackTable:
    """The boxes of a clip's labelled masks, each value an identity."""
    rows = []
    for number, mask in sorted(masks.items()):
        for value in np.unique(mask[mask > 0]):
            y, x = np.nonzero(mask == value)
            if len(x) >= LEAST_PX:
                rows.append((number, value, x.min(), y.min(), np.ptp(x) + 1, np.ptp(y) + 1))
    table = np.array(rows, float).reshape(-1, 6)
    return TrackTable(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:])


def _table(followed: Iterable[TrackedFrame]) -> TrackTable:
    tracks = [f.tracks for f in followed]
    frame = np.repeat([t.frame for t in tracks], [len(t) for t in tracks])
    return TrackTable(
        frame, np.concatenate([t.identity for t in tracks]), np.concatenate([t.box_px for t in tracks]).reshape(-1, 4)
    )


if __name__ == "__main__":
    main()
