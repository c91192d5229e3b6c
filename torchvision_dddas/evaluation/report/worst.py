"""The frames of a study that went worst: which, in words, and as pictures with truth and result side by side."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics import truth as truths
from torchvision_dddas.evaluation.metrics.boxes import iou
from torchvision_dddas.evaluation.metrics.ignored_regions import counted
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.evaluation.report.pictures import Boxes, Pair, box_pair, mask_pair, matched
from torchvision_dddas.evaluation.report.tallies import Tally, main_group, tally
from torchvision_dddas.evaluation.studies.results import Case, Found
from torchvision_dddas.io.images import IMAGE_SUFFIXES, decode_image, read_image
from torchvision_dddas.io.report import format_number
from torchvision_dddas.io.sources import open_source

MOST = 8
"""Pictures of a task that the page shows."""
_OF_A_CLIP = 3


@dataclass(frozen=True)
class Worst:
    """A frame. wrong: how much of it. words: what went wrong. pair: None where it cannot be shown, and why: trouble."""

    case: Case
    frame: int
    wrong: float
    words: str
    pair: Pair | None = None
    trouble: str = ""


def worst_frames(cases: Sequence[Case], most: int = MOST) -> tuple[list[Worst], int]:
    """The frames that went worst, of many clips rather than of one, and in how many others something is wrong too."""
    by_rank: list[list[Worst]] = [[] for _ in range(_OF_A_CLIP)]
    total = 0
    for case in cases:
        chosen, wrong = _of_case(case)
        total += wrong
        for rank, one in enumerate(chosen):
            by_rank[rank].append(one)
    ordered = [one for rank in by_rank for one in sorted(rank, key=lambda w: -w.wrong)]
    shown = ordered[:most]
    return shown, total - len(shown)


def drawn(chosen: Sequence[Worst]) -> list[Worst]:
    """The same with their pictures; the pictures of a clip are read once, in order."""
    pairs: dict[int, Worst] = {}
    for name in dict.fromkeys(id(one.case) for one in chosen):
        mine = sorted((one for one in chosen if id(one.case) == name), key=lambda one: one.frame)
        case = mine[0].case
        try:
            pictures = dict(_pictures(case, [one.frame for one in mine]))
            for one in mine:
                pairs[id(one)] = _with_pair(one, pictures.get(one.frame))
        except (InputError, OSError) as error:
            for one in mine:
                pairs[id(one)] = Worst(one.case, one.frame, one.wrong, one.words, None, str(error))
    return [pairs[id(one)] for one in chosen]


def _of_case(case: Case) -> tuple[list[Worst], int]:
    """The worst frames of a clip, some way from each other, and in how many frames anything is wrong."""
    scored = case.scored
    group = main_group(scored) if scored is not None else None
    if scored is None or group is None or case.found is None or not len(scored.frames):
        return [], 0
    counts = tally(scored, group)
    errors = counts.false + counts.missed + counts.switched
    # Pixels as a share of the picture, so that large pictures are not the worst of all.
    whole = counts.right + errors + counts.rest if counts.unit == "pixels" else np.ones(len(errors))
    wrong = np.divide(errors, whole, out=np.zeros(len(errors)), where=whole > 0)
    chosen: list[Worst] = []
    apart = max(1.0, (scored.frames[-1] - scored.frames[0]) / 10)
    for k in np.argsort(-wrong, kind="stable").tolist():
        frame = int(scored.frames[k])
        if wrong[k] <= 0 or len(chosen) == _OF_A_CLIP:
            break
        if all(abs(frame - one.frame) >= apart for one in chosen):
            chosen.append(Worst(case, frame, float(wrong[k]), _said(counts, k)))
    return chosen, int((wrong > 0).sum())


def _said(counts: Tally, k: int) -> str:
    right, false, missed, switched = (float(x[k]) for x in counts[:4])
    named = ((right, "right"), (false, "false"), (missed, "missed"))
    found = f"{counts.unit}: " + ", ".join(f"{format_number(int(n))} {what}" for n, what in named)
    whole = 2 * right + false + missed
    score = f"{counts.measure} {format_number(2 * right / whole, 2)}; " if whole and counts.measure != "hit" else ""
    return f"{score}{found}" + (f"; {format_number(int(switched))} changed identity" if switched else "")


def _pictures(case: Case, frames: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
    files = case.clip.pictures
    if not files:
        return
    if len(files) == 1 and files[0].suffix.lower() not in IMAGE_SUFFIXES:
        wanted = set(frames)
        for read in open_source(files[0]):
            if read.number in wanted:
                yield read.number, read.image
            if read.number >= max(wanted):
                return
        return
    for frame in frames:
        if 1 <= frame <= len(files) and (picture := read_image(files[frame - 1])) is not None:
            yield frame, _in_8_bits(picture)


def _in_8_bits(picture: np.ndarray) -> np.ndarray:
    if picture.dtype == np.uint8:
        return picture
    return cv2.convertScaleAbs(picture, alpha=255.0 / max(int(picture.max()), 1))


def _with_pair(one: Worst, picture: np.ndarray | None) -> Worst:
    case, found, truth = one.case, one.case.found, one.case.clip.truth
    if found is None:
        return one
    if truth is not None and one.frame in truth.masks and one.frame in found.masks:
        mask = decode_image(found.masks[one.frame], cv2.IMREAD_UNCHANGED)
        labels = truths.labels_of(truth, one.frame)
        if mask is None or mask.shape[:2] != labels.shape:
            raise InputError("the result's mask cannot be read")
        mask = mask if mask.ndim == 2 else mask.max(axis=2)
        shown = np.full((*labels.shape, 3), 70, np.uint8) if picture is None else picture
        return Worst(case, one.frame, one.wrong, one.words, mask_pair(shown, labels, mask))
    boxes = boxes_at(case, one.frame)
    size = (picture.shape[1], picture.shape[0]) if picture is not None else _extent(case)
    return Worst(case, one.frame, one.wrong, one.words, box_pair(picture, size, boxes))


def boxes_at(case: Case, frame: int) -> Boxes:
    """The boxes of a frame, with identities where the task is about them, and which of these changed since last seen.

    In a still clip all are false; where one target is labelled, of the others nobody knows.
    """
    found, truth = case.found, case.clip.truth
    assert found is not None
    rows = np.flatnonzero(found.frame == frame)
    found_px, nobody = found.box_px[rows], np.zeros((0, 4))
    if truth is None:
        none = np.zeros(len(rows), bool)
        return Boxes(nobody, found_px, np.full(len(rows), -1), [], [""] * len(rows), none, ~none)
    table = truth.tracks if case.task in ("tracking", "association") else None
    true_px, true_id = _true(table, truth.boxes, frame)
    of_found = matched(found_px, true_px, iou(true_px, found_px), 0.3 if truth.kind == "one target" else 0.5)
    marked, names = np.zeros(len(rows), bool), [""] * len(rows)
    if table is not None:
        names = [str(i) if i >= 0 else "" for i in found.identity[rows].tolist()]
        for k, i in enumerate(of_found.tolist()):
            before = _last_identity(found, table, int(true_id[i]), frame) if i >= 0 else None
            if before is not None and before != found.identity[rows[k]]:
                marked[k] = True
                names[k] = f"{before}>{found.identity[rows[k]]}"
    true_names = [""] * len(true_px) if table is None else [str(i) for i in true_id.tolist()]
    if truth.kind == "one target":
        judged = of_found >= 0
    else:
        judged = (of_found >= 0) | counted(truth, found.frame[rows], found_px)
    return Boxes(true_px, found_px, of_found, true_names, names, marked, judged)


def _true(table: TrackTable | None, boxes: Mapping[int, np.ndarray], frame: int) -> tuple[np.ndarray, np.ndarray]:
    if table is not None:
        mine = table.frame == frame
        return table.box_px[mine], table.identity[mine]
    known = boxes.get(frame, np.zeros((0, 4)))
    known = known[~np.isnan(known).any(axis=1)]
    return known, np.full(len(known), -1)


def _last_identity(found: Found, table: TrackTable, identity: int, frame: int) -> int | None:
    """What a target was last found as before a frame, None if it was not yet."""
    mine = (table.identity == identity) & (table.frame < frame)
    for row in np.flatnonzero(mine)[np.argsort(-table.frame[mine], kind="stable")].tolist():
        there = np.flatnonzero(found.frame == table.frame[row])
        overlap = iou(table.box_px[row][None], found.box_px[there])[0]
        if len(there) and overlap.max() >= 0.5:
            return int(found.identity[there[int(np.argmax(overlap))]])
    return None


def _extent(case: Case) -> tuple[int, int]:
    """Width and height that hold all the boxes of a clip without pictures."""
    assert case.found is not None
    all_px = [case.found.box_px, *(case.clip.truth.boxes.values() if case.clip.truth is not None else ())]
    corners = np.concatenate([boxes[:, :2] + boxes[:, 2:] for boxes in all_px])
    far = np.nan_to_num(np.nanmax(corners, axis=0, initial=1), nan=1.0)
    return int(np.clip(far[0] + 8, 64, 20_000)), int(np.clip(far[1] + 8, 64, 20_000))
