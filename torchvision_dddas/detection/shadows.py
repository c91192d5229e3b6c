"""Cast shadows: darker ground of unchanged colour, told from the target by what the ground looks like without it."""

from collections.abc import Sequence

import cv2
import numpy as np

# A shadow leaves this share of the light on the ground ...
_LIGHT_LEFT = (0.25, 0.85)
# ... in every colour alike, to this share of it.
_COLOURS_ALIKE = 0.1
# The two looks at the bare ground agree to so many grey levels.
_GROUNDS_ALIKE = 12
# What is left must be at least this share of the mask: otherwise the target itself is dark.
_LEAST_LEFT = 0.35
# Crumbs smaller than this share of the largest part left go with the shadow.
_CRUMB = 0.15


def without_shadow(
    mask: np.ndarray,
    box: tuple[int, int, int, int],
    image: np.ndarray,
    grounds: Sequence[np.ndarray],
    ground_from_image: Sequence[np.ndarray],
) -> np.ndarray:
    """The target's mask without its cast shadow; the mask itself where no shadow can be told.

    mask: (height, width) bool inside box = x, y, width, height of image, (H, W, 3) uint8. grounds: two other frames,
    (H, W, 3), far enough in time that the target has left its place in them. ground_from_image: their (3, 3)
    registrations.
    """
    pictures = [image, *grounds]
    if len(grounds) != 2 or any(picture.ndim != 3 for picture in pictures):
        return mask
    x, y, width, height = box
    lit = [_seen(g, to_ground, box) for g, to_ground in zip(grounds, ground_from_image, strict=True)]
    bare = np.abs(lit[0] - lit[1]).max(axis=2) < _GROUNDS_ALIKE
    light = (_smooth(image[y : y + height, x : x + width]) + 2) / ((lit[0] + lit[1]) / 2 + 2)
    mean = light.mean(axis=2)
    alike = np.abs(light - mean[..., None]).max(axis=2) < _COLOURS_ALIKE * mean
    low, high = _LIGHT_LEFT
    shadow = (bare & alike & (mean > low) & (mean < high)).astype(np.uint8)
    shadow = cv2.morphologyEx(shadow, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5)))
    body = (mask & (shadow == 0)).astype(np.uint8)
    body = cv2.morphologyEx(body, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3)))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(body)
    if count < 2:
        return mask
    kept = stats[:, cv2.CC_STAT_AREA] >= _CRUMB * stats[1:, cv2.CC_STAT_AREA].max()
    kept[0] = False
    left = kept[labels]
    return left if left.sum() >= _LEAST_LEFT * mask.sum() else mask


def _smooth(picture: np.ndarray) -> np.ndarray:
    return cv2.blur(picture, (3, 3)).astype(np.float32)


def _seen(picture: np.ndarray, picture_from_image: np.ndarray, box: tuple[int, int, int, int]) -> np.ndarray:
    """The part of another frame that lies under the box, as the image sees it."""
    x, y, width, height = box
    corner = np.array([[1, 0, x], [0, 1, y], [0, 0, 1]], float)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return _smooth(
        cv2.warpPerspective(
            picture, picture_from_image @ corner, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
    )
