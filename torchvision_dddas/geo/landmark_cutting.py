"""What is left of targets where landmarks are cut out of them: a vehicle beside a crowd makes one blob with it."""

import cv2
import numpy as np

from torchvision_dddas.geometry import parts_of
from torchvision_dddas.types import Bool, Detections, Float

_OF_VEHICLE = 4


def cut_out(
    found: Detections,
    mask: np.ndarray,
    vehicles: Bool[np.ndarray, " N"],
    middle_px: Float[np.ndarray, "K 2"],
    radius_px: Float[np.ndarray, " K"],
    least_px: float,
) -> tuple[Detections, np.ndarray]:
    """The detections without the discs about vehicles' middles, and the (H, W) mask of them.

    vehicles: which of them are landmarks: of these stays what is left outside the discs, if it is large enough; where a
    middle or radius is unknown (NaN), nothing. Parts smaller than least_px go, of landmarks those four times as large.
    A target that no disc touches stays as it is.
    """
    known = np.isfinite(middle_px).all(axis=1) & np.isfinite(radius_px)
    outside = mask.copy()
    for (u, v), radius in zip(middle_px[known], radius_px[known], strict=True):
        cv2.circle(outside, (round(float(u)), round(float(v))), max(round(float(radius)), 1), 0, cv2.FILLED)
    rows, boxes, areas = [], [], []
    numbered = np.zeros_like(mask)
    for row in range(len(found)):
        x, y, width, height = (int(side) for side in found.box_px[row])
        # Boxes of blobs lie within the picture; a vehicle that no disc is known for goes whole.
        window = np.s_[max(y, 0) : y + height, max(x, 0) : x + width]
        left, whole = outside[window] == row + 1, mask[window] == row + 1
        touched = left.sum() < whole.sum()
        if vehicles[row] and not touched:
            continue
        # What a vehicle's own blob leaves outside is as a rule its shadow.
        least = max(least_px * (_OF_VEHICLE if vehicles[row] else 1), 1)
        parts = parts_of(left, (max(x, 0), max(y, 0), width, height), least) if touched else []
        if not touched:
            parts = [((x, y, width, height), whole)]
        for box, part in parts:
            rows.append(row)
            boxes.append(box)
            areas.append(float(part.sum()) if touched else float(found.area_px[row]))
            there = numbered[max(box[1], 0) : box[1] + box[3], max(box[0], 0) : box[0] + box[2]]
            there[part] = len(rows)
    kept = np.array(rows, np.int64)
    left_over = Detections(
        np.array(boxes, float).reshape(-1, 4),
        found.score[kept],
        np.array(areas, float),
        found.heading_rad[kept],
        found.speed_px[kept],
        found.kind,
    )
    return left_over, numbered
