"""Pure functions from tensors to tensors: batched, exportable, mostly differentiable. Needs the extra `torch`.

    >>> import torchvision_dddas.functional as F

Images are (B, C, H, W) floats, in [0, 1] unless an argument is called levels (0 .. 255); points are (B, N, 2), (u, v)
in pixels from the centre of the top left one; matrices are named by direction (reference_from_frame). float32, or
float64 for gradient checks; any device; every shape is fixed by the shapes of the inputs, and what is missing is marked
by a validity mask. What Kornia has too is named as there and takes the same first arguments; what only ours has is
given by name, what only Kornia's has is refused. What is Kornia's own is passed on.

Each function has one form, chosen on a CPU. `python eval/speed.py operations` times it beside Kornia's and OpenCV's. On
a GPU the choice was not measured. Engines, modules, tuning and export call these functions and nothing beside them, so
that another choice there is a switch inside the function that it concerns.
"""

from kornia.geometry import oneway_transfer_error, transform_points

from torchvision_dddas.functional.affinity import pair_affinity, triplet_affinity
from torchvision_dddas.functional.assignment import log_partition
from torchvision_dddas.functional.chain_operations import TensorOperations, close_masks
from torchvision_dddas.functional.color import FULL, TURN, bgr_to_hsv, rgb_histogram, within_ranges
from torchvision_dddas.functional.difference import fit_exposure, masked_median, match_exposure, noise_weight
from torchvision_dddas.functional.filters import box_sum, gaussian_blur2d, mean_gradient, pad_reflect, reflect_index
from torchvision_dddas.functional.flow import build_pyramid, forward_backward, lucas_kanade
from torchvision_dddas.functional.hog_svm import Layout, arrange_weights, hog, svm_scores
from torchvision_dddas.functional.keypoints import corner_min_eigenvalue, frame_features, grid_features
from torchvision_dddas.functional.morphology import closing, dilation, erosion, opening, structuring_element
from torchvision_dddas.functional.plane_maps import (
    MODELS,
    draw_samples,
    find_affine,
    find_homography,
    find_homography_raw,
    invert_map,
    ransac,
    refit_map,
    solve_linear,
    spread_ranks,
)
from torchvision_dddas.functional.soft import (
    blend_sizes,
    gate_regions,
    gates_of_pixels,
    is_traced,
    may_branch,
    round_straight_through,
    step,
    straight_through,
)
from torchvision_dddas.functional.warp import columns_between, resize, seen_by_both, seen_columns, warp_perspective

__all__ = [
    "FULL",
    "MODELS",
    "TURN",
    "Layout",
    "TensorOperations",
    "arrange_weights",
    "bgr_to_hsv",
    "blend_sizes",
    "box_sum",
    "build_pyramid",
    "close_masks",
    "closing",
    "columns_between",
    "corner_min_eigenvalue",
    "dilation",
    "draw_samples",
    "erosion",
    "find_affine",
    "find_homography",
    "find_homography_raw",
    "fit_exposure",
    "forward_backward",
    "frame_features",
    "gate_regions",
    "gates_of_pixels",
    "gaussian_blur2d",
    "grid_features",
    "hog",
    "invert_map",
    "is_traced",
    "log_partition",
    "lucas_kanade",
    "masked_median",
    "match_exposure",
    "may_branch",
    "mean_gradient",
    "noise_weight",
    "oneway_transfer_error",
    "opening",
    "pad_reflect",
    "pair_affinity",
    "ransac",
    "refit_map",
    "reflect_index",
    "resize",
    "rgb_histogram",
    "round_straight_through",
    "seen_by_both",
    "seen_columns",
    "solve_linear",
    "spread_ranks",
    "step",
    "straight_through",
    "structuring_element",
    "svm_scores",
    "transform_points",
    "triplet_affinity",
    "warp_perspective",
    "within_ranges",
]
