"""A target's outline from two explanations of every pixel: it stands still, or it moves with the target.

Pixels that only the target's motion explains are foreground, those that the background explains are background; the
rest (flat insides, places that only one picture shows) follow their colours.
"""

import cv2
import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.detection.blob_motion import Motion
from torchvision_dddas.detection.blobs import Blob
from torchvision_dddas.detection.domain_transform import spread

_CAP = 15.0
# The smoothing window sees this much of the surroundings, px.
_PAD = 24


def refine(
    blob: Blob,
    motion: Motion,
    image: np.ndarray,
    grey: np.ndarray,
    evidence: np.ndarray,
    wide: np.ndarray,
    texture: np.ndarray,
    warped: tuple[np.ndarray, np.ndarray],
    scale: float,
    settings: Settings,
) -> np.ndarray:
    """The refined mask inside the blob's box, (height, width) bool; never outside the blob's own mask.

    image: (H, W, 3) or (H, W) uint8. evidence, wide: (H, W) uint8, `scale` x noise units. texture: 4 x grey levels a
    pixel. warped: the two neighbours whose motion `motion.affine` describes, registered and in equal exposure.
    """
    x, y, width, height = blob.box
    box = blob.window
    parameters = settings.difference
    slope = texture[box].astype(np.float32) / 4
    noise = np.sqrt(parameters.noise_levels**2 + (parameters.gradient_share * slope) ** 2)
    own = grey[box]
    still = cv2.blur(np.minimum(*(_misfit(own, w[box], noise) for w in warped)), (3, 3))
    moved = [_moved(w, fit, motion.frame, blob.box) for w, fit in zip(warped, motion.affine, strict=True)]
    moving = cv2.blur(np.minimum(*(_misfit(own, w, noise) for w in moved)), (3, 3))
    near, far = evidence[box] / np.float32(scale), wide[box] / np.float32(scale)
    foreground = np.clip((near - 2) / 2, 0, 1) * np.clip(1.5 - moving / np.maximum(still, 1), 0, 1)
    filled = np.clip((far - 2) / 2, 0, 1) * np.clip(1.5 - moving / 2, 0, 1)
    foreground = np.where(foreground < 0.2, np.maximum(foreground, filled), foreground) * blob.mask
    background = np.clip(slope / 8, 0, 1) * np.clip(1 - near / 2, 0, 1) * np.clip(0.5 + (moving - still) / 2, 0, 1)
    background *= np.clip(1 - far / 3, 0, 1)
    background[~blob.mask] = 1

    left, top = max(x - _PAD, 0), max(y - _PAD, 0)
    right, bottom = min(x + width + _PAD, grey.shape[1]), min(y + height + _PAD, grey.shape[0])
    seeds = np.zeros((bottom - top, right - left, 2), np.float32)
    seeds[..., 1] = 1
    seeds[y - top : y - top + height, x - left : x - left + width] = np.dstack([foreground, background])
    half = max((right - left) // 2, 1), max((bottom - top) // 2, 1)
    guide = cv2.resize(image[top:bottom, left:right], half, interpolation=cv2.INTER_AREA)
    seeds = cv2.resize(seeds, half, interpolation=cv2.INTER_AREA)
    weight = spread(seeds, guide, settings.refine.spatial_px / 2, settings.refine.colour_levels)
    share = weight[..., 0] / (weight[..., 0] + weight[..., 1] + 1e-6)
    share = cv2.resize(share, (right - left, bottom - top))
    inside = share[y - top : y - top + height, x - left : x - left + width]
    return (inside > settings.refine.share) & blob.mask


def _misfit(a: np.ndarray, b: np.ndarray, noise: np.ndarray) -> np.ndarray:
    return np.minimum(cv2.absdiff(a, b) / noise, _CAP).astype(np.float32)


def _moved(
    picture: np.ndarray, affine: np.ndarray, frame: tuple[float, float, float], box: tuple[int, int, int, int]
) -> np.ndarray:
    """The part of a picture that the target's motion brings into its box."""
    x, y, width, height = box
    centre_u, centre_v, scale = frame
    shift, by_u, by_v = affine
    # u + shift + by_u (u - cu) / s + by_v (v - cv) / s, with (u, v) counted from the box's corner
    linear = np.eye(2) + np.c_[by_u, by_v] / scale
    origin = np.array([x, y]) + shift + np.c_[by_u, by_v] @ np.array([x - centre_u, y - centre_v]) / scale
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(picture, np.c_[linear, origin], (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
