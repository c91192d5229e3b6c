"""The pixel floor: pure functions from tensors to tensors, batched, exportable, mostly differentiable.

Images are (B, C, H, W) floats in [0, 1]; points are (B, N, 2), (u, v) in pixels from the centre of the top left one;
matrices are named by direction (reference_from_frame). float32, or float64 for gradient checks; any device; every shape
is fixed by the inputs' shapes, and what is missing is marked by a validity mask. Needs the extra `torch`.
"""

from torchvision_dddas.functional import (
    affine,
    affinity,
    blur,
    borders,
    consensus,
    difference,
    flow,
    histogram,
    history,
    hog,
    homography,
    hsv,
    keypoints,
    linear,
    morphology,
    resize,
    threshold,
    warp,
)

__all__ = [
    "affine",
    "affinity",
    "blur",
    "borders",
    "consensus",
    "difference",
    "flow",
    "histogram",
    "history",
    "hog",
    "homography",
    "hsv",
    "keypoints",
    "linear",
    "morphology",
    "resize",
    "threshold",
    "warp",
]
