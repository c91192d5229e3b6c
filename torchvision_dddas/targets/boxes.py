"""What boxes share: x, y of the top left pixel, width, height."""

import numpy as np


def shared_px(box_px: np.ndarray, other_px: np.ndarray) -> np.ndarray:
    """(...) area in both of two boxes (..., 4), broadcast against each other; 0 where they lie apart."""
    low = np.maximum(box_px[..., :2], other_px[..., :2])
    high = np.minimum(box_px[..., :2] + box_px[..., 2:], other_px[..., :2] + other_px[..., 2:])
    across, down = np.moveaxis(high - low, -1, 0)
    return np.maximum(across, 0) * np.maximum(down, 0)
