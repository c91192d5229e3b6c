"""The plain OpenCV chain for speed comparisons. It computes every three-frame window from scratch."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

KEYPOINTS, THRESHOLD, LEAST_AREA_PX, RANSAC_PX = 500, 20, 100, 2.0


def ellipse(side: int) -> np.ndarray:
    """Return a morphological kernel."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def keypoints(grey: np.ndarray) -> np.ndarray:
    """Return (N, 1, 2) float32 good features to track."""
    found = cv2.goodFeaturesToTrack(grey, KEYPOINTS, qualityLevel=0.01, minDistance=8)
    return np.zeros((0, 1, 2), np.float32) if found is None else found


def register(grey: np.ndarray, later: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return grey_from_later (3, 3) by pyramidal Lucas-Kanade and RANSAC, or the identity with too few points."""
    if not len(start):
        return np.eye(3)
    nothing: Any = None
    end, found, _ = cv2.calcOpticalFlowPyrLK(grey, later, start, nothing, winSize=(21, 21), maxLevel=3)
    good = found[:, 0] == 1
    if np.count_nonzero(good) < 8:
        return np.eye(3)
    grey_from_later, _ = cv2.findHomography(end[good], start[good], cv2.RANSAC, RANSAC_PX)
    return np.eye(3) if grey_from_later is None else grey_from_later


def plain_window(
    first: np.ndarray, second: np.ndarray, third: np.ndarray, lap: Callable[[str], None] = lambda stage: None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mask (H, W) uint8 of motion in the first of three BGR frames, and boxes (N, 4) x, y, width, height.

    lap: called with the name of each stage at its end.
    """
    greys = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (first, second, third)]
    lap("prepare")
    height, width = greys[0].shape
    start = keypoints(greys[0])
    homographies = [register(greys[0], later, start) for later in greys[1:]]
    lap("register")
    seen = np.full((height, width), 255, np.uint8)
    difference = seen.copy()
    for later, homography in zip(greys[1:], homographies, strict=True):
        warped = cv2.warpPerspective(later, homography, (width, height))
        full = np.full((height, width), 255, np.uint8)
        seen &= cv2.warpPerspective(full, homography, (width, height), flags=cv2.INTER_NEAREST)
        difference = cv2.min(difference, cv2.absdiff(greys[0], warped))
    seen = cv2.erode(seen, np.ones((9, 9), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    smooth = cv2.bitwise_and(cv2.GaussianBlur(difference, (7, 7), 0), seen)
    mask = cv2.threshold(smooth, THRESHOLD, 255, cv2.THRESH_BINARY)[1]
    mask = cv2.morphologyEx(cv2.erode(mask, ellipse(3)), cv2.MORPH_CLOSE, ellipse(15))
    lap("foreground")
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    large = np.zeros(count, np.uint8)
    large[1:] = np.where(stats[1:, cv2.CC_STAT_AREA] >= LEAST_AREA_PX, 255, 0)
    outlines, _ = cv2.findContours(large[labels], cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    hulls = np.zeros((height, width), np.uint8)
    for outline in outlines:
        cv2.fillConvexPoly(hulls, cv2.convexHull(outline), 255)
    lap("targets")
    return hulls, stats[1:, :4][stats[1:, cv2.CC_STAT_AREA] >= LEAST_AREA_PX].astype(float)
