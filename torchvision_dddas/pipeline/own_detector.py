"""Scenes from the user's own detector or table of boxes, instead of the motion detector."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from torchvision_dddas.config import Settings, changes
from torchvision_dddas.errors import InputError
from torchvision_dddas.tracking import CameraMotion, Registrar
from torchvision_dddas.types import Detections, DetectionTable, Frame, Registration, Scene, as_picture, is_sampled

Detector = Callable[[Frame], Any]
"""A function that returns Detections of a frame, or a result that `Detections.from_supervision` accepts."""


class OwnDetector:
    """Turn frames into scenes by a function or a table. Pass the frames in order. Each scene is returned at once.

    The camera's motion is registered as for `Tracker`. A frame that is not sampled gets no detections.
    """

    def __init__(
        self, detect: Detector | DetectionTable, registrar: Registrar, *, interval: int = 1, rate_hz: float = 10.0
    ) -> None:
        """detect: called with each sampled frame, or the boxes of a clip. rate_hz: for frames that come as images."""
        self._detect, self._interval, self._rate_hz = detect, interval, rate_hz
        self._camera, self._last = CameraMotion(registrar), 0

    def update(self, frame: Frame | np.ndarray) -> list[Scene]:
        """Return the scene of the next frame. Raise InputError for a bad picture or a bad result."""
        image = as_picture(frame.image if isinstance(frame, Frame) else frame)
        if isinstance(frame, Frame):
            frame = replace(frame, image=image)
        else:
            frame = Frame(self._last + 1, self._last / self._rate_hz, image)
        is_first, self._last = not self._last, frame.number
        start = time.perf_counter()
        motion, cause = self._camera.update(image)
        step = Registration(np.eye(3) if motion is None else motion, 0, 0, 0.0, 0.0, not cause, cause)
        registered = time.perf_counter()
        is_tracked = is_sampled(frame.number, self._interval)
        found = run_detector(self._detect, frame) if is_tracked else Detections(kind="given")
        seconds = {"register": registered - start, "detect": time.perf_counter() - registered}
        mask = np.broadcast_to(np.uint16(0), image.shape[:2])
        return [
            Scene(frame, mask, found, self._interval, cause=cause, seconds=seconds, step=None if is_first else step)
        ]

    def flush(self) -> list[Scene]:
        """Return nothing, because no scene waits."""
        return []


def run_detector(detect: Detector | DetectionTable, frame: Frame) -> Detections:
    """Return the detections of a frame by a detector or a table, with the kind `given`.

    Raises InputError for results of another kind.
    """
    if isinstance(detect, DetectionTable):
        return detect.at(frame.number)
    found = detect(frame)
    if found is None or isinstance(found, np.ndarray | list | tuple):
        raise InputError(
            f"the detector returned {type(found).__name__} for frame {frame.number}; return td.Detections, or a "
            "result that td.Detections.from_supervision accepts; from a list of results, give the one of this frame"
        )
    # Scores of targets found by their motion would count as certain.
    return replace(found, kind="given") if isinstance(found, Detections) else Detections.from_supervision(found)


_OF_MOTION = ("interval", "difference", "morphology", "refine", "tracklets", "small", "history", "gates")
"""The groups of settings that only the motion detector uses."""


def note_unused(settings: Settings, used: Sequence[str] = ()) -> list[str]:
    """Return a note on changed settings that have no effect without the motion detector.

    used: parameters of these groups that another part of the run uses.
    """
    names = [name for name in changes(settings) if name.split(".")[0] in _OF_MOTION and name not in used]
    if not names:
        return []
    verb = "has" if len(names) == 1 else "have"
    return [f"{', '.join(names)} {verb} no effect, because the boxes are given and no motion is searched for"]
