"""Pure functions from tensors to tensors: batched, exportable, mostly differentiable. Needs the extra `torch`.

Images are (B, C, H, W) floats in [0, 1]; points are (B, N, 2), (u, v) in pixels from the centre of the top left one;
matrices are named by direction (reference_from_frame). float32, or float64 for gradient checks; any device; every shape
is fixed by the shapes of the inputs, and what is missing is marked by a validity mask.
"""

from torchvision_dddas.functional import (
    affinity,
    assignment,
    color,
    difference,
    filters,
    flow,
    hog,
    keypoints,
    morphology,
    plane_maps,
    soft,
    warp,
)

__all__ = [
    "affinity",
    "assignment",
    "color",
    "difference",
    "filters",
    "flow",
    "hog",
    "keypoints",
    "morphology",
    "plane_maps",
    "soft",
    "warp",
]
