"""A target's outline: from two explanations of every pixel, spread along colours, and without its cast shadow.

Pixels that only the target's motion explains are foreground, those that the background explains are background; the
rest (flat insides, places that only one picture shows) follow their colours.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.detection.blob_motion import Motion
from torchvision_dddas.detection.blobs import Blob, Box, box_slices, ellipse
from torchvision_dddas.detection.engine import EVIDENCE_SCALE, Foreground, View

_MAX_MISFIT = 15.0  # noise units
# How much of the surroundings is smoothed with a blob, px.
_PAD = 24
_WARP_FLAGS = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP

# A shadow leaves this share of the light on the ground ...
_LIGHT_LEFT = (0.25, 0.85)
# ... in every colour alike, to this share of it.
_COLOURS_ALIKE = 0.1
# Two pictures show the same bare ground if they agree to so many grey levels.
_GROUNDS_ALIKE = 12
# If less than this share of the mask is left, the target itself is dark.
_LEAST_LEFT = 0.35
# Parts smaller than this share of the largest one left go with the shadow.
_CRUMB = 0.15


def refine_outline(blob: Blob, motion: Motion, view: View, foreground: Foreground, settings: Settings) -> np.ndarray:
    """The refined mask inside the blob's box, (height, width) bool; never outside the blob's own mask.

    view: the reference frame. foreground: its maps; `motion.affine` describes the motion to its warped neighbours.
    """
    x, y, width, height = blob.box
    box, own = box_slices(blob.box), view.grey[box_slices(blob.box)]
    slope = foreground.texture[box].astype(np.float32) / 4
    noise = np.sqrt(settings.difference.noise_levels**2 + (settings.difference.gradient_share * slope) ** 2)

    def misfit(pictures: Sequence[np.ndarray]) -> np.ndarray:
        """The smaller difference to two pictures of the box, noise units."""
        misses = (np.minimum(cv2.absdiff(own, p) / noise, _MAX_MISFIT).astype(np.float32) for p in pictures)
        return cv2.blur(np.minimum(*misses), (3, 3))

    still = misfit([picture[box] for picture in foreground.warped])
    # The parts of the neighbours that the target's motion brings into its box.
    centre_u, centre_v, scale = motion.frame
    moved = []
    for picture, (shift, by_u, by_v) in zip(foreground.warped, motion.affine, strict=True):
        # u + shift + by_u (u - cu) / s + by_v (v - cv) / s, with (u, v) counted from the box's corner
        slopes = np.c_[by_u, by_v]
        origin = np.array([x, y]) + shift + slopes @ np.array([x - centre_u, y - centre_v]) / scale
        matrix = np.c_[np.eye(2) + slopes / scale, origin]
        moved.append(
            cv2.warpAffine(picture, matrix, (width, height), flags=_WARP_FLAGS, borderMode=cv2.BORDER_REPLICATE)
        )
    moving = misfit(moved)
    near, far = foreground.evidence[box] / np.float32(EVIDENCE_SCALE), foreground.wide[box] / np.float32(EVIDENCE_SCALE)
    certain = np.clip((near - 2) / 2, 0, 1) * np.clip(1.5 - moving / np.maximum(still, 1), 0, 1)
    filled = np.clip((far - 2) / 2, 0, 1) * np.clip(1.5 - moving / 2, 0, 1)
    certain = np.where(certain < 0.2, np.maximum(certain, filled), certain) * blob.mask
    background = np.clip(slope / 8, 0, 1) * np.clip(1 - near / 2, 0, 1) * np.clip(0.5 + (moving - still) / 2, 0, 1)
    background *= np.clip(1 - far / 3, 0, 1)
    background[~blob.mask] = 1

    left, top = max(x - _PAD, 0), max(y - _PAD, 0)
    right, bottom = min(x + width + _PAD, view.size[0]), min(y + height + _PAD, view.size[1])
    inside = box_slices(blob.box, left, top)
    seeds: np.ndarray = np.zeros((bottom - top, right - left, 2), np.float32)
    seeds[..., 1] = 1
    seeds[inside] = np.dstack([certain, background])
    half = max((right - left) // 2, 1), max((bottom - top) // 2, 1)
    guide = cv2.resize(view.image[top:bottom, left:right], half, interpolation=cv2.INTER_AREA)
    seeds = cv2.resize(seeds, half, interpolation=cv2.INTER_AREA)
    weight = smooth_along_edges(seeds, guide, settings.refine.spatial_px / 2, settings.refine.colour_levels)
    share = cv2.resize(weight[..., 0] / (weight[..., 0] + weight[..., 1] + 1e-6), (right - left, bottom - top))
    return (share[inside] > settings.refine.share) & blob.mask


def smooth_along_edges(
    values: np.ndarray, guide: np.ndarray, spatial_px: float, colour_levels: float, rounds: int = 2
) -> np.ndarray:
    """Smooth (H, W, K) values along the flat regions of a picture, without crossing its edges.

    guide: (H, W, 3) or (H, W) uint8. spatial_px: reach where the colour does not change. colour_levels: change of
    colour, summed over the channels, that counts as much as that reach.
    Source: the recursive domain transform, Gastal and Oliveira 2011.
    """
    colours = np.atleast_3d(guide).astype(np.float32)
    colours *= 3 / colours.shape[2]  # a grey picture is one of three equal channels
    across, down = (1 + spatial_px / colour_levels * np.abs(np.diff(colours, axis=axis)).sum(axis=2) for axis in (1, 0))

    def filter_both_ways(lines: np.ndarray, keep: np.ndarray) -> None:
        """Over the first axis and back: each line takes the share `keep` from the line before it."""
        keep = np.ascontiguousarray(keep)[:, :, None]
        for i in range(1, len(lines)):
            lines[i] += keep[i - 1] * (lines[i - 1] - lines[i])
        for i in range(len(lines) - 2, -1, -1):
            lines[i] += keep[i] * (lines[i + 1] - lines[i])

    # Rows are made contiguous for either direction: each step then works on whole rows.
    rows = np.ascontiguousarray(values, np.float32)
    for i in range(rounds):
        sigma = spatial_px * np.sqrt(3) * 2 ** (rounds - i - 1) / np.sqrt(4**rounds - 1)
        decay = np.log(np.float32(np.exp(-np.sqrt(2) / sigma)))
        columns = np.ascontiguousarray(rows.transpose(1, 0, 2))
        filter_both_ways(columns, np.exp(decay * across).T)
        rows = np.ascontiguousarray(columns.transpose(1, 0, 2))
        filter_both_ways(rows, np.exp(decay * down))
    return rows


def remove_shadow(
    mask: np.ndarray,
    box: Box,
    image: np.ndarray,
    grounds: Sequence[np.ndarray],
    ground_from_image: Sequence[np.ndarray],
) -> np.ndarray:
    """The target's mask without its cast shadow: darker ground of unchanged colour. Unchanged where none is found.

    mask: (height, width) bool inside box = x, y, width, height of image, (H, W, 3) uint8. grounds: two other frames,
    (H, W, 3), far enough in time that the target is elsewhere in them. ground_from_image: their (3, 3) registrations.
    """
    if len(grounds) != 2 or any(picture.ndim != 3 for picture in [image, *grounds]):
        return mask
    pictures = [image[box_slices(box)]]
    for ground, matrix in zip(grounds, ground_from_image, strict=True):
        ground_from_box = matrix @ np.array([[1, 0, box[0]], [0, 1, box[1]], [0, 0, 1]], float)
        pictures.append(
            cv2.warpPerspective(ground, ground_from_box, box[2:], flags=_WARP_FLAGS, borderMode=cv2.BORDER_REPLICATE)
        )
    own, first, second = (cv2.blur(picture, (3, 3)).astype(np.float32) for picture in pictures)
    bare = np.abs(first - second).max(axis=2) < _GROUNDS_ALIKE
    light = (own + 2) / ((first + second) / 2 + 2)
    mean = light.mean(axis=2)
    alike = np.abs(light - mean[..., None]).max(axis=2) < _COLOURS_ALIKE * mean
    low, high = _LIGHT_LEFT
    shadow = (bare & alike & (mean > low) & (mean < high)).astype(np.uint8)
    shadow = cv2.morphologyEx(shadow, cv2.MORPH_OPEN, ellipse(5))
    body = (mask & (shadow == 0)).astype(np.uint8)
    body = cv2.morphologyEx(body, cv2.MORPH_OPEN, ellipse(3))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(body)
    if count < 2:
        return mask
    kept = stats[:, cv2.CC_STAT_AREA] >= _CRUMB * stats[1:, cv2.CC_STAT_AREA].max()
    kept[0] = False
    left = kept[labels]
    return left if left.sum() >= _LEAST_LEFT * mask.sum() else mask
