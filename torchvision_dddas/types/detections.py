"""Detections of a frame, and tables of detections."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types.table import Boxes, Table, complete_table


@dataclass(frozen=True)
class Detections(Boxes):
    """The targets detected in one frame, one row per target; row i has value i + 1 in the frame's mask.

    box_px: (N, 4) float64, x, y of the top left pixel, width, height. score: (N,) in [0, 1], 1 where none is given.
    area_px: (N,) foreground pixels. heading_rad: (N,) direction of motion relative to the background, image axes
    (0 = right, pi/2 = down). speed_px: (N,) pixels per frame relative to the background. kind: moving, given, person.
    middle_px: (N, 2) u, v of the foreground's centroid. label: (N,) str, the class, empty if unknown. class_id: (N,)
    int64, its number, -1 if unknown. Other values are NaN if unknown. Lists and tensors become arrays. Raise InputError
    for other shapes.

    >>> found = td.Detections([[40, 60, 20, 20], [80, 60, 10, 20]], [0.9, 0.5], label=["car", "person"])
    >>> found
    Detections(2 rows, box_px: 10 to 80, score: 0.5 to 0.9, label: car, person, class_id: -1)
    >>> found[found.label == "car"].xyxy
    array([[40., 60., 60., 80.]])
    """

    box_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    score: np.ndarray = field(default_factory=lambda: np.zeros(0))
    area_px: np.ndarray = field(default_factory=lambda: np.zeros(0))
    heading_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    speed_px: np.ndarray = field(default_factory=lambda: np.zeros(0))
    kind: str = "moving"
    middle_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    # An array of objects: in an array of characters, one long word would widen each row.
    label: np.ndarray = field(default_factory=lambda: np.zeros(0, object))
    class_id: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        for name, values in vars(self).copy().items():
            if name != "kind" and not isinstance(values, np.ndarray):
                object.__setattr__(self, name, _as_column(name, values))
        unknown = dict.fromkeys(("area_px", "heading_rad", "speed_px", "middle_px"), np.nan)
        complete_table(self, len(self.box_px), **unknown, score=1.0, label="", class_id=-1)

    @classmethod
    def from_supervision(cls, detections: Any) -> Self:
        """Return another detector's detections, in pixels: supervision, ultralytics (Results, Boxes), torchvision, ...

        detections: an object or a mapping that has a name of each row of _FOREIGN, with arrays or tensors. Scores that
        are None count as 1. Classes are `data["class_name"]` (N,), or the names that `names` gives to the
        numbers. Raise InputError if boxes or scores are missing, have other shapes, or are refused by `check_boxes`.
        """
        refuse_table(detections)
        given, names = detections, getattr(detections, "names", None)
        names = names if isinstance(names, Mapping) else dict(enumerate(names or ()))
        if hasattr(getattr(given, "boxes", None), "xyxy"):  # Results of ultralytics
            given = given.boxes
        (edges, xyxy), (conf, confidence), (_, number) = (_first_of(given, line) for line in _FOREIGN)
        if not edges or not conf:
            raise InputError(
                f"from_supervision got {type(detections).__name__} without {_FOREIGN[bool(edges)][0]}; wanted the "
                "result for one picture, or Tracker.update((boxes, scores)) with boxes x, y, width, height"
            )
        corners = np.asarray(xyxy, np.float64)
        if corners.ndim != 2 or corners.shape[1] != 4:
            raise InputError(f"detections.{edges} must have the shape (N, 4), got {corners.shape}")
        box_px = np.concatenate([corners[:, :2], corners[:, 2:] - corners[:, :2]], axis=1)
        if not (np.isfinite(box_px).all() and (box_px[:, 2:] > 0).all()):
            raise InputError(
                f"detections.{edges} must hold finite left, top, right and bottom edges, right of left, below top"
            )
        count, data = len(box_px), getattr(given, "data", None)
        named = data.get("class_name") if isinstance(data, Mapping) else None
        found = {
            conf: np.ones(count) if confidence is None else np.asarray(confidence, np.float64),
            "class_id": np.full(count, -1) if number is None else np.asarray(number),
            "data['class_name']": np.full(count, None, object) if named is None else np.asarray(named, object),
        }
        for name, values in found.items():
            if values.shape != (count,):
                raise InputError(f"detections.{name} must have the shape ({count},), got {values.shape}")
        score, number, words = found.values()
        if number.dtype.kind not in "iuf":  # classes by their names
            number, words = np.full(count, -1), number
        check_boxes(box_px, score, certain=False)
        if not np.isfinite(number).all():
            number = np.where(np.isfinite(number), number, -1)  # unknown
        label = np.array(["" if word is None else str(word) for word in words], object)
        if named is None and (number >= 0).any():
            label = np.array([names.get(int(k), str(int(k))) if k >= 0 else "" for k in number], object)
        area_px = box_px[:, 2] * box_px[:, 3]
        return cls(box_px, score, area_px, kind="given", label=label, class_id=number.astype(np.int64))


def _as_column(name: str, values: Any) -> np.ndarray:
    """Return a list or a tensor as the array of this name. Raise InputError if it cannot be an array."""
    try:
        array = np.array(_off_device(values), {"label": object, "class_id": np.int64}.get(name, np.float64))
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} of Detections cannot be an array: {error}") from None
    array = array.reshape(0, 4) if name == "box_px" and not array.size else array
    if array.ndim != (2 if name in ("box_px", "middle_px") else 1):
        got = f"the shape {array.shape}" if array.ndim else f"{values!r}; give a list, such as [{values!r}]"
        raise InputError(f"{name} of Detections must have a row for each box, got {got}")
    return array


_FOREIGN = (("xyxy", "boxes", "bboxes"), ("confidence", "conf", "scores"), ("class_id", "cls", "labels"))
"""Names of edges, scores and classes in supervision, ultralytics, torchvision, transformers and mmdetection."""


def _first_of(given: Any, names: Sequence[str]) -> tuple[str, Any]:
    """Return the first of the names that an object or mapping has, and its value on the CPU; "" and None without one.

    A name whose value is None counts only if all values are None.
    """
    held = {name: given[name] for name in names if name in given} if isinstance(given, Mapping) else {}
    held = held or {name: getattr(given, name) for name in names if hasattr(given, name)}
    name = next((name for name in held if held[name] is not None), next(iter(held), ""))
    value: Any = held.get(name)
    return name, _off_device(value)


def _off_device(value: Any) -> Any:
    return value.detach().cpu().numpy() if hasattr(value, "detach") else value


def check_boxes(box_px: np.ndarray, score: np.ndarray, certain: bool) -> None:
    """Raise InputError for boxes (N, 4) and scores (N,) that are not plausible pixels and probabilities.

    certain: whether the scores are ignored, so that they may have any scale.

    >>> types.check_boxes(np.array([[40.0, 60, 20, 20]]), np.array([90.0]), certain=False)
    Traceback (most recent call last):
        ...
    torchvision_dddas.errors.InputError: scores must be probabilities in [0, 1], ...
    """
    if not (np.isfinite(box_px).all() and np.isfinite(score).all()):
        raise InputError("boxes and scores must be finite; leave out detections that are unknown")
    if len(box_px) and not (box_px[:, 2:] > 0).all():
        row = int((box_px[:, 2:] <= 0).any(axis=1).argmax())
        width, height = box_px[row, 2:]
        raise InputError(f"width and height must be above 0 px, got {width:g} x {height:g} in box {row}")
    if share_orders(box_px):
        raise InputError(
            "boxes that lie in [0, 1] are shares of a picture, not pixels: multiply them by its width and height"
        )
    if not certain and ((score < 0) | (score > 1)).any():
        raise InputError(
            f"scores must be probabilities in [0, 1], got {score.min():g} to {score.max():g}; divide percent by 100, "
            "or take Tracker(certain=True)"
        )


def share_orders(box: np.ndarray) -> list[str]:
    """Return the orders of columns in which boxes (N, 4) are shares of a picture; an empty list if they are pixels.

    >>> types.share_orders(np.array([[0.1, 0.1, 0.3, 0.5]]))
    ['xyxy', 'xywh']
    """
    first, last = box[:, :2], box[:, 2:]
    orders = {"yolo": (first - last / 2, first + last / 2), "xyxy": (first, last), "xywh": (first, first + last)}
    return [n for n, (low, high) in orders.items() if len(box) and ((low > -0.01) & (low < high) & (high < 1.01)).all()]


def are_corners(box: np.ndarray, size: tuple[float, float] | None) -> bool:
    """Return whether the last two columns are right and bottom edges: they exceed the first two, or sizes do not fit.

    >>> types.are_corners(np.array([[600.0, 400, 630, 460]] * 3), size=(640, 480))
    True
    """
    first, last = box[:, :2], box[:, 2:]
    if not len(box) or not (last > first).all():
        return False
    follow = len(box) > 4 and 4 * (last - first).var(axis=0).sum() < last.var(axis=0).sum()
    is_beyond = size is not None and (first + last > 1.1 * np.array(size)).any(axis=1).mean() > 0.5
    return bool(follow or (is_beyond and (last <= 1.01 * np.array(size)).all()))


# Number of boxes that may lie beyond the extent of a table, and number of rows from which the extent is estimated.
_STRAYS, _ENOUGH_ROWS = 3, 30


@dataclass(frozen=True)
class DetectionTable(Table):
    """Boxes of a clip, sorted by frame; rows of one frame keep the file's order.

    frame: (N,) int64 from 1. box_px: (N, 4) float64, x, y, width, height. score: (N,) as given, else 1.
    line: (N,) int64, the row's line in the file, from 1. identity: (N,) int64 from 1, -1 if unknown.
    cut: (N,) bool, the picture's border cuts the target. feet_px: (N, 2) u, v between the feet. Both may be None. own:
    `dddas detect` wrote the table, with moving targets only. ours: `dddas detect` or `dddas track` wrote it.
    label: (N,) str, the class, empty if unknown; class_id: (N,) int64, its number, -1 if unknown; None if not given.
    kind: (N,) str, the kind of a row. `dddas track` writes detection, bridge (a box between two detections, where
    nothing was seen) or untracked (a detection without identity). None if not given. notes: notes on the reading of the
    boxes.

    >>> box_px = np.tile([10.0, 20, 5, 9], (3, 1))
    >>> table = td.DetectionTable("boxes.csv", np.array([1, 1, 2]), box_px, np.ones(3), line=np.array([1, 2, 3]))
    >>> table.first, table.last, len(table.at(1))
    (1, 2, 2)
    """

    path: str
    frame: np.ndarray
    box_px: np.ndarray
    score: np.ndarray
    line: np.ndarray
    own: bool = False
    identity: np.ndarray | None = None
    cut: np.ndarray | None = None
    feet_px: np.ndarray | None = None
    ours: bool = False
    label: np.ndarray | None = None
    kind: np.ndarray | None = None
    class_id: np.ndarray | None = None
    notes: tuple[str, ...] = ()

    def of_kind(self, *kinds: str) -> np.ndarray:
        """Return (N,) bool, whether each row is of one of these kinds."""
        return np.zeros(len(self), bool) if self.kind is None else np.isin(self.kind, kinds)

    @property
    def first(self) -> int:
        """The lowest frame number; 0 for a table without rows."""
        return int(self.frame[0]) if len(self) else 0

    @property
    def last(self) -> int:
        """The highest frame number; 0 for a table without rows."""
        return int(self.frame[-1]) if len(self) else 0

    @cached_property
    def probable(self) -> bool:
        """Whether the scores can be probabilities: all in [0, 1]."""
        return bool(((self.score >= 0) & (self.score <= 1)).all())

    @property
    def certain(self) -> bool:
        """Whether every row counts as certain: own targets, confirmed over frames, or scores of another scale."""
        return self.own or not self.probable

    @cached_property
    def extent(self) -> tuple[float, float] | None:
        """The (width, height) estimated from the boxes; None with too few rows.

        It is the right and bottom edge without the _STRAYS farthest boxes, so that a stray box does not move the
        picture's border. Rows with a score below 0.5 are ignored.
        """
        likely = self.box_px if self.certain else self.box_px[self.score >= 0.5]
        if len(likely) < _ENOUGH_ROWS:
            return None
        width, height = np.sort(likely[:, :2] + likely[:, 2:], axis=0)[-1 - _STRAYS]
        return float(width), float(height)

    def classes(self, rows: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray]:
        """Return the names and numbers of the classes of the given rows, as in Detections."""
        label = np.full(len(self), "", object) if self.label is None else self.label
        return label[rows], (np.full(len(self), -1) if self.class_id is None else self.class_id)[rows]

    def rows(self, frame: int) -> slice:
        """Return the slice of the rows of a frame."""
        return slice(*np.searchsorted(self.frame, [frame, frame + 1]))

    @cached_property
    def targets(self) -> np.ndarray:
        """Identities of the rows, (N,) int64. Rows without identity get numbers above all identities, counted by frame.

        Raise InputError if a frame has an identity twice.
        """
        identity = self.identity if self.identity is not None else np.full(len(self), -1)
        order = np.lexsort((self.line, identity, self.frame))
        before, after = order[:-1], order[1:]
        twice = (self.frame[before] == self.frame[after]) & (identity[before] == identity[after])
        if (twice & (identity[after] > 0)).any():
            row = after[(twice & (identity[after] > 0)).argmax()]
            raise InputError(
                f"{self.path}, line {self.line[row]}: identity {identity[row]} occurs twice in frame "
                f"{self.frame[row]}; wanted each identity once a frame, or -1 for rows without one"
            )
        place = np.arange(len(self)) - np.searchsorted(self.frame, self.frame) + 1
        return np.where(identity > 0, identity, place + max(identity.max(initial=0), 0)).astype(np.int64)

    def at(self, frame: int) -> Detections:
        """Return the detections of a frame, of kind `given`."""
        here = self.rows(frame)
        box_px, (label, class_id) = self.box_px[here], self.classes(here)
        area_px = box_px[:, 2] * box_px[:, 3]
        return Detections(box_px, self.score[here], area_px, kind="given", label=label, class_id=class_id)


def refuse_table(given: object) -> None:
    """Raise InputError if detections of one frame are given as a table of a clip, or as rows selected from it.

    >>> types.refuse_table(td.Detections([[40, 60, 20, 20]]))
    """
    if isinstance(given, DetectionTable):
        raise InputError(
            f"got a DetectionTable of {len(given)} rows; wanted the detections of one frame: give table.at(n) for "
            "frame n, not the table or table[table.frame == n]"
        )
