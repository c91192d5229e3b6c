"""Frames of a clip, their registration, adjustments, and scenes, which are the results of a detector."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol, overload

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types.detections import Detections
from torchvision_dddas.types.record import Record


@dataclass(frozen=True)
class Frame(Record):
    """One picture of a clip.

    number: 1-based position in the clip. time_s: seconds since the clip's first frame.
    image: uint8, (H, W) grey or (H, W, 3) BGR. skipped: number of frames before it that were left out on purpose.
    taken_s: capture time by the monotonic clock; NaN for a recording. damaged: the decoder concealed errors in it, or
    in an earlier picture that it depends on.

    >>> td.Frame(1, 0.0, np.zeros((480, 640, 3), np.uint8))
    Frame(number=1, time_s=0, image: 480x640x3 0)
    """

    number: int
    time_s: float
    image: np.ndarray
    skipped: int = 0
    taken_s: float = float("nan")
    damaged: bool = False


def as_picture(image: Any, *, name: str = "frame") -> np.ndarray:
    """Return a picture in the form that all parts use: uint8, (H, W) or (H, W, 3) BGR; (H, W, 1) becomes (H, W).

    Raise InputError for anything else, with the code that converts it; `frame` in this code is the given value.

    >>> types.as_picture(np.zeros((48, 64, 1), np.uint8)).shape
    (48, 64)
    >>> types.as_picture(np.zeros((48, 64)))
    Traceback (most recent call last):
        ...
    torchvision_dddas.errors.InputError: frame must be uint8 of shape (H, W) or (...
    """
    if isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.size:
        if image.ndim == 2 or image.shape[2:] == (3,):
            return image
        if image.shape[2:] == (1,):
            return image[..., 0]
    if image is None:  # OpenCV returns None for a file that it cannot read
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
        code += "[..., ::-1]" if shape[2] == 3 else ""  # the colours of such arrays are RGB
    if len(shape) == 3 and shape[2] == 4:
        code = f"{code}[..., :3]"
    elif len(shape) == 3 and shape[2] not in (1, 3):
        raise InputError(f"{name} must be uint8 of shape (H, W) or (H, W, 3), got {what}; choose its channels")
    values = np.nan_to_num(image)
    low, high = float(values.min()), float(values.max())
    if image.dtype.kind in "fb" and low >= 0 and high <= 1:
        code = f"(np.nan_to_num({code}) * 255.0).round().astype(np.uint8)"
    elif image.dtype != np.uint8 and low >= 0 and high <= 255:
        code = f"np.nan_to_num({code}).round().astype(np.uint8)"
    elif image.dtype != np.uint8:  # use one range for the whole clip, or it flickers
        gain = 255 / (high - low or 1)
        code = f"((np.clip({code}, {low:.0f}, {high:.0f}) - {low:.0f}) * {gain:.6g}).astype(np.uint8)"
    raise InputError(f"{name} must be uint8 of shape (H, W) or (H, W, 3), got {what}; convert it: {code}")


@dataclass(frozen=True)
class Problem(Record):
    """A recoverable fault while reading a clip: the first affected frame, from 1, and a description.

    >>> str(types.Problem(12, "frame 12 cannot be decoded"))
    'frame 12 cannot be decoded'
    """

    frame: int
    what: str

    def __str__(self) -> str:
        return self.what


class Source(Protocol):
    """A clip that is read frame by frame.

    Iteration yields frames in order, numbered from 1, without the frames that cannot be decoded.
    count: announced frames, None if unknown. exact: whether the count is reliable. size: (width, height), px.
    last: the last frame that was read; after the end of the clip its last frame, decoded or not.
    problems: filled during reading; each new iteration starts at frame 1 and clears it.
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
        """Yield frames 1, 1 + interval, ... Other frames are not decoded if this can be avoided."""
        ...


@overload
def is_sampled(frame: int, interval: int) -> bool: ...
@overload
def is_sampled(frame: np.ndarray, interval: int) -> np.ndarray: ...
def is_sampled(frame: int | np.ndarray, interval: int) -> bool | np.ndarray:
    """Return whether a frame number, or each number of an array, is one of 1, 1 + interval, 1 + 2 interval, ...

    >>> types.is_sampled(np.arange(1, 8), 3)
    array([ True, False, False,  True, False, False,  True])
    """
    return (frame - 1) % interval == 0


@dataclass(frozen=True)
class Registration(Record):
    """The background's motion from one frame to a later frame.

    later_from_earlier: (3, 3) float64 homography on pixel coordinates (u, v, 1).
    tracked, inliers: numbers of keypoints tracked, and of inliers, which fit the homography.
    error_px: median error of the inliers. flow_px: median background displacement. cause: why it is unreliable.

    >>> td.Registration(np.eye(3), tracked=120, inliers=110, error_px=0.2, flow_px=3.5)
    Registration(later_from_earlier: 3x3 0 to 1, tracked=120, inliers=110, error_px=0.2, flow_px=3.5)
    """

    later_from_earlier: np.ndarray
    tracked: int
    inliers: int
    error_px: float
    flow_px: float
    reliable: bool = True
    cause: str = ""


@dataclass(frozen=True)
class Adjustment(Record):
    """A change of a parameter by feedback at a frame, and the reason.

    >>> change = td.Adjustment(12, "interval.frames", 3, 5, "altitude 50 m")
    >>> change.describe()
    'interval.frames 3 -> 5'
    """

    frame: int
    parameter: str
    old: float
    new: float
    cause: str

    def describe(self) -> str:
        """Return the change in words; a bound that is not set is "none"."""
        old, new = (f"{value:.5g}" if math.isfinite(value) else "none" for value in (self.old, self.new))
        return f"{self.parameter} {old} -> {new}"


@dataclass(frozen=True)
class Scene(Record):
    """The result of motion detection for one frame.

    mask: (H, W) uint16, 0 background, i + 1 = row i of the detections.
    reliable: False if the frame could not be registered to the previous frame, as at a cut; `cause` says why. It is
    then compared only with later frames; without later frames its mask is empty.
    interval_frames: the detection interval in force. seconds: time spent per stage.
    step: background motion since the previous frame, or None.
    core: (H, W) bool, the mask before gaps and hulls are filled; None: the same as the mask.
    repeats: the number of the earlier frame whose picture this one repeats, and whose result it has; 0: none. Do not
    pass a repeated frame to code that follows targets.

    >>> image = np.zeros((48, 64), np.uint8)
    >>> scene = td.Scene(td.Frame(1, 0.0, image), image.astype(np.uint16), td.Detections(), interval_frames=3)
    >>> len(scene.detections), scene.camera_motion is None
    (0, True)
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
        """The (3, 3) pixel homography from the previous frame to this frame; None if unknown."""
        return self.step.later_from_earlier if self.step is not None and self.step.reliable else None
