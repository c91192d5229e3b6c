"""The protocol and records of engines, which compute on pixels, and the checks of a registration that they share."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import cv2
import numpy as np

from torchvision_dddas.chain import Maps, View, Window
from torchvision_dddas.config import RegistrationParameters, Settings
from torchvision_dddas.detection.blobs import Blob
from torchvision_dddas.geometry import background_flow, transfer
from torchvision_dddas.types import Registration


@dataclass(frozen=True)
class Foreground(Maps[np.ndarray]):
    """The detection chain's maps of a window, and the engine's own results. Maps are (H, W) uint8, masks 0 or 255.

    offsets: frame offsets of the `warped` neighbours from the reference frame. scale: side of a map pixel in frame
    pixels; above 1 only if the maps serve for blobs alone. blobs: set if the engine itself finds the blobs. Then
    evidence, wide and texture are filled only inside the blobs' boxes, `core` only if a motion history needs it, and
    `warped` only if outlines need it; all are 0 elsewhere.
    """

    offsets: tuple[int, int] = (0, 0)
    scale: int = 1
    blobs: list[Blob] | None = None


EngineView = TypeVar("EngineView", bound=View)


def grey_of(image: np.ndarray) -> np.ndarray:
    """Return the grey levels (H, W) of a picture, (H, W) or (H, W, 3) BGR."""
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image


class Engine(Protocol[EngineView]):
    """The operations of an engine. They take and return lists, so that an engine may batch.

    parameters: the current settings. They may be replaced between two frames.
    """

    name: str
    parameters: Settings

    def prepare(self, image: np.ndarray) -> EngineView:
        """Return the view of a frame, with its grey picture."""
        ...

    def register(self, pairs: Sequence[tuple[EngineView, EngineView]]) -> list[Registration]:
        """Return the background's motion from the first to the second frame of each pair."""
        ...

    def foreground(self, windows: Sequence[Window[EngineView]]) -> list[Foreground]:
        """Return the maps that show moving pixels in each window's reference frame."""
        ...


def judge_points(
    later_from_earlier: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    size: tuple[int, int],
    parameters: RegistrationParameters,
) -> tuple[Registration, np.ndarray]:
    """Judge whether a registration is reliable. Return its record, with the cause if it is not, and its (N,) inliers.

    start, end: (N, 2) tracked keypoints in the earlier and the later frame. With fewer than four keypoints the
    registration is unreliable for every matrix. size: (width, height).
    """
    tracked, error_px, flow_px, cause = len(start), float("inf"), float("nan"), ""
    if tracked < 4:
        later_from_earlier, inliers = np.eye(3), np.zeros(tracked, bool)
    else:
        miss = np.linalg.norm(transfer(later_from_earlier, start) - end, axis=1)
        inliers = miss < parameters.ransac_px
        error_px = float(np.median(miss[inliers])) if inliers.any() else error_px
    count = int(inliers.sum())
    if tracked < parameters.min_inliers:
        cause = f"only {tracked} keypoints could be tracked, {parameters.min_inliers} are needed"
    elif count < parameters.min_inliers or count < parameters.min_inlier_share * tracked:
        cause = f"only {count} of {tracked} keypoints agree on one background motion"
    elif not _is_plausible(later_from_earlier, size):
        cause = "no camera motion can produce the background motion that was found"
    else:
        flow_px = background_flow(later_from_earlier, size)
    return Registration(later_from_earlier, tracked, count, error_px, flow_px, not cause, cause), inliers


def _is_plausible(later_from_earlier: np.ndarray, size: tuple[int, int]) -> bool:
    """Return whether a homography keeps the picture's outline convex and upright, and its area within a factor of 2."""
    width, height = size
    corners = transfer(later_from_earlier, np.array([[0, 0], [width, 0], [width, height], [0, height]], float))
    if not np.isfinite(corners).all():
        return False
    following = np.roll(corners, -1, axis=0)
    (u, v), (after_u, after_v) = (following - corners).T, np.roll(following - corners, -1, axis=0).T
    area = 0.5 * (corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]).sum()
    return bool((u * after_v - v * after_u > 0).all() and 0.5 < area / (width * height) < 2.0)
