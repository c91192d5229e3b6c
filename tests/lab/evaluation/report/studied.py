"""A small study whose clips, results and faults are known, for its report."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from tests.lab.evaluation.studies.scored_clips import found_of, png
from torchvision_dddas.config import Settings
from torchvision_dddas.lab.evaluation.datasets.record import Clip, DatasetSource
from torchvision_dddas.lab.evaluation.metrics.truth import ClipTruth, TrackTable, TruePositions
from torchvision_dddas.lab.evaluation.studies.records import Case, Findings, Results, Spec, Task
from torchvision_dddas.lab.evaluation.studies.scoring import score

SIZE = (160, 120)
FRAMES = 6
HOSTILE = 'a <b>bold</b> & "quoted" clip'


def found(frame, box_px, identity=None, masks=None, east_north_m=None) -> Findings:
    """A result by its boxes."""
    names = np.full(len(frame), -1) if identity is None else identity
    rows = np.c_[np.array(frame), names, np.reshape(box_px, (-1, 4)), np.linspace(0.9, 0.3, len(frame))]
    result = found_of(rows, FRAMES, masks)
    places = result.east_north_m if east_north_m is None else east_north_m
    covariance, seconds = np.tile(np.eye(2), (len(frame), 1, 1)), {"register": 0.5, "foreground": 1.0}
    return replace(result, east_north_m=places, covariance_m2=covariance, seconds=seconds, peak_mb=101.0)


def scored(clip: Clip, task: Task, result: Findings) -> Case:
    return Case(clip, task, result, score(clip, task, result))


def masked_clip(folder: Path, name: str, off: int) -> Case:
    """A square moves; what is found lies `off` pixels to its right."""
    place = folder / name
    files = {part: {k: place / part / f"{k:05d}.png" for k in range(1, FRAMES + 1)} for part in ("frames", "masks")}
    masks = {}
    for part in files:
        (place / part).mkdir(parents=True)
    for k in range(1, FRAMES + 1):
        square = np.s_[40:60, 10 * k : 10 * k + 20]
        image = np.random.default_rng(k).integers(60, 120, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
        label = np.zeros(SIZE[::-1], np.uint8)
        image[square], label[square] = 230, 1
        cv2.imwrite(str(files["frames"][k]), image)
        cv2.imwrite(str(files["masks"][k]), label)
        masks[k] = png(np.roll(label, off * k, axis=1) * 255)
    boxes = [[(10 + off) * k, 40, 20, 20] for k in range(1, FRAMES + 1)]
    truth = ClipTruth("masks", place / "masks", files["masks"], {})
    clip = Clip(name, place, tuple(files["frames"].values()), 10.0, FRAMES, truth)
    return scored(clip, "motion", found(range(1, FRAMES + 1), boxes, masks=masks))


def boxed_truth(place: Path) -> ClipTruth:
    """Two targets side by side, one of which goes to the right, and where they are on the ground."""
    frame = np.repeat(np.arange(1, FRAMES + 1), 2)
    identity = np.tile([1, 2], FRAMES)
    side_px = np.full(len(frame), 20.0)
    box_px = np.stack([np.where(identity == 1, 10.0 * frame, 100.0), 20.0 + 50 * (identity == 2), side_px, side_px], 1)
    places = np.stack([frame * 1.0, identity * 5.0], axis=1)
    by_frame = {int(k): box_px[frame == k] for k in np.unique(frame)}
    table, positions = TrackTable(frame, identity, box_px), TruePositions(frame, identity, places)
    return ClipTruth("boxes", place, {}, by_frame, table, None, FRAMES, positions=positions)


def tracked_clip(folder: Path, task: Task, name: str) -> Case:
    """No pictures; from frame 4 on the first target is called 9, and the second is lost in frame 5."""
    truth = boxed_truth(folder)
    assert truth.tracks is not None and truth.positions is not None
    frame, identity, box_px = truth.tracks
    called = np.where((identity == 1) & (frame >= 4), 9, identity)
    kept = ~((frame == 5) & (identity == 2))
    places = truth.positions.east_north_m + 0.5
    clip = Clip(name, folder, (), 10.0, FRAMES, truth)
    return scored(clip, task, found(frame[kept], box_px[kept] + 1, called[kept], None, places[kept]))


def study(folder: Path) -> Results:
    """Masks found well and badly, tracks, people, places; a clip that failed; names that are not to be trusted."""
    cases = (
        masked_clip(folder, "good", 0),
        masked_clip(folder, "bad", 4),
        tracked_clip(folder, "tracking", "crossing"),
        tracked_clip(folder, "people", HOSTILE),
        tracked_clip(folder, "location", "ground"),
        Case(Clip("broken", folder), "motion", cause="its <masks> are 3x3, the result 4x4"),
    )
    spec = Spec("small <study>", (DatasetSource("folder", folder, ("*",)),))
    facts = {"backend": "onboard", "datasets": [{"kind": "folder", "folder": folder, "terms": "free", "clips": 6}]}
    return Results(spec, Settings(), cases, ("lost: it has no truth",), facts)
