"""How far registrations lie from a careful one: the mean displacement over the picture's four corners, in pixels.

The careful registration follows up to 3000 corners from frame to frame and back through a wide window to a thousandth
of a pixel, takes them for background by MAGSAC and fits the inliers thrice at a shrinking tolerance. Errors are those
of frames one and two apart; ours two apart are composed of two steps, as the loop composes them.
"""

from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import plain_chain

from torchvision_dddas.config import load_config
from torchvision_dddas.detection import load_engine
from torchvision_dddas.geometry import transfer


def errors(frames: list[np.ndarray], configs: tuple[str, ...] = ("fast", "default")) -> dict[str, dict[str, float]]:
    """{"plain": {"median", "p90", "pairs"}, "fast": ..., "default": ...} over all pairs of a clip."""
    greys = [cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) for frame in frames]
    apart = [(i, i + gap) for gap in (1, 2) for i in range(len(greys) - gap)]
    tried = {(a, b): carefully(greys[a], greys[b]) for a, b in apart}
    careful = {pair: found for pair, found in tried.items() if found is not None}
    known = list(careful)
    found = {"plain": {pair: np.linalg.inv(plain(greys[pair[0]], greys[pair[1]])) for pair in known}}
    for config in configs:
        steps = onboard(frames, config)
        found[config] = {(a, b): np.linalg.multi_dot([np.eye(3), *steps[a:b][::-1]]) for a, b in known}
    height, width = greys[0].shape
    table = {}
    for name, ours in found.items():
        off = [distance(ours[pair], careful[pair], width, height) for pair in known]
        table[name] = {"median": float(np.median(off)), "p90": float(np.percentile(off, 90)), "pairs": len(off)}
    return table


def plain(grey: np.ndarray, later: np.ndarray) -> np.ndarray:
    """grey_from_later of the plain chain."""
    return plain_chain.register(grey, later, plain_chain.keypoints(grey))


def onboard(frames: list[np.ndarray], config: str) -> list[np.ndarray]:
    """later_from_earlier of successive frames."""
    engine = load_engine("onboard", load_config(None if config == "default" else config))
    views = [engine.prepare(frame) for frame in frames]
    return [engine.register([pair])[0].later_from_earlier for pair in pairwise(views)]


def carefully(grey: np.ndarray, later: np.ndarray) -> np.ndarray | None:
    """later_from_grey, or None where fewer than 50 points agree."""
    start: Any = cv2.goodFeaturesToTrack(grey, 3000, 0.001, 5, blockSize=5)
    if start is None:
        return None
    search: dict[str, Any] = {"winSize": (31, 31), "maxLevel": 5, "criteria": (3, 100, 1e-3)}
    end, there, _ = cv2.calcOpticalFlowPyrLK(grey, later, start, start.copy(), **search)
    back, again, _ = cv2.calcOpticalFlowPyrLK(later, grey, end, start.copy(), **search)
    good = (there[:, 0] == 1) & (again[:, 0] == 1) & (np.linalg.norm(back - start, axis=2)[:, 0] < 0.3)
    start, end = start[good, 0].astype(np.float64), end[good, 0].astype(np.float64)
    if len(start) < 50:
        return None
    found: Any = cv2.findHomography(start, end, cv2.USAC_MAGSAC, 2.0, maxIters=10_000, confidence=0.9999)[0]
    for tolerance in (2.0, 1.0, 0.5):
        if found is None:
            return None
        near = np.linalg.norm(transfer(found, start) - end, axis=1) < tolerance
        if near.sum() < 50:
            return None
        found = cv2.findHomography(start[near], end[near], 0)[0]
    return found


def distance(a: np.ndarray, b: np.ndarray, width: int, height: int) -> float:
    """Mean distance of two homographies over the corners of a picture."""
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], float)
    return float(np.linalg.norm(transfer(a, corners) - transfer(b, corners), axis=1).mean())
