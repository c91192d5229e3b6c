"""The worst frames of a study, as pictures with truth and result side by side."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.images import IMAGE_SUFFIXES, decode_image, read_image
from torchvision_dddas.io.overlay import Colour, colour_picture, drawable, label
from torchvision_dddas.io.report import format_number
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.lab.evaluation.metrics import truth as truths
from torchvision_dddas.lab.evaluation.metrics.boxes import iou
from torchvision_dddas.lab.evaluation.metrics.matching import counted
from torchvision_dddas.lab.evaluation.metrics.truth import TrackTable
from torchvision_dddas.lab.evaluation.report.task_charts import tally
from torchvision_dddas.lab.evaluation.studies.records import Case, Findings

MAX_PICTURES = 8
"""Largest number of pictures of a task on the page."""
MAX_WIDTH, MAX_HEIGHT = 560, 420
"""Largest size of a picture on the page, in pixels. Smaller pictures are enlarged up to three times."""
HIT: Colour = (233, 180, 86)
FALSE: Colour = (0, 94, 213)
TRUE: Colour = (66, 228, 240)
"""Sky blue, vermilion and yellow of Okabe and Ito, in blue, green, red. Missed targets have the colour of the truth."""
UNSCORED: Colour = (150, 150, 150)
_GREY = 70  # grey level that replaces a missing picture
_MAX_OF_A_CLIP = 3
_SMALL, _RING = 4, 6  # areas with shorter sides get a ring of this radius, px on the page

Size = tuple[int, int]


class Pair(NamedTuple):
    """Two pictures as JPEG."""

    truth: bytes
    result: bytes


@dataclass(frozen=True)
class Worst:
    """A frame. wrong: amount of errors. text: describes the errors. pair: None if it cannot be shown. trouble: why."""

    case: Case
    frame: int
    wrong: float
    text: str
    pair: Pair | None = None
    trouble: str = ""


def find_worst_frames(cases: Sequence[Case]) -> tuple[list[Worst], int]:
    """Return the frames with most errors, from many clips rather than one, and the number of other faulty frames."""
    by_rank: list[list[Worst]] = [[] for _ in range(_MAX_OF_A_CLIP)]
    total = 0
    for case in cases:
        chosen, n_wrong = _worst_of_case(case)
        total += n_wrong
        for rank, one in enumerate(chosen):
            by_rank[rank].append(one)
    shown = [one for rank in by_rank for one in sorted(rank, key=lambda w: -w.wrong)][:MAX_PICTURES]
    return shown, total - len(shown)


def _worst_of_case(case: Case) -> tuple[list[Worst], int]:
    """Return the worst frames of a clip, a tenth of its length apart, and the number of frames with errors."""
    scored = case.scored
    counts = tally(scored) if scored is not None else None
    if scored is None or counts is None or case.found is None or not len(scored.frames):
        return [], 0
    errors = counts.false + counts.missed + counts.switched
    # Count pixels as a share of the picture, so that large pictures do not always seem worst.
    whole = counts.right + errors + counts.rest if counts.unit == "pixels" else np.ones(len(errors))
    wrong = np.divide(errors, whole, out=np.zeros(len(errors)), where=whole > 0)
    chosen: list[Worst] = []
    apart = max(1.0, (scored.frames[-1] - scored.frames[0]) / 10)
    for k in np.argsort(-wrong, kind="stable").tolist():
        frame = int(scored.frames[k])
        if wrong[k] <= 0 or len(chosen) == _MAX_OF_A_CLIP:
            break
        if any(abs(frame - one.frame) < apart for one in chosen):
            continue
        right, false, missed, switched = (float(column[k]) for column in counts[:4])
        named = ((right, "right"), (false, "false"), (missed, "missed"))
        text = f"{counts.unit}: " + ", ".join(f"{format_number(int(n))} {what}" for n, what in named)
        if (both := 2 * right + false + missed) and counts.measure != "hit":
            text = f"{counts.measure} {format_number(2 * right / both, 2)}; {text}"
        if switched:
            text += f"; {format_number(int(switched))} changed identity"
        chosen.append(Worst(case, frame, float(wrong[k]), text))
    return chosen, int((wrong > 0).sum())


def draw_pictures(chosen: Sequence[Worst]) -> list[Worst]:
    """Return the same frames with their pictures. The pictures of a clip are read once, in order."""
    drawn: dict[int, Worst] = {}
    for case in {id(one.case): one.case for one in chosen}.values():
        of_clip = [one for one in chosen if one.case is case]
        try:
            pictures = dict(_pictures(case, sorted(one.frame for one in of_clip)))
            done = [replace(one, pair=_draw(case, one.frame, pictures.get(one.frame))) for one in of_clip]
        except (InputError, OSError) as error:
            done = [replace(one, trouble=str(error)) for one in of_clip]
        drawn |= {id(one): new for one, new in zip(of_clip, done, strict=True)}
    return [drawn[id(one)] for one in chosen]


def _pictures(case: Case, frames: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
    files = case.clip.pictures
    if len(files) == 1 and files[0].suffix.lower() not in IMAGE_SUFFIXES:
        for read in open_source(files[0]):
            if read.number in frames:
                yield read.number, read.image
            if read.number >= frames[-1]:
                return
        return
    for frame in frames:
        if 1 <= frame <= len(files) and (picture := read_image(files[frame - 1])) is not None:
            if picture.dtype != np.uint8:
                picture = cv2.convertScaleAbs(picture, alpha=255.0 / max(int(picture.max()), 1))
            yield frame, picture


def _draw(case: Case, frame: int, picture: np.ndarray | None) -> Pair:
    found, truth = case.found, case.clip.truth
    assert found is not None, "_worst_of_case() takes cases with a result"
    if truth is not None and frame in truth.masks and frame in found.masks:
        mask = decode_image(found.masks[frame], cv2.IMREAD_UNCHANGED)
        labels = truths.labels_of(truth, frame)
        if mask is None or mask.shape[:2] != labels.shape:
            raise InputError("the result's mask cannot be read")
        mask = mask if mask.ndim == 2 else mask.max(axis=2)
        return mask_pair(np.full(labels.shape, _GREY, np.uint8) if picture is None else picture, labels, mask)
    if picture is not None:
        return box_pair(picture, (picture.shape[1], picture.shape[0]), boxes_at(case, frame))
    # Without pictures, the frame size is the extent of all boxes.
    all_px = np.concatenate([found.box_px, *(truth.boxes.values() if truth is not None else ())])
    far = np.nan_to_num(np.nanmax(all_px[:, :2] + all_px[:, 2:], axis=0, initial=1), nan=1.0)
    width, height = np.clip(far + 8, 64, 20_000).astype(int).tolist()
    return box_pair(None, (width, height), boxes_at(case, frame))


def mask_pair(picture: np.ndarray, labels: np.ndarray, found: np.ndarray) -> Pair:
    """A frame whose truth is a mask.

    picture: (h, w[, 3]) uint8 of any size. labels: (H, W), -1 where pixels do not count. found: (H, W), nonzero is
    foreground.
    """
    left, right, _ = _sides(picture, (labels.shape[1], labels.shape[0]))
    true, unscored = labels > 0, labels < 0
    found = (found > 0) & ~unscored
    for side in (left, right):
        _tint(side, unscored, UNSCORED, 0.75)
    _tint(left, true, TRUE, 0.3)
    _outline(left, true, TRUE, 2)
    for area, colour in ((true & found, HIT), (true & ~found, TRUE), (found & ~true, FALSE)):
        _tint(right, area, colour, 0.7)
        _outline(right, area, colour, 1)
    # Draw a ring around each single area that is too small to see in the reduced picture.
    share = np.array([right.shape[1] / true.shape[1], right.shape[0] / true.shape[0]])
    for contour in _contours(right, true | found):
        low, high = contour.min(axis=(0, 1)), contour.max(axis=(0, 1))
        if (high - low).max() < _SMALL:
            x, y = (contour[0, 0] / share).astype(int).tolist()
            colour = HIT if true[y, x] and found[y, x] else TRUE if true[y, x] else FALSE
            centre = drawable((low + high) / 2).tolist()
            cv2.circle(right, centre, _RING, (0, 0, 0), 4, cv2.LINE_AA)
            cv2.circle(right, centre, _RING, colour, 2, cv2.LINE_AA)
    return Pair(_jpeg(left), _jpeg(right))


class FrameBoxes(NamedTuple):
    """The boxes of a frame, px: (N, 4) true and (M, 4) found, with the names beside them.

    of_found: (M,) the true box of each found box, -1 for none. marked: (M,) boxes with a change of identity. judged:
    (M,) boxes that count: if targets may be unlabelled, other boxes are neither right nor false.
    """

    true_px: np.ndarray
    found_px: np.ndarray
    of_found: np.ndarray
    true_names: list[str]
    found_names: list[str]
    marked: np.ndarray
    judged: np.ndarray


def box_pair(picture: np.ndarray | None, size_px: Size, boxes: FrameBoxes) -> Pair:
    """Draw true and found boxes side by side, on grey without a picture. size_px: width and height of the frame."""
    left, right, scale = _sides(np.full((1, 1), _GREY, np.uint8) if picture is None else picture, size_px)
    for box, name in zip(boxes.true_px * scale, boxes.true_names, strict=True):
        _box(left, box, TRUE, name)
    missed = ~np.isin(np.arange(len(boxes.true_px)), boxes.of_found)
    for box in boxes.true_px[missed] * scale:
        _dashed(right, box, TRUE)
    for k, box in enumerate(boxes.found_px * scale):
        colour = HIT if boxes.of_found[k] >= 0 else FALSE if boxes.judged[k] else UNSCORED
        _box(right, box, colour, boxes.found_names[k], 3 if boxes.marked[k] or colour == FALSE else 2)
    return Pair(_jpeg(left), _jpeg(right))


def boxes_at(case: Case, frame: int) -> FrameBoxes:
    """Return the boxes of a frame, with identities if the task is about them, and which identities have changed.

    In a still clip all boxes are false. If one target is labelled, other boxes are not judged.
    """
    found, truth = case.found, case.clip.truth
    assert found is not None
    rows = np.flatnonzero(found.frame == frame)
    found_px, marked, names = found.box_px[rows], np.zeros(len(rows), bool), [""] * len(rows)
    if truth is None:
        return FrameBoxes(np.zeros((0, 4)), found_px, np.full(len(rows), -1), [], names, marked, ~marked)
    table = truth.tracks if case.task in ("tracking", "association") else None
    if table is None:
        true_px = truth.boxes.get(frame, np.zeros((0, 4)))
        true_px = true_px[~np.isnan(true_px).any(axis=1)]
        true_names = [""] * len(true_px)
    else:
        true_px, true_id = table.box_px[table.frame == frame], table.identity[table.frame == frame].tolist()
        true_names = [str(identity) for identity in true_id]
    is_one = truth.kind == "one target"
    of_found = matched(iou(true_px, found_px), 0.3 if is_one else 0.5)
    if table is not None:
        names = [str(i) if i >= 0 else "" for i in found.identity[rows].tolist()]
        for k in np.flatnonzero(of_found >= 0):
            before = _last_identity(found, table, true_id[of_found[k]], frame)
            if before is not None and before != found.identity[rows[k]]:
                marked[k] = True
                names[k] = f"{before}>{found.identity[rows[k]]}"
    judged = of_found >= 0
    if not is_one:
        judged |= counted(truth, found.frame[rows], found_px)
    return FrameBoxes(true_px, found_px, of_found, true_names, names, marked, judged)


def matched(overlap: np.ndarray, least: float = 0.5) -> np.ndarray:
    """Return the true box of each found box, (M,), -1 for none: each true box in turn takes the best remaining box.

    The counts use the same matching. overlap: (N, M), the IoU of true and found boxes.
    """
    of_found, left = np.full(overlap.shape[1], -1), overlap.copy()
    for i in range(len(left) if left.size else 0):
        j = int(np.argmax(left[i]))
        if left[i, j] >= least:
            of_found[j] = i
            left[:, j] = -1
    return of_found


def _last_identity(found: Findings, table: TrackTable, identity: int, frame: int) -> int | None:
    """Return the identity under which a target was last found before a frame; None if it was not found."""
    mine = (table.identity == identity) & (table.frame < frame)
    for row in np.flatnonzero(mine)[np.argsort(-table.frame[mine], kind="stable")].tolist():
        there = np.flatnonzero(found.frame == table.frame[row])
        overlap = iou(table.box_px[row][None], found.box_px[there])[0]
        if len(there) and overlap.max() >= 0.5:
            return int(found.identity[there[int(np.argmax(overlap))]])
    return None


def _sides(picture: np.ndarray, size_px: Size) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the picture in its size on the page, a dark grey copy on which lines stand out, and the scale."""
    scale = min(MAX_WIDTH / size_px[0], MAX_HEIGHT / size_px[1], 3.0)
    width, height = (max(1, round(side * scale)) for side in size_px)
    how = cv2.INTER_AREA if width < picture.shape[1] else cv2.INTER_LINEAR
    left = cv2.resize(colour_picture(picture), (width, height), interpolation=how)
    grey = cv2.cvtColor(left, cv2.COLOR_BGR2GRAY)
    return left, cv2.cvtColor((grey * 0.65 + 20).astype(np.uint8), cv2.COLOR_GRAY2BGR), scale


def _tint(picture: np.ndarray, area: np.ndarray, colour: Colour, share: float) -> None:
    size = picture.shape[1], picture.shape[0]
    part = cv2.resize(area.astype(np.float32), size, interpolation=cv2.INTER_AREA)[..., None] * share
    picture[:] = (picture * (1 - part) + np.array(colour) * part).astype(np.uint8)


def _outline(picture: np.ndarray, area: np.ndarray, colour: Colour, thick: int) -> None:
    cv2.polylines(picture, list(map(drawable, _contours(picture, area))), True, colour, thick, cv2.LINE_AA)


def _contours(picture: np.ndarray, area: np.ndarray) -> list[np.ndarray]:
    """Return contours, (N, 1, 2) each, in pixels of the picture on the page."""
    contours, _ = cv2.findContours(area.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    scale = picture.shape[1] / area.shape[1], picture.shape[0] / area.shape[0]
    return [(contour + 0.5) * scale for contour in contours]


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
        points = drawable(start + (end - start) * np.arange(steps + 1)[:, None] / steps).tolist()
        for shade, thick in (((0, 0, 0), 4), (colour, 2)):
            for k in range(0, steps, 2):
                cv2.line(picture, points[k], points[k + 1], shade, thick)


def _jpeg(picture: np.ndarray) -> bytes:
    # Thin lines need their full colour at each pixel.
    finest = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    how = [cv2.IMWRITE_JPEG_QUALITY, 80, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, finest]
    return cv2.imencode(".jpg", picture, how)[1].tobytes()
