"""The records that flow through the system: frames in, scenes out. NumPy only, so that every runtime can hold them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self, overload

import numpy as np

from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Bool as Bool
    from jaxtyping import Float as Float
    from jaxtyping import Int as Int
else:
    # jaxtyping takes 0.1 s and 10 MB to import; here its annotations stand for the array alone.
    class _Array:
        def __class_getitem__(cls, array_and_shape: tuple[type, str]) -> type:
            return array_and_shape[0]

    Bool = Float = Int = _Array


class Table:
    """A record whose arrays have one row an item each: rows can be selected, and tables of one kind joined."""

    def __getitem__(self, rows: np.ndarray | slice) -> Self:
        """The selected rows (indices, mask or slice); fields that are not arrays are kept."""
        return replace(self, **{name: column[rows] for name, column in _columns(self).items()})  # type: ignore[type-var]

    @classmethod
    def concat(cls, tables: Sequence[Self]) -> Self:
        """All rows in one table; other fields come from the first, but the frames of rows become an array."""
        columns = [_columns(table) for table in tables]
        for table, column in zip(tables, columns, strict=True):
            if hasattr(table, "frame"):
                column["frame"] = np.broadcast_to(table.frame, len(table))  # type: ignore[arg-type]
        joined = {name: np.concatenate([column[name] for column in columns]) for name in columns[0]}
        return replace(tables[0], **joined)  # type: ignore[type-var]

    def to_columns(self) -> dict[str, np.ndarray]:
        """Arrays (N,) by column name; wider arrays are split: box_px into x_px, y_px, width_px, height_px.

        The frame is a column, and `label` is called `class`, as in the tables of runs.
        """
        columns: dict[str, np.ndarray] = {}
        if hasattr(self, "frame"):
            columns["frame"] = np.broadcast_to(self.frame, len(self))  # type: ignore[arg-type]
        for name, values in _columns(self).items():
            flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
            many = (name,) if values.ndim == 1 else tuple(f"{name}_{k}" for k in range(flat.shape[1]))
            columns |= dict(zip(_SPLIT.get(name, many), flat.T, strict=True))
        return columns

    def to_pandas(self) -> Any:
        """The columns of to_columns as a pandas DataFrame. Raises InputError where pandas is not installed."""
        try:
            import pandas
        except ImportError:
            raise InputError("to_pandas needs pandas: pip install pandas; to_columns gives plain arrays") from None
        return pandas.DataFrame(self.to_columns())


# Names of the columns of arrays that have several, or another name than a table's column.
_SPLIT = {
    "label": ("class",),
    "box_px": ("x_px", "y_px", "width_px", "height_px"),
    "window_px": ("window_x_px", "window_y_px", "window_width_px", "window_height_px"),
    "middle_px": ("middle_u_px", "middle_v_px"),
    "image_px": ("u_px", "v_px"),
    "east_north_m": ("east_m", "north_m"),
    "lonlat_deg": ("longitude_deg", "latitude_deg"),
    "covariance_m2": ("var_east_m2", "cov_east_north_m2", "cov_north_east_m2", "var_north_m2"),
}


class Boxes(Table):
    """A table with boxes, box_px (N, 4), scores, and classes: names and numbers."""

    box_px: np.ndarray
    score: np.ndarray
    label: np.ndarray
    class_id: np.ndarray

    @property
    def xyxy(self) -> np.ndarray:
        """(N, 4) left, top, right and bottom edge in pixels, as torchvision and supervision have boxes."""
        return np.concatenate([self.box_px[:, :2], self.box_px[:, :2] + self.box_px[:, 2:]], axis=1)

    def to_supervision(self) -> Any:
        """A supervision.Detections of the boxes, as its annotators draw it; class_id is 0 if no class is known.

        Raises InputError where supervision is not installed.
        """
        try:
            import supervision
        except ImportError:
            raise InputError("to_supervision needs supervision: pip install supervision") from None
        data = {"class_name": self.label.astype(str)} if any(self.label.tolist()) else {}
        number = self.class_id if (self.class_id >= 0).any() else np.zeros_like(self.class_id)
        identity = getattr(self, "identity", None)
        return supervision.Detections(
            xyxy=self.xyxy, confidence=self.score, class_id=number, tracker_id=identity, data=data
        )


def _columns(table: Any) -> dict[str, np.ndarray]:
    values = {column.name: getattr(table, column.name) for column in fields(table)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def _complete(table: Any, count: int, **unknown: Any) -> None:
    """Fill the arrays that were not given with what is unknown. Raises InputError for arrays of other lengths."""
    for name, values in _columns(table).items():
        if len(values) == 0 < count and name in unknown:
            filled = np.full((count, *values.shape[1:]), unknown[name], values.dtype)
            object.__setattr__(table, name, filled)
        elif len(values) not in (0, count):
            raise InputError(f"{name} of {type(table).__name__} must have {count} rows, got {len(values)}")


@dataclass(frozen=True)
class Frame:
    """One picture of a clip.

    number: 1-based position in the clip. time_s: seconds since the clip's first frame.
    image: uint8, (H, W) grey or (H, W, 3) BGR. skipped: frames before it that were left out on purpose.
    taken_s: capture time by the monotonic clock; NaN for a recording. damaged: the decoder concealed errors in it or in
    an earlier picture that it builds on.
    """

    number: int
    time_s: float
    image: np.ndarray
    skipped: int = 0
    taken_s: float = float("nan")
    damaged: bool = False


def as_picture(image: Any, name: str = "frame") -> np.ndarray:
    """A picture as every part of the program takes it: uint8, (H, W) or (H, W, 3) BGR; (H, W, 1) becomes (H, W).

    Raises InputError for anything else, with the code that converts it, where `frame` is what was given.
    """
    if isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.size:
        if image.ndim == 2 or image.shape[2:] == (3,):
            return image
        if image.shape[2:] == (1,):
            return image[..., 0]
    if image is None:  # what OpenCV gives for a file that it cannot read
        raise InputError(f"{name} is None; could its file be read? Wanted a NumPy image")
    code, kind = "frame", type(image).__name__
    if hasattr(image, "detach"):  # a tensor
        image, code = image.detach().cpu().numpy(), "frame.detach().cpu().numpy()"
    if not isinstance(image, np.ndarray):
        raise InputError(f"{name} must be a Frame or a NumPy image, got {kind}; np.asarray or cv2.imread makes one")
    what, shape = f"{image.dtype} of shape {image.shape}", image.shape
    if not image.size or image.ndim not in (2, 3, 4) or image.dtype.kind not in "iufb":
        raise InputError(f"{name} must be uint8 of shape (H, W) or (H, W, 3), got {what}")
    if image.ndim == 4:
        code, shape = f"{code}[0]", shape[1:]
    if len(shape) == 3 and shape[0] in (1, 3, 4) and shape[2] > 4:
        code, shape = f"np.moveaxis({code}, 0, -1)", (*shape[1:], shape[0])
        code += "[..., ::-1]" if shape[2] == 3 else ""  # colours are RGB there
    if len(shape) == 3 and shape[2] == 4:
        code = f"{code}[..., :3]"
    values = np.nan_to_num(image)
    low, high = float(values.min()), float(values.max())
    if image.dtype.kind in "fb" and low >= 0 and high <= 1:
        code = f"(np.nan_to_num({code}) * 255.0).round().astype(np.uint8)"
    elif image.dtype != np.uint8 and low >= 0 and high <= 255:
        code = f"np.nan_to_num({code}).round().astype(np.uint8)"
    elif image.dtype != np.uint8:  # one range for the whole clip, or it flickers
        gain = 255 / (high - low or 1)
        code = f"((np.clip({code}, {low:.0f}, {high:.0f}) - {low:.0f}) * {gain:.6g}).astype(np.uint8)"
    raise InputError(f"{name} must be uint8 of shape (H, W) or (H, W, 3), got {what}; convert it: {code}")


@dataclass(frozen=True)
class Problem:
    """A recoverable fault while reading a clip: the first affected frame, 1-based, and a description."""

    frame: int
    what: str

    def __str__(self) -> str:
        return self.what


class Source(Protocol):
    """A clip that is read frame by frame.

    Iterating yields frames in order, numbered from 1, without those that cannot be decoded.
    count: announced frames, None if unknown. exact: whether the count is reliable. size: (width, height), px.
    last: the last frame read; after the end of the clip its last frame, decoded or not.
    problems: filled while reading; each new iteration starts at frame 1 and clears it.
    """

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def count(self) -> int | None: ...  # noqa: D102
    @property
    def exact(self) -> bool: ...  # noqa: D102
    @property
    def rate_hz(self) -> float: ...  # noqa: D102
    @property
    def size(self) -> tuple[int, int]: ...  # noqa: D102
    @property
    def last(self) -> int: ...  # noqa: D102
    @property
    def problems(self) -> list[Problem]: ...  # noqa: D102

    def __iter__(self) -> Iterator[Frame]: ...

    def every(self, interval: int) -> Iterator[Frame]:
        """Yield frames 1, 1 + interval, ...; the others are not decoded where that can be avoided."""
        ...


@overload
def is_sampled(frame: int, interval: int) -> bool: ...
@overload
def is_sampled(frame: np.ndarray, interval: int) -> np.ndarray: ...
def is_sampled(frame: int | np.ndarray, interval: int) -> bool | np.ndarray:
    """Whether a frame number, or each of an array, is one of 1, 1 + interval, 1 + 2 interval, ..."""
    return (frame - 1) % interval == 0


@dataclass(frozen=True)
class Telemetry:
    """The vehicle's own reports, one row per sample, sorted by time; NaN where unknown. Arrays are (N,).

    time_s: since the clip's first frame. altitude_m: above height_zero: "ground", that below the vehicle, or "takeoff",
    the point where it took off. above_sea_m: if height_zero is "unknown", the log does not say whether it counts from
    the sea or from the take-off point. above_ellipsoid_m: above WGS 84. speed_m_s: over ground.
    place: (N, 2) longitude and latitude in degrees if geographic, else local metres east and north.
    heading_rad, pitch_rad, roll_rad: of the camera, as in Camera; straight down the pitch is pi/2 and the heading that
    of the picture's upper edge. hfov_rad: horizontal field of view. vehicle_heading_rad: of the vehicle's nose.
    heading_sigma_rad, tilt_sigma_rad, altitude_sigma_m: standard deviations, NaN: those of the group `aerial`.
    heading_from: what heading_rad was taken from where the log does not say it, in words; empty where it does.
    is_nominal: hfov_rad follows from a focal length "as for 36 mm": it is that of the longer side of the pictures.
    start_utc_s: seconds since 1970 at time_s = 0, NaN if unknown. latest_utc_s: the latest that this can be where the
    dates lack a zone. origin: the file. notes: remarks for the user.
    Raises InputError for columns of other lengths and times that decrease.
    """

    time_s: np.ndarray
    altitude_m: np.ndarray
    speed_m_s: np.ndarray
    place: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    geographic: bool = True
    above_sea_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    heading_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    pitch_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    roll_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    hfov_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    vehicle_heading_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    heading_sigma_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    tilt_sigma_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    altitude_sigma_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    above_ellipsoid_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    height_zero: Literal["ground", "takeoff", "unknown"] = "ground"
    heading_from: str = ""
    is_nominal: bool = False
    start_utc_s: float = float("nan")
    latest_utc_s: float = float("nan")
    origin: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        time_s = np.asarray(self.time_s, float)
        object.__setattr__(self, "time_s", time_s)
        if (np.diff(time_s) < 0).any():
            raise InputError("time_s of telemetry must not decrease; sort its rows by time")
        for name in COLUMNS_OF_TELEMETRY:
            given, wanted = np.asarray(getattr(self, name), float), (len(time_s), 2)[: 1 + (name == "place")]
            if len(given) == 0 < len(time_s):  # a column that was not given is one of unknown values
                given = np.full(wanted, np.nan)
            if given.shape != wanted:
                raise InputError(f"{name} of telemetry must have the shape {wanted}, a row a time, got {given.shape}")
            object.__setattr__(self, name, given)

    def __len__(self) -> int:
        return len(self.time_s)

    def focal_px(self, size: tuple[int, int]) -> np.ndarray:
        """(N,) focal length in pixels by the field of view, NaN where unknown. size: (width, height) of pictures."""
        return (max(size) if self.is_nominal else size[0]) / 2 / np.tan(self.hfov_rad / 2)

    @property
    def hold_s(self) -> float:
        """How long before its first and after its last sample the log still tells a place: half an interval."""
        return min(0.5 * float(np.median(np.diff(self.time_s))) + 1e-6, 1.0) if len(self) > 1 else 1.0

    def at(self, time_s: float, tolerance_s: float = 1.0) -> "Flight | None":
        """The state at a time by linear interpolation, angles and longitudes the short way round.

        A field is NaN if it is in either neighbour. Up to tolerance_s outside the span the nearest sample is used;
        beyond that the result is None.
        """
        times, time_s = self.time_s, float(time_s)
        count = len(times)
        if count == 0 or not times.item(0) - tolerance_s <= time_s <= times.item(count - 1) + tolerance_s:
            return None
        after = min(int(times.searchsorted(time_s)), count - 1)
        end_s = times.item(after)
        before, share = after, 0.0
        if after > 0 and time_s < end_s:  # else outside the span, or on a sample, which then counts alone
            before = after - 1
            share = (time_s - times.item(before)) / (end_s - times.item(before))

        def between(values: np.ndarray, full: float = math.inf) -> float:
            low = values.item(before)
            return low + share * _wrap(values.item(after) - low, full)

        first, second = self.place[before].tolist(), self.place[after].tolist()
        around = 360.0 if self.geographic else math.inf
        east = first[0] + share * _wrap(second[0] - first[0], around)
        return Flight(
            between(self.altitude_m),
            between(self.speed_m_s),
            (_wrap(east, around), first[1] + share * (second[1] - first[1])),
            between(self.above_sea_m),
            between(self.heading_rad, _TURN) % _TURN,
            between(self.pitch_rad),
            _wrap(between(self.roll_rad, _TURN), _TURN),
            between(self.hfov_rad),
            between(self.vehicle_heading_rad, _TURN) % _TURN,
            between(self.heading_sigma_rad),
            between(self.tilt_sigma_rad),
            between(self.altitude_sigma_m),
            self.heading_from,
        )

    def check_overlap(self, last_s: float, first_s: float = 0.0, what: str = "clip") -> None:
        """Raises InputError, with both spans, where no sample lies near a clip or table from first_s to last_s."""
        if len(self) == 0:
            raise InputError(f"the telemetry has no samples; the {what} lasts from {first_s:.1f} to {last_s:.1f} s")
        from_s, to_s = float(self.time_s[0]), float(self.time_s[-1])
        if from_s - 1 > last_s or to_s + 1 < first_s:
            raise InputError(
                f"the telemetry covers {from_s:.1f} to {to_s:.1f} s, the {what} {first_s:.1f} to {last_s:.1f} s; "
                "they do not overlap: count time_s from the clip's first frame, or set aerial.clock_offset_s"
            )


_TURN = 2 * math.pi
_LEAST_SINE = 0.1  # of the angle of a view below the horizon


def _wrap(value: float, full: float) -> float:
    """A value or difference on a circle of circumference `full`, from minus half of it to half."""
    return value if abs(value) <= full / 2 or full == math.inf else (value + full / 2) % full - full / 2


COLUMNS_OF_TELEMETRY = (
    "altitude_m",
    "speed_m_s",
    "place",
    "above_sea_m",
    "heading_rad",
    "pitch_rad",
    "roll_rad",
    "hfov_rad",
    "vehicle_heading_rad",
    "heading_sigma_rad",
    "tilt_sigma_rad",
    "altitude_sigma_m",
    "above_ellipsoid_m",
)


@dataclass(frozen=True)
class Flight:
    """Telemetry at one moment; fields as in Telemetry, NaN where unknown."""

    altitude_m: float
    speed_m_s: float = float("nan")
    place: tuple[float, float] = (float("nan"), float("nan"))
    above_sea_m: float = float("nan")
    heading_rad: float = float("nan")
    pitch_rad: float = float("nan")
    roll_rad: float = float("nan")
    hfov_rad: float = float("nan")
    vehicle_heading_rad: float = float("nan")
    heading_sigma_rad: float = float("nan")
    tilt_sigma_rad: float = float("nan")
    altitude_sigma_m: float = float("nan")
    heading_from: str = ""

    @property
    def distance_m(self) -> float:
        """From the camera to level ground along the optical axis; the altitude where the pitch is not known.

        A view less than about 6 degrees below the horizon counts as one of that many: its ground is too far to tell.
        """
        if not math.isfinite(self.pitch_rad):
            return self.altitude_m
        return self.altitude_m / max(math.sin(self.pitch_rad), _LEAST_SINE)


@dataclass(frozen=True)
class Registration:
    """The background's motion from one frame to a later one.

    later_from_earlier: (3, 3) float64 homography on pixel coordinates (u, v, 1).
    tracked, inliers: numbers of keypoints tracked, and of those that fit the homography.
    error_px: median error of the inliers. flow_px: median background displacement. cause: why it is not reliable.
    """

    later_from_earlier: np.ndarray
    tracked: int
    inliers: int
    error_px: float
    flow_px: float
    reliable: bool = True
    cause: str = ""


@dataclass(frozen=True)
class Detections(Boxes):
    """The targets detected in one frame, one row per target; row i has value i + 1 in the frame's mask.

    box_px: (N, 4) float64, x, y of the top left pixel, width, height. score: (N,) in [0, 1].
    area_px: (N,) foreground pixels. heading_rad: (N,) direction of motion relative to the background, image axes
    (0 = right, pi/2 = down). speed_px: (N,) pixels per frame relative to the background. kind: moving, given, person.
    middle_px: (N, 2) u, v of the foreground's centroid. label: (N,) str, the class, empty if unknown. class_id: (N,)
    int64, its number, -1 if unknown. Other unknown values are NaN. Raises InputError for arrays of other lengths.
    """

    box_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    score: np.ndarray = field(default_factory=lambda: np.zeros(0))
    area_px: np.ndarray = field(default_factory=lambda: np.zeros(0))
    heading_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    speed_px: np.ndarray = field(default_factory=lambda: np.zeros(0))
    kind: str = "moving"
    middle_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    # Of objects, because one long word would widen each row of an array of characters.
    label: np.ndarray = field(default_factory=lambda: np.zeros(0, object))
    class_id: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        nan = np.nan
        unknown = {"area_px": nan, "heading_rad": nan, "speed_px": nan, "middle_px": nan, "label": "", "class_id": -1}
        _complete(self, len(self.box_px), **unknown)

    def __len__(self) -> int:
        return len(self.box_px)

    @classmethod
    def from_supervision(cls, detections: Any) -> Self:
        """Detections of another detector, in pixels: of supervision, ultralytics (Results, Boxes), torchvision, ...

        detections: an object or a mapping that has a name of each line of _FOREIGN, arrays or tensors. Scores that are
        None count as 1. Classes are those of `data["class_name"]` (N,), else what `names` calls the numbers.
        Raises InputError where boxes or scores are missing, have other shapes, or are not what `check_boxes` wants.
        """
        given, names = detections, getattr(detections, "names", {})
        names = names if isinstance(names, Mapping) else dict(enumerate(names))
        if hasattr(getattr(given, "boxes", None), "xyxy"):  # ultralytics' Results
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
        label = np.array(["" if word is None else str(word) for word in words], object)
        if named is None and (number >= 0).any():
            label = np.array([names.get(int(k), str(int(k))) if k >= 0 else "" for k in number], object)
        area_px = box_px[:, 2] * box_px[:, 3]
        return cls(box_px, score, area_px, kind="given", label=label, class_id=number.astype(np.int64))


_FOREIGN = (("xyxy", "boxes", "bboxes"), ("confidence", "conf", "scores"), ("class_id", "cls", "labels"))
"""What supervision, ultralytics, torchvision, transformers and mmdetection call edges, scores and classes."""


def _first_of(given: Any, names: Sequence[str]) -> tuple[str, Any]:
    """The first of the names that an object or mapping has, and its value, off any device; "" and None without one."""
    for name in names:
        if (name in given) if isinstance(given, Mapping) else hasattr(given, name):
            value = given[name] if isinstance(given, Mapping) else getattr(given, name)
            return name, value.detach().cpu().numpy() if hasattr(value, "detach") else value
    return "", None


def check_boxes(box_px: np.ndarray, score: np.ndarray, certain: bool) -> None:
    """Raises InputError for boxes (N, 4) and scores (N,) that no detector of pixels and probabilities gives.

    certain: whether the scores do not count, so that they may have any scale.
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
    """The orders of columns in which boxes (N, 4) lie in a picture with sides of 1; none where they are pixels."""
    first, last = box[:, :2], box[:, 2:]
    orders = {"yolo": (first - last / 2, first + last / 2), "xyxy": (first, last), "xywh": (first, first + last)}
    return [n for n, (low, high) in orders.items() if len(box) and ((low > -0.01) & (low < high) & (high < 1.01)).all()]


def are_corners(box: np.ndarray, size: tuple[float, float] | None) -> bool:
    """Whether the last two columns are right and bottom edges: they follow the first two, or sizes would not fit."""
    first, last = box[:, :2], box[:, 2:]
    if not len(box) or not (last > first).all():
        return False
    follow = len(box) > 4 and 4 * (last - first).var(axis=0).sum() < last.var(axis=0).sum()
    is_beyond = size is not None and (first + last > 1.1 * np.array(size)).any(axis=1).mean() > 0.5
    return bool(follow or (is_beyond and (last <= 1.01 * np.array(size)).all()))


# How many boxes may lie beyond the extent of a table, and from how many rows on the extent is estimated.
_STRAYS, _ENOUGH_ROWS = 3, 30


@dataclass(frozen=True)
class DetectionTable:
    """Boxes of a clip, sorted by frame; rows of one frame keep the file's order.

    frame: (N,) int64 from 1. box_px: (N, 4) float64, x, y, width, height. score: (N,) as given, else 1.
    line: (N,) int64, the row's line in the file, from 1. identity: (N,) int64 from 1, -1 if unknown.
    cut: (N,) bool, the picture's border cuts the target. feet_px: (N, 2) u, v between the feet. Both None if not given.
    own: `dddas detect` wrote it, and all rows are moving. ours: `dddas detect` or `dddas track` wrote it.
    label: (N,) str, the class, empty if unknown; class_id: (N,) int64, its number, -1 if unknown; None if not given.
    kind: (N,) str, what a row is; of `dddas track` detection, bridge (nothing was seen there: a box between two
    detections) or untracked (a detection without identity). None if not given. notes: how the boxes were read.
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

    def __len__(self) -> int:
        return len(self.frame)

    def of_kind(self, *kinds: str) -> np.ndarray:
        """(N,) bool, whether a row is of one of these kinds."""
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
        """(width, height) estimated from the boxes; None with too few rows.

        The right and bottom edges without the _STRAYS farthest, so that a stray box does not move the picture's border.
        Rows with a score below 0.5 are ignored.
        """
        likely = self.box_px if self.certain else self.box_px[self.score >= 0.5]
        if len(likely) < _ENOUGH_ROWS:
            return None
        width, height = np.sort(likely[:, :2] + likely[:, 2:], axis=0)[-1 - _STRAYS]
        return float(width), float(height)

    def classes(self, rows: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray]:
        """Name and number of the class of each of some rows, as in Detections."""
        label = np.full(len(self), "", object) if self.label is None else self.label
        return label[rows], (np.full(len(self), -1) if self.class_id is None else self.class_id)[rows]

    def rows(self, frame: int) -> slice:
        """Where the rows of a frame are."""
        return slice(*np.searchsorted(self.frame, [frame, frame + 1]))

    @cached_property
    def targets(self) -> np.ndarray:
        """(N,) int64 identity of each row; rows without one are numbered within the frame, above all identities.

        Raises InputError if a frame has an identity twice.
        """
        identity = self.identity if self.identity is not None else np.full(len(self), -1)
        order = np.lexsort((self.line, identity, self.frame))
        before, after = order[:-1], order[1:]
        twice = (self.frame[before] == self.frame[after]) & (identity[before] == identity[after])
        if (twice & (identity[after] > 0)).any():
            row = after[(twice & (identity[after] > 0)).argmax()]
            raise InputError(
                f"{self.path}, line {self.line[row]}: identity {identity[row]} is there already in frame "
                f"{self.frame[row]}; wanted each once a frame, or -1 where there are none"
            )
        place = np.arange(len(self)) - np.searchsorted(self.frame, self.frame) + 1
        return np.where(identity > 0, identity, place + max(identity.max(initial=0), 0)).astype(np.int64)

    def at(self, frame: int) -> Detections:
        """The detections of a frame, of kind `given`."""
        here = self.rows(frame)
        box_px, (label, class_id) = self.box_px[here], self.classes(here)
        area_px = box_px[:, 2] * box_px[:, 3]
        return Detections(box_px, self.score[here], area_px, kind="given", label=label, class_id=class_id)


@dataclass(frozen=True)
class Adjustment:
    """A parameter changed by feedback at a frame, and the reason."""

    frame: int
    parameter: str
    old: float
    new: float
    cause: str

    def describe(self) -> str:
        """The change in words, "none" for a bound that is not set."""
        old, new = (f"{value:.5g}" if math.isfinite(value) else "none" for value in (self.old, self.new))
        return f"{self.parameter} {old} -> {new}"


@dataclass(frozen=True)
class LinearSvm:
    """A person classifier: score = weights . descriptor + bias.

    weights: (F,) float32 in OpenCV's order: blocks and cells column by column, bins fastest. origin: file or name.
    """

    weights: np.ndarray
    bias: float
    origin: str = ""


@dataclass(frozen=True)
class Part:
    """A rectangle of a pyramid level whose windows are scored, in that level's pixels.

    level: (width, height) of the resized picture. x, y: top left pixel, multiples of the window stride from -padding.
    """

    level: tuple[int, int]
    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True)
class People(Table):
    """The people recognized in one frame, one row per person.

    box_px: (N, 4) float64 of the body: x, y of the top left pixel, width, height. score: (N,) probability.
    margin: (N,) the classifier's score. cut: (N,) bool, the border cuts the body: its height is unreliable.
    window_px: (N, 4) the classifier's window around the body.
    """

    box_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    score: np.ndarray = field(default_factory=lambda: np.zeros(0))
    margin: np.ndarray = field(default_factory=lambda: np.zeros(0))
    cut: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    window_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))

    def __len__(self) -> int:
        return len(self.box_px)

    @property
    def feet_px(self) -> np.ndarray:
        """(N, 2) u, v of the point between the feet, from the first pixel's centre: the middle of the lower edge."""
        return self.box_px[:, :2] + self.box_px[:, 2:] * (0.5, 1.0) - 0.5


@dataclass(frozen=True)
class PeopleFrame:
    """The result of searching one frame for people.

    regions_px: (R, 4) the regions searched in addition to the scheduled pyramid levels; None: the whole picture.
    share: windows scored, relative to a full search. cause: why there is no result. adjustments, seconds: as in Scene.
    """

    frame: Frame
    people: People
    regions_px: np.ndarray | None = None
    share: float = 1.0
    cause: str = ""
    adjustments: tuple[Adjustment, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Camera:
    """A camera above the ground, with standard deviations (sigma).

    size_px: (width, height). focal_px: along u and v. centre_px: u, v of the optical axis. k1, k2: OpenCV's radial
    distortion. place: longitude and latitude in degrees if geographic, else local metres east and north.
    heading_rad: clockwise from true north. pitch_rad: below the horizon. roll_rad: clockwise, seen from behind.
    height_m: above ground, NaN if unknown. focal_sigma: relative. position_sigma_m: east and north each.
    takeoff_above_sea_m: where the aerial vehicle took off, NaN if unknown. given: the fields that are known; None:
    those that differ from their defaults.
    """

    name: str
    size_px: tuple[int, int]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    place: tuple[float, float] = (0.0, 0.0)
    geographic: bool = False
    heading_rad: float = 0.0
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    height_m: float = float("nan")
    k1: float = 0.0
    k2: float = 0.0
    focal_sigma: float = 0.01
    height_sigma_m: float = 0.05
    pitch_sigma_rad: float = float(np.radians(0.5))
    heading_sigma_rad: float = float(np.radians(2.0))
    position_sigma_m: float = 1.43
    takeoff_above_sea_m: float = float("nan")
    given: frozenset[str] | None = None

    def knows(self, name: str) -> bool:
        """Whether the value of a field is known, and no default."""
        if self.given is not None:
            return name in self.given
        value, default = getattr(self, name), type(self).__dataclass_fields__[name].default
        return not (value == default or (value != value and default != default))


@dataclass(frozen=True)
class Poses(Table):
    """Poses of a camera, one row per picture or sighting: place (N, 2), heading_rad and pitch_rad (N,) as in Camera."""

    place: np.ndarray
    heading_rad: np.ndarray
    pitch_rad: np.ndarray


@dataclass(frozen=True)
class PoseTable:
    """A camera's poses from a CSV, sorted. at: (N,) frames, or seconds if timed.

    values: arrays (N,) by column: heading_deg, pitch_deg, longitude_deg and latitude_deg or east_m and north_m; the
    camera file's values hold for columns that are not there.
    """

    path: str
    at: np.ndarray
    timed: bool
    values: dict[str, np.ndarray]


@dataclass(frozen=True)
class Sightings(Table):
    """People seen by ground cameras, one row per person and picture, in local metres.

    east_north_m: (N, 2), NaN if the distance is unknown. distance_m: (N,) over ground. bearing_rad: (N,) clockwise
    from north. by: (N,) source of the distance: both, height, feet, or bearing (none).
    The error has three parts: own_m2 (N, 2, 2), the covariance of independent errors; body_m (N, 2), the effect of one
    sigma of body height, common to all sightings of a person; camera_m (N, 2, 6), the effect of one sigma of the
    camera's east, north, heading, pitch, height and focal length, common to all sightings by a camera.
    """

    east_north_m: np.ndarray
    distance_m: np.ndarray
    bearing_rad: np.ndarray
    by: np.ndarray
    own_m2: np.ndarray
    body_m: np.ndarray
    camera_m: np.ndarray

    def __len__(self) -> int:
        return len(self.distance_m)

    @property
    def covariance_m2(self) -> np.ndarray:
        """(N, 2, 2) of all errors together."""
        camera = self.camera_m @ self.camera_m.swapaxes(1, 2)
        return self.own_m2 + self.body_m[:, :, None] * self.body_m[:, None, :] + camera


@dataclass(frozen=True)
class Landmarks(Table):
    """Reports of landmarks (ground vehicles that report their position), one row per report, sorted by frame.

    frame: (N,) float64 from 1, fractional between two pictures. landmark: (N,) int64, index into names.
    image_px: (N, 2) u, v from the first pixel's centre, or NaN. place: (N, 2) longitude and latitude in degrees if
    geographic, else local metres east and north; NaN in a dropout. sigma_m: (N,) per axis, or NaN.
    planned: (N,) bool, a planned waypoint instead of a report. line: (N,) int64, in the file.
    """

    names: tuple[str, ...]
    frame: np.ndarray
    landmark: np.ndarray
    image_px: np.ndarray
    place: np.ndarray
    sigma_m: np.ndarray
    planned: np.ndarray
    line: np.ndarray
    geographic: bool = True
    path: str = ""

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True)
class LandmarkObservations(Table):
    """The landmarks of one frame, one row each; NaN where unseen or unknown.

    landmark: (n,) int64, index into the names. image_px: (n, 2). east_north_m: (n, 2) local metres.
    sigma_m, pixel_sigma: (n,) standard deviations per axis. up_m: (n,) height of the seen point above the local plane.
    """

    landmark: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    image_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    east_north_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    sigma_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    pixel_sigma: np.ndarray = field(default_factory=lambda: np.zeros(0))
    up_m: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.landmark)


@dataclass(frozen=True)
class Colours:
    """Colours of the landmarks: inclusive ranges of hue, saturation and value.

    low, high: (K, 3) int64, hue 0 to 180, others 0 to 255 as in OpenCV; if the low hue exceeds the high one, the range
    wraps around 0.
    """

    names: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class CameraPose:
    """Position and orientation of a camera.

    place_m: (3,) east, north, up in local metres. axes: (3, 3), columns right, down and forward of the camera in east,
    north, up. focal: focal length relative to the Camera's.
    """

    place_m: np.ndarray
    axes: np.ndarray
    focal: float = 1.0

    @property
    def angles_rad(self) -> tuple[float, float, float]:
        """Heading in [0, 2 pi), pitch and roll as in Camera; straight up or down the roll is 0."""
        right, down, forward = np.asarray(self.axes, float).T
        level = float(np.hypot(forward[0], forward[1]))
        pitch = float(np.arctan2(-forward[2], level))
        if level < 1e-9:
            upper = -down if forward[2] < 0 else down
            return float(np.mod(np.arctan2(upper[0], upper[1]), 2 * np.pi)), pitch, 0.0
        heading = float(np.mod(np.arctan2(forward[0], forward[1]), 2 * np.pi))
        return heading, pitch, float(np.arctan2(-right[2], -down[2]))


@dataclass(frozen=True)
class Fix:
    """The georeference of one frame, with its uncertainty.

    time_s: since the clip's first frame, of the moment that the picture shows; NaN: that of the frame's number.
    by: its source: pose, homography, paper, telemetry (no usable landmark), or "" (none: see cause).
    pose, covariance (7, 7): rotation about east, north, up in rad; east, north, up in m; log of the focal length.
    image_from_ground: (3, 3) from local metres to undistorted pixels (paper: distorted), if there is no pose.
    matrix_covariance: (8, 8) of its first eight elements (h33 = 1) in metres from about_m, the landmarks' centre, for
    numerical precision. landmark: (n,) those seen; state of each: used, reassigned or excluded.
    chi2, freedom: consistency of the landmarks with the prediction; NaN and 0 without one.
    changes: what was repaired or excluded, and why. cause: why there is no or only a weak result.
    """

    frame: int
    by: str
    pose: CameraPose | None = None
    covariance: np.ndarray | None = None
    image_from_ground: np.ndarray | None = None
    matrix_covariance: np.ndarray | None = None
    about_m: tuple[float, float] = (0.0, 0.0)
    landmark: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    state: tuple[str, ...] = ()
    chi2: float = float("nan")
    freedom: int = 0
    changes: tuple[str, ...] = ()
    cause: str = ""
    time_s: float = float("nan")

    @property
    def is_used(self) -> tuple[bool, ...]:
        """Whether each landmark seen was used."""
        return tuple(state in ("used", "reassigned") for state in self.state)


@dataclass(frozen=True)
class Elevation:
    """Terrain heights on a grid in local metres.

    up_m: (R, C) above the local plane, rows to the north, columns to the east; NaN where unknown. corner_m: east and
    north of the first cell. step_m: cell size. base_m: the raster's height where up is 0.
    """

    up_m: np.ndarray
    corner_m: tuple[float, float]
    step_m: float
    base_m: float = 0.0


@dataclass(frozen=True)
class Positions(Table):
    """Positions of targets on the ground, one row per sighting, sorted by frame.

    frame: (N,) int64 from 1. target: (N,) int64, the identity, else the row within the frame, from 1.
    east_north_m: (N, 2) local metres. covariance_m2: (N, 2, 2), NaN where unknown. score: (N,) in [0, 1].
    origin_deg: WGS84 longitude and latitude of east = north = 0. lonlat_deg: (N, 2). Both None without an origin.
    label, class_id: (N,) as in Detections.
    """

    frame: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    target: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    east_north_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    covariance_m2: np.ndarray = field(default_factory=lambda: np.zeros((0, 2, 2)))
    score: np.ndarray = field(default_factory=lambda: np.zeros(0))
    origin_deg: tuple[float, float] | None = None
    lonlat_deg: np.ndarray | None = None
    label: np.ndarray = field(default_factory=lambda: np.zeros(0, object))
    class_id: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        _complete(self, len(self.frame), label="", class_id=-1)

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True)
class Ortho:
    """An orthophoto: image (H, W, 3) uint8 BGR; east_north_from_pixel (2, 3), local metres of (u, v, 1)."""

    image: np.ndarray
    east_north_from_pixel: np.ndarray


@dataclass(frozen=True)
class GroundLocations:
    """The people of one frame located from ground cameras.

    positions: fused over cameras. members: (P, V) index of each camera's sighting among those located; -1: none.
    sightings: all, one row per box; vehicle (N,), from 0, is the camera; target, cut, score (N,) and box_px (N, 4) come
    from its table.
    """

    frame: int
    positions: Positions
    members: np.ndarray
    sightings: Sightings
    vehicle: np.ndarray
    target: np.ndarray
    cut: np.ndarray
    score: np.ndarray
    box_px: np.ndarray


@dataclass(frozen=True)
class AerialLocations:
    """The targets of one frame located from the air.

    positions: located targets, with absolute covariance. row: (P,) their rows among the frame's targets.
    relative_m2: (P, 2, 2) covariance relative to the landmarks, without the error common to their receivers.
    velocity_m_s: (P, 2) east, north, NaN if unknown. box_px: (N, 4) of all targets. marks: the landmarks as used.
    adjustments, seconds: as in Scene.
    """

    frame: int
    time_s: float
    positions: Positions
    row: np.ndarray
    relative_m2: np.ndarray
    velocity_m_s: np.ndarray
    box_px: np.ndarray
    fix: Fix
    marks: LandmarkObservations
    adjustments: tuple[Adjustment, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Confirmation:
    """The UGVs' verdict on the blobs of one frame, one row per blob.

    row: (N,) int64 in the blobs' table. kind: human, not_human or unseen, by all observations so far.
    probability: (N,) of being human. seen_by: vehicles with an observation in this frame. people: (N,) int64, the most
    people that a vehicle recognized at it in this frame. nearest_m, nearest_sigmas: (N,) to the nearest person, or NaN.
    best: (N,) highest probability of a person at it, or NaN.
    """

    frame: int
    row: np.ndarray
    kind: tuple[str, ...]
    probability: np.ndarray
    seen_by: tuple[tuple[str, ...], ...]
    people: np.ndarray
    nearest_m: np.ndarray
    nearest_sigmas: np.ndarray
    best: np.ndarray


@dataclass(frozen=True)
class GroundCrowds(Table):
    """The crowds of one frame by the people that ground vehicles see, one row a crowd that was looked at.

    target: (N,) int64 as in Positions. east_north_m: (N, 2) the people's centroid, local metres. velocity_m_s: (N, 2)
    east, north, NaN if unknown. people: (N,) int64, the most that one picture shows. seen_by: (N,) str, the vehicles,
    separated by semicolons. steers: (N,) bool, the air has lost the crowd, so that this steers.
    """

    target: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    east_north_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    velocity_m_s: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    people: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    seen_by: np.ndarray = field(default_factory=lambda: np.zeros(0, object))
    steers: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))

    def __post_init__(self) -> None:
        if len(self.steers) == 0 < len(self.target):
            object.__setattr__(self, "steers", np.zeros(len(self.target), bool))

    def __len__(self) -> int:
        return len(self.target)


@dataclass(frozen=True)
class AppearanceUse:
    """Whether the association of a frame looked at the targets' appearance, and the reason.

    weight: of their locations in the source's association; NaN in the default one, where appearance adds to scores.
    location_dispersion, appearance_dispersion: of the source's rule, in [0, 1]; NaN where not computed.
    """

    looked: bool
    cause: str
    weight: float = float("nan")
    location_dispersion: float = float("nan")
    appearance_dispersion: float = float("nan")


@dataclass(frozen=True)
class Tracks(Boxes):
    """The targets of one frame with identities, one row per target.

    identity: (N,) int64 from 1, unique within a run. box_px, score: as in Detections.
    row: (N,) int64, its row in the frame's detections; -1 for a box that bridges a gap.
    link: (N,) in [0, 1], confidence that the box belongs to the identity that it continues, and not to another one that
    could have taken it. NaN for the first box of a track, for a bridging box, and where unknown.
    label, class_id: of the detection, as there; of a bridging box those of the identity before. frame: its number, of
    a table that `concat` joins (N,).
    appearance: whether it was looked at; None where there was no choice: nothing to link, or no picture.
    """

    frame: int
    identity: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    box_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    score: np.ndarray = field(default_factory=lambda: np.zeros(0))
    row: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    link: np.ndarray = field(default_factory=lambda: np.zeros(0))
    appearance: AppearanceUse | None = None
    label: np.ndarray = field(default_factory=lambda: np.zeros(0, object))
    class_id: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        _complete(self, len(self.identity), link=np.nan, label="", class_id=-1)

    def __len__(self) -> int:
        return len(self.identity)

    @property
    def id(self) -> np.ndarray:
        """(N,) the identities."""
        return self.identity


@dataclass(frozen=True)
class Scene:
    """The result of motion detection for one frame.

    mask: (H, W) uint16, 0 background, i + 1 = row i of the detections.
    reliable: False if registration failed: then the mask is empty and `cause` says why.
    interval_frames: the detection interval in force. seconds: time spent per stage.
    step: background motion since the previous frame, or None.
    core: (H, W) bool, the mask before gaps and hulls are filled; None: the same as the mask.
    repeats: the number of the earlier frame whose picture this one repeats, and whose result it has; 0: none. It is no
    look at the scene: leave it out of what follows targets.
    """

    frame: Frame
    mask: np.ndarray
    detections: Detections
    interval_frames: int
    reliable: bool = True
    cause: str = ""
    adjustments: tuple[Adjustment, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    step: Registration | None = None
    core: np.ndarray | None = None
    repeats: int = 0

    @property
    def camera_motion(self) -> np.ndarray | None:
        """(3, 3) pixel homography from the frame before to this one; None where it is unknown."""
        return self.step.later_from_earlier if self.step is not None and self.step.reliable else None


@dataclass(frozen=True)
class TrackedFrame:
    """The result of tracking for one frame.

    number: 1-based position in the clip. frame: the picture, or None. detections: the tracker's input.
    tracks: those with an identity, and boxes that bridge gaps.
    now_from_before: (3, 3) pixel homography from the frame tracked before; None: no motion, or unknown.
    lines: (N,) int64, lines of the detections in their file; empty for own ones.
    cause: why there is no result. adjustments, seconds, repeats: as in Scene.
    """

    number: int
    frame: Frame | None
    detections: Detections
    tracks: Tracks
    now_from_before: np.ndarray | None = None
    lines: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    cause: str = ""
    adjustments: tuple[Adjustment, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    repeats: int = 0

    @property
    def untracked(self) -> list[int]:
        """The rows of the detections that have no identity."""
        tracked = set(self.tracks.row.tolist())
        return [row for row in range(len(self.detections)) if row not in tracked]


@dataclass(frozen=True)
class FrameResult:
    """The result of the whole pipeline for one frame.

    tracked: its targets, without the landmarks. locations: where they are on the ground; None if nothing locates them.
    sighted_by: (n,) how each landmark of locations.marks was seen: motion, colour or table.
    mark_lonlat_deg: (n, 2) positions of the landmarks; None without a geographic origin.
    confirmed: the UGVs' verdict on each row of locations.positions; None without UGV cameras.
    crowds: by the people that the UGVs see; None without UGV cameras.
    command: the order to the vehicles after this frame; None: no change.
    """

    tracked: TrackedFrame
    locations: AerialLocations | None = None
    sighted_by: tuple[str, ...] = ()
    mark_lonlat_deg: np.ndarray | None = None
    confirmed: Confirmation | None = None
    command: "Command | None" = None
    crowds: GroundCrowds | None = None

    @property
    def frame(self) -> Frame | None:
        """The frame; None where it could not be read."""
        return self.tracked.frame

    @property
    def number(self) -> int:
        """1-based number of the frame."""
        return self.tracked.number

    @property
    def repeats(self) -> int:
        """As in Scene."""
        return self.tracked.repeats

    @property
    def tracks(self) -> Tracks:
        """The targets of the frame with their identities."""
        return self.tracked.tracks

    @property
    def adjustments(self) -> tuple[Adjustment, ...]:
        """The changes of parameters at the frame, with their causes."""
        return self.tracked.adjustments if self.locations is None else self.locations.adjustments


@dataclass(frozen=True)
class Order:
    """An order to a ground vehicle: drive to a goal and look at a point.

    goal, look_at: (2,) in the vehicles' own coordinates, longitude and latitude or local metres; look_at None: ahead.
    picture: whether a picture is requested.
    """

    vehicle: str
    goal: np.ndarray
    speed_m_s: float
    look_at: np.ndarray | None = None
    picture: bool = False


@dataclass(frozen=True)
class Command:
    """A command to the vehicles; a simulator executes it, a recording ignores it. None: no change.

    every: process every so many frames. fly_to: (2,) position of the UAV. look_at: (2,) ground point in the picture's
    centre. Coordinates as in Order.
    """

    every: int = 1
    fly_to: np.ndarray | None = None
    look_at: np.ndarray | None = None
    altitude_m: float | None = None
    orders: tuple[Order, ...] = ()


@dataclass(frozen=True)
class GroundPicture:
    """A ground vehicle's picture at a frame of the aerial camera; camera has the reported pose at that moment."""

    vehicle: str
    frame: int
    image: np.ndarray
    camera: Camera


@dataclass(frozen=True)
class Bodies:
    """Everything that moves in a simulated world at one moment, one row per body.

    number: (N,) int64 from 1, constant. kind: (N,) person, car or ugv. target: (N,) int64 from 1, shared by the people
    of a crowd. place_m: (N, 3) of the feet, local east, north, up. velocity_m_s: (N, 2). facing_rad: (N,) clockwise
    from north. height_m: (N,) of a person. phase: (N,) of the gait, in strides. colour: (N, 3) BGR, 0 to 255.
    plate: (N, 3) BGR of a landmark's marker, or NaN. hidden: (N,) bool, the marker is covered.
    """

    number: np.ndarray
    kind: np.ndarray
    target: np.ndarray
    place_m: np.ndarray
    velocity_m_s: np.ndarray
    facing_rad: np.ndarray
    height_m: np.ndarray
    phase: np.ndarray
    colour: np.ndarray
    plate: np.ndarray
    hidden: np.ndarray

    def __len__(self) -> int:
        return len(self.number)


@dataclass(frozen=True)
class Truth:
    """Ground truth of a simulated frame.

    mask: (H, W) uint16, target number of each pixel, or 0. people: (H, W), body number. bodies: all in the world.
    pose: of the camera at mid-exposure. events: faults, crowds that join or split, in words.
    """

    frame: int
    time_s: float
    mask: np.ndarray
    people: np.ndarray
    bodies: Bodies
    pose: CameraPose
    events: tuple[str, ...] = ()
