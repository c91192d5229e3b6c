"""Regions of a core mask for its soft gates, labelled hard: which pixels hang together has no gradient."""

import cv2
import numpy as np
import torch

from torchvision_dddas.detection.blobs import filled_hull
from torchvision_dddas.nn.motion_segmenter import Core, Regions

# What is further from any region than this makes no part of it when the core grows a little, px.
_FAR_PX = 40.0


def regions_of(core: Core, hull: bool, reach: float = 0.0) -> Regions:
    """What hangs together (8 neighbours) in each mask of a batch, whether it passes any gate or not.

    hull: fill convex hulls. reach: pixels that miss the threshold by less belong to the nearest region, or where there
    is none make one of their own; in the unit of the margin.
    """
    margins = core.margin.detach()[:, 0].cpu().numpy()
    near, filled = np.zeros((2, *margins.shape), np.int64)
    counts = [_labelled(margin, hull, reach, *maps) for margin, *maps in zip(margins, near, filled, strict=True)]
    device = core.mask.device
    return Regions(
        torch.from_numpy(near)[:, None].to(device), torch.from_numpy(filled)[:, None].to(device), max(counts)
    )


def _labelled(margin: np.ndarray, hull: bool, reach: float, near: np.ndarray, filled: np.ndarray) -> int:
    """Writes the labels of one picture; returns how many there are."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats((margin > 0).astype(np.uint8), ltype=cv2.CV_32S)
    near[:] = parts
    # Large ones last: what lies in a large hull is there with it, though it be a speck of its own.
    for label in 1 + np.argsort(stats[1:, cv2.CC_STAT_AREA], kind="stable"):
        x, y, width, height = (int(v) for v in stats[label, :4])
        window = np.s_[y : y + height, x : x + width]
        region = parts[window] == label
        filled[window][filled_hull(region) if hull else region] = label
    if reach <= 0:
        return count - 1
    weak, weak_parts = cv2.connectedComponents((margin > -reach).astype(np.uint8), ltype=cv2.CV_32S)
    strong = np.zeros(weak, bool)
    strong[weak_parts[parts > 0]] = True
    strong[0] = False
    if count > 1:
        away, nearest = cv2.distanceTransformWithLabels(
            (parts == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        of_place = np.zeros(int(nearest.max()) + 1, np.int64)
        of_place[nearest[parts > 0]] = parts[parts > 0]
        joins = strong[weak_parts] & (parts == 0) & (away < _FAR_PX)
        near[joins] = of_place[nearest[joins]]
    numbers = np.zeros(weak, np.int64)
    alone = np.flatnonzero(~strong[1:]) + 1
    numbers[alone] = count + np.arange(len(alone))
    lone = numbers[weak_parts]
    near[lone > 0] = lone[lone > 0]
    return count - 1 + len(alone)
