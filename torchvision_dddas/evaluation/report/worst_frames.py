"""The frames of a study that went worst, as pictures with truth and result side by side."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics import truth as truths
from torchvision_dddas.evaluation.metrics.boxes import iou
from torchvision_dddas.evaluation.metrics.matching import counted
from torchvision_dddas.evaluation.metrics.truth import TrackTable
from torchvision_dddas.evaluation.report.task_charts import Tally, main_group, tally
from torchvision_dddas.evaluation.studies.results import Case, Found
from torchvision_dddas.io.images import IMAGE_SUFFIXES, decode_image, read_image
from torchvision_dddas.io.overlay import Colour, colour_picture, drawable, label
from torchvision_dddas.io.report import format_number
from torchvision_dddas.io.sources import open_source

HIT: Colour = (233, 180, 86)
FALSE: Colour = (0, 94, 213)
TRUE: Colour = (66, 228, 240)
"""Sky blue, vermilion and yellow of Okabe and Ito, in blue, green, red. True is also what was missed."""
UNSCORED: Colour = (150, 150, 150)
MAX_WIDTH, MAX_HEIGHT = 560, 420
"""Pixels of a picture on the page; a smaller one is enlarged up to three times."""
_QUALITY = 80
_SMALL, _RING = 4, 6  # px of a picture on the page


class Pair(NamedTuple):
    """Two pictures as JPEG."""

    truth: bytes
    result: bytes


class Boxes(NamedTuple):
    """The boxes of a frame: (N, 4) true and (M, 4) found in px, what stands beside each, and which are right.

    of_found: (M,) the true box that each found one is, -1 for none. marked: (M,) those with a change of identity.
    judged: (M,) those that count: where targets may be unlabelled, other boxes are neither right nor false.
    """

    true_px: np.ndarray
    found_px: np.ndarray
    of_found: np.ndarray
    true_names: list[str]
    found_names: list[str]
    marked: np.ndarray
    judged: np.ndarray


def mask_pair(picture: np.ndarray, labels: np.ndarray, found: np.ndarray) -> Pair:
    """A frame whose truth is a mask.

    picture: (h, w[, 3]) uint8 of any size. labels: (H, W), -1 where nothing counts. found: (H, W), nonzero is
    foreground.
    """
    scale = _scale(labels.shape[1], labels.shape[0])
    size = max(1, round(labels.shape[1] * scale)), max(1, round(labels.shape[0] * scale))
    base = _resized(picture, size)
    true, unscored = labels > 0, labels < 0
    found = (found > 0) & ~unscored
    left, right = base.copy(), _faint(base)
    for side in (left, right):
        _tint(side, unscored, size, UNSCORED, 0.75)
    _tint(left, true, size, TRUE, 0.3)
    _outline(left, true, size, TRUE, 2)
    for area, colour in ((true & found, HIT), (true & ~found, TRUE), (found & ~true, FALSE)):
        _tint(right, area, size, colour, 0.7)
        _outline(right, area, size, colour)
    _rings(right, true, found, size)
    return Pair(_jpeg(left), _jpeg(right))


def box_pair(picture: np.ndarray | None, size_px: tuple[int, int], boxes: Boxes) -> Pair:
    """A frame whose truth are boxes; without a picture they stand on grey. size_px: width and height of the frame."""
    scale = _scale(*size_px)
    size = max(1, round(size_px[0] * scale)), max(1, round(size_px[1] * scale))
    base = np.full((size[1], size[0], 3), 70, np.uint8) if picture is None else _resized(picture, size)
    left, right = base.copy(), _faint(base)
    for box, name in zip(boxes.true_px * scale, boxes.true_names, strict=True):
        _box(left, box, TRUE, name)
    missed = np.ones(len(boxes.true_px), bool)
    missed[boxes.of_found[boxes.of_found >= 0]] = False
    for box in boxes.true_px[missed] * scale:
        _dashed(right, box, TRUE)
    for k, box in enumerate(boxes.found_px * scale):
        hit, changed = boxes.of_found[k] >= 0, bool(boxes.marked[k])
        colour = HIT if hit else FALSE if boxes.judged[k] else UNSCORED
        _box(right, box, colour, boxes.found_names[k], 3 if changed or colour == FALSE else 2)
    return Pair(_jpeg(left), _jpeg(right))


def matched(found_px: np.ndarray, true_px: np.ndarray, overlap: np.ndarray, least: float = 0.5) -> np.ndarray:
    """(M,) the true box of each found one, -1 for none: each true box in turn takes the best left, as in the counts.

    overlap: (N, M), the IoU of true and found boxes.
    """
    of_found, left = np.full(len(found_px), -1), overlap.copy()
    for i in range(len(true_px)):
        j = int(np.argmax(left[i])) if len(found_px) else -1
        if j >= 0 and left[i, j] >= least:
            of_found[j] = i
            left[:, j] = -1
    return of_found


def _scale(width: int, height: int) -> float:
    return min(MAX_WIDTH / width, MAX_HEIGHT / height, 3.0)


def _resized(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    smaller = size[0] < picture.shape[1]
    return cv2.resize(colour_picture(picture), size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def _faint(picture: np.ndarray) -> np.ndarray:
    """Grey and darker, so that what is drawn on it stands out."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    return cv2.cvtColor((grey * 0.65 + 20).astype(np.uint8), cv2.COLOR_GRAY2BGR)


def _tint(picture: np.ndarray, area: np.ndarray, size: tuple[int, int], colour: Colour, share: float) -> None:
    part = cv2.resize(area.astype(np.float32), size, interpolation=cv2.INTER_AREA)[..., None] * share
    picture[:] = (picture * (1 - part) + np.array(colour) * part).astype(np.uint8)


def _outline(picture: np.ndarray, area: np.ndarray, size: tuple[int, int], colour: Colour, thick: int = 1) -> None:
    """Lines around areas."""
    drawn = [drawable(contour) for contour in _contours(area, size)]
    cv2.polylines(picture, drawn, True, colour, thick, cv2.LINE_AA)


def _rings(picture: np.ndarray, true: np.ndarray, found: np.ndarray, size: tuple[int, int]) -> None:
    """A ring around each single area that is too small to see in the reduced picture."""
    share = np.array([size[0] / true.shape[1], size[1] / true.shape[0]])
    for contour in _contours(true | found, size):
        low, high = contour.min(axis=(0, 1)), contour.max(axis=(0, 1))
        if (high - low).max() < _SMALL:
            x, y = (contour[0, 0] / share).astype(int).tolist()
            colour = HIT if true[y, x] and found[y, x] else TRUE if true[y, x] else FALSE
            centre = drawable((low + high) / 2).tolist()
            cv2.circle(picture, centre, _RING, (0, 0, 0), 4, cv2.LINE_AA)
            cv2.circle(picture, centre, _RING, colour, 2, cv2.LINE_AA)


def _contours(area: np.ndarray, size: tuple[int, int]) -> list[np.ndarray]:
    """(N, 1, 2) each, in pixels of the picture on the page."""
    height, width = area.shape
    contours, _ = cv2.findContours(area.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return [(contour + 0.5) * (size[0] / width, size[1] / height) for contour in contours]


def _box(picture: np.ndarray, box: np.ndarray, colour: Colour, name: str, thick: int = 2) -> None:
    x, y, right, bottom = drawable(np.array([*box[:2], *(box[:2] + box[2:])])).tolist()
    cv2.rectangle(picture, (x - 1, y - 1), (right + 1, bottom + 1), (0, 0, 0), thick)
    cv2.rectangle(picture, (x, y), (right, bottom), colour, thick)
    if name:
        label(picture, box, name, colour)


def _dashed(picture: np.ndarray, box: np.ndarray, colour: Colour) -> None:
    low, high = box[:2], box[:2] + box[2:]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]], low])
    for start, end in pairwise(corners):
        steps = min(max(int(np.abs(end - start).sum() / 6) | 1, 1), 401)
        for shade, thick in (((0, 0, 0), 4), (colour, 2)):
            for k in range(0, steps, 2):
                a, b = (drawable(start + (end - start) * t / steps) for t in (k, k + 1))
                cv2.line(picture, tuple(a.tolist()), tuple(b.tolist()), shade, thick)


def _jpeg(picture: np.ndarray) -> bytes:
    # Thin lines need their colour at each pixel.
    finest = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    how = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, finest]
    return cv2.imencode(".jpg", picture, how)[1].tobytes()


MAX_PICTURES = 8
"""Pictures of a task on the page."""
_MAX_OF_A_CLIP = 3


@dataclass(frozen=True)
class Worst:
    """A frame. wrong: how much of it. text: what went wrong. pair: None where it cannot be shown, and why: trouble."""

    case: Case
    frame: int
    wrong: float
    text: str
    pair: Pair | None = None
    trouble: str = ""


def find_worst_frames(cases: Sequence[Case], most: int = MAX_PICTURES) -> tuple[list[Worst], int]:
    """The frames with the most faults, of many clips rather than of one, and the number of other frames with faults."""
    by_rank: list[list[Worst]] = [[] for _ in range(_MAX_OF_A_CLIP)]
    total = 0
    for case in cases:
        chosen, wrong = _of_case(case)
        total += wrong
        for rank, one in enumerate(chosen):
            by_rank[rank].append(one)
    ordered = [one for rank in by_rank for one in sorted(rank, key=lambda w: -w.wrong)]
    shown = ordered[:most]
    return shown, total - len(shown)


def draw_pictures(chosen: Sequence[Worst]) -> list[Worst]:
    """The same frames with their pictures; the pictures of a clip are read once, in order."""
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
                pairs[id(one)] = Worst(one.case, one.frame, one.wrong, one.text, None, str(error))
    return [pairs[id(one)] for one in chosen]


def _of_case(case: Case) -> tuple[list[Worst], int]:
    """The worst frames of a clip, a tenth of its length apart, and the number of frames with faults."""
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
        if wrong[k] <= 0 or len(chosen) == _MAX_OF_A_CLIP:
            break
        if all(abs(frame - one.frame) >= apart for one in chosen):
            chosen.append(Worst(case, frame, float(wrong[k]), _describe(counts, k)))
    return chosen, int((wrong > 0).sum())


def _describe(counts: Tally, k: int) -> str:
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
        return Worst(case, one.frame, one.wrong, one.text, mask_pair(shown, labels, mask))
    boxes = boxes_at(case, one.frame)
    size = (picture.shape[1], picture.shape[0]) if picture is not None else _extent(case)
    return Worst(case, one.frame, one.wrong, one.text, box_pair(picture, size, boxes))


def boxes_at(case: Case, frame: int) -> Boxes:
    """The boxes of a frame, with identities where the task is about them, and which of these changed since last seen.

    In a still clip all are false; where one target is labelled, other boxes are not judged.
    """
    found, truth = case.found, case.clip.truth
    assert found is not None
    rows = np.flatnonzero(found.frame == frame)
    found_px, no_boxes = found.box_px[rows], np.zeros((0, 4))
    if truth is None:
        none = np.zeros(len(rows), bool)
        return Boxes(no_boxes, found_px, np.full(len(rows), -1), [], [""] * len(rows), none, ~none)
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
    """The identity of a target when it was last found before a frame; None if it was not."""
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
