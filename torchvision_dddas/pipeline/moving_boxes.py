"""Combine the boxes of the user's detector with the movers that the motion detector found."""

from collections import deque
from dataclasses import replace

import numpy as np

from torchvision_dddas.geometry import shared_px, window_of
from torchvision_dddas.pipeline.own_detector import Detector, run_detector
from torchvision_dddas.types import Detections, DetectionTable, Scene, is_sampled

_COVERED = 1 / 3  # least share of a moving box that its mover covers (hulls fill two thirds or more, but miss parts)
_ALIKE = 0.1  # least intersection over union of a box and its mover's box; a walker in front of a bus has less
_SCORES = 500  # number of latest scores of boxes, whose median is the score of movers


class MovingBoxes:
    """Adds the boxes of another detector to scenes of the motion detector. Pass the scenes in order.

    A box moves if a mover covers at least the share _COVERED of it, or if the intersection over union of their boxes is
    at least _ALIKE. The box then gets the mover's speed and heading. Other boxes have the speed 0, or NaN in unreliable
    scenes. A mover is kept if it gave no box its motion, and less than half of it lies in boxes. Its score is the
    median score of the latest boxes, so that neither kind is trusted more.
    """

    def __init__(self, detect: Detector | DetectionTable, interval: int = 1) -> None:
        """detect, interval: as in `OwnDetector`."""
        self._detect, self._interval = detect, interval
        self._scores: deque[float] = deque(maxlen=_SCORES)

    def combine(self, scene: Scene) -> Scene:
        """Return the scene with the boxes, then the movers without a box. The mask keeps only these movers."""
        moving, mask = scene.detections, scene.mask
        if not is_sampled(scene.frame.number, self._interval):
            return replace(scene, detections=replace(moving, kind="given"))
        boxes = run_detector(self._detect, scene.frame)
        speed, heading = np.full(len(boxes), 0.0 if scene.reliable else np.nan), np.full(len(boxes), np.nan)
        is_boxed, has_own = np.zeros(mask.shape, bool), np.zeros(len(moving), bool)
        area = moving.box_px[:, 2:].prod(axis=1)
        for row, box in enumerate(boxes.box_px):
            window = window_of(box, mask.shape)
            is_boxed[window] = True
            covered = np.bincount(mask[window].ravel(), minlength=len(moving) + 1)[1:]
            shared = shared_px(box, moving.box_px)
            alike = shared / (box[2:].prod() + area - shared)
            fit = np.maximum(covered / max(mask[window].size, 1) / _COVERED, alike / _ALIKE)
            if fit.max(initial=0) >= 1:
                best = fit.argmax()
                has_own[best] = True
                speed[row], heading[row] = moving.speed_px[best], moving.heading_rad[best]
        whole, inside = (np.bincount(m, minlength=len(moving) + 1)[1:] for m in (mask.ravel(), mask[is_boxed]))
        rest = np.flatnonzero(~has_own & (2 * inside < whole))
        self._scores.extend(boxes.score.tolist())
        usual = float(np.median(self._scores)) if self._scores else 1.0
        apart = replace(moving[rest], kind="given", score=np.full(len(rest), usual))
        row_of = np.zeros(len(moving) + 1, mask.dtype)
        row_of[rest + 1] = len(boxes) + 1 + np.arange(len(rest))
        found = Detections.concat([replace(boxes, speed_px=speed, heading_rad=heading), apart])
        return replace(scene, detections=found, mask=row_of[mask])
