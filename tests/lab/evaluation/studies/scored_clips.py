"""Clips with truth and results of many kinds, drawn by a seed: in memory, and as the files that commands write."""

import json
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.metrics import truth as truths
from torchvision_dddas.lab.evaluation.studies.records import Case, Findings, Results, Scored, Spec, Task

SIZE = (60, 80)


def walk(seed, frames=30, people=4, miss=0.15):
    """Rows of true boxes, (N, 6) frame, identity, x, y, w, h, and of found ones with a score in the last column."""
    world, rng = (np.random.default_rng([seed, part]) for part in range(2))
    true, found = [], []
    for who in range(1, people + 1):
        place, speed = world.uniform((0, 0), (50, 30), 2), world.normal(0, 0.6, 2)
        for frame in range(1, frames + 1):
            place = place + speed
            true.append([frame, who, *place.round(2), 14, 22])
            if rng.random() > miss:
                name = who if rng.random() > 0.05 else who + 50
                loose = [*(place + rng.normal(0, 1.5, 2)), 14 + rng.normal(), 22 + rng.normal()]
                found.append([frame, name, *loose, rng.uniform(0.4, 1)])
    false = np.flatnonzero(rng.random(frames) < 0.3) + 1
    found += [[f, 90 + f, *rng.uniform((0, 0), (60, 40), 2), 12, 20, rng.uniform(0, 0.7)] for f in false.tolist()]
    order = np.argsort([row[0] for row in found], kind="stable")
    return np.array(true), np.array(found)[order]


def found_of(rows, frames, masks=None, identities=True) -> Findings:
    """What a stage would have found."""
    count = len(rows)
    return Findings(
        rows[:, 0].astype(np.int64),
        rows[:, 2:6],
        rows[:, 6],
        rows[:, 1].astype(np.int64) if identities else np.full(count, -1),
        np.full((count, 2), np.nan),
        np.full((count, 2, 2), np.nan),
        np.arange(1, frames + 1),
        masks or {},
        seconds={"find": 0.5},
        peak_mb=100.0,
    )


def blobs(boxes) -> np.ndarray:
    """A mask of boxes, each of its own number."""
    mask = np.zeros(SIZE, np.uint8)
    for number, (x, y, w, h) in enumerate(np.round(boxes).astype(int).tolist(), 1):
        cv2.rectangle(mask, (x, y), (x + w - 1, y + h - 1), number, -1)
    return mask


def png(mask) -> bytes:
    return cv2.imencode(".png", mask)[1].tobytes()


def masked(folder: Path, seed=0, frames=12):
    """A clip whose truth is masks of every second frame."""
    true, rows = walk(seed, frames)
    (folder / "masks").mkdir(parents=True)
    for frame in range(1, frames + 1, 2):
        (folder / "masks" / f"{frame:06d}.png").write_bytes(png(blobs(true[true[:, 0] == frame, 2:6])))
    masks = {f: png(blobs(rows[rows[:, 0] == f, 2:6])) for f in range(1, frames + 1)}
    return Clip(folder.name, folder, truth=truths.load_truth(folder)), found_of(rows, frames, masks, identities=False)


def targeted(folder: Path, seed=0, frames=12):
    """A clip with one labelled target, which is gone in a frame."""
    true, rows = walk(seed, frames)
    folder.mkdir(parents=True)
    mine = [",".join(map(str, row[2:6])) for row in true[true[:, 1] == 1].tolist()]
    mine[4] = "nan,nan,nan,nan"
    (folder / "boxes_xywh.txt").write_text("\n".join(mine) + "\n")
    masks = {f: png(blobs(rows[rows[:, 0] == f, 2:6])) for f in range(1, frames + 1)}
    return Clip(folder.name, folder, truth=truths.load_truth(folder)), found_of(rows, frames, masks)


def tracked(folder: Path, seed=0, frames=30):
    """A clip with true tracks, some of which do not count, and an end without anybody."""
    true, rows = walk(seed, frames)
    (folder / "gt").mkdir(parents=True)
    lines = [
        f"{f:.0f},{who:.0f},{x},{y},{w},{h},{int(who != 4 or f > 9)},-1,-1,-1\n" for f, who, x, y, w, h in true.tolist()
    ]
    (folder / "gt" / "gt.txt").write_text("".join(lines))
    (folder / "seqinfo.ini").write_text(f"[Sequence]\nseqLength={frames + 3}\n")
    return Clip(folder.name, folder, truth=truths.load_truth(folder)), found_of(rows, frames + 3)


def as_files(folder: Path, found: Findings, interval=1, identities=False) -> Path:
    """What dddas detect, or dddas track, would have written of it."""
    folder.mkdir(parents=True)
    name = "tracks.txt" if identities else "detections.txt"
    lines = [
        f"{f},{who if identities else -1},{x:.2f},{y:.2f},{w:.2f},{h:.2f},{s:.6g},-1,-1,-1\n"
        for f, who, (x, y, w, h), s in zip(
            found.frame.tolist(), found.identity.tolist(), found.box_px.tolist(), found.score.tolist(), strict=True
        )
    ]
    (folder / name).write_text("".join(lines))
    frames = {"written": len(found.looked)}
    outputs = ["tables", *(["masks"] if found.masks and not identities else [])]
    record = {"state": "complete", "frames": frames, "outputs": outputs, "last_frame": int(found.looked[-1])}
    (folder / "run.json").write_text(json.dumps(record | {"interval_frames": interval}))
    if not identities:
        (folder / "masks").mkdir()
        for frame, mask in found.masks.items():
            (folder / "masks" / f"{frame:06d}.png").write_bytes(mask)
    return folder


def study_of(*cases: tuple[Clip, Task, Findings | None, Scored | None, str], name="study") -> Results:
    """A study that was run."""
    return Results(Spec(name, ()), Settings(), tuple(Case(*case) for case in cases))
