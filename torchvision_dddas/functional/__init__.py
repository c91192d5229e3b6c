"""Pure functions from tensors to tensors: batched, exportable, mostly differentiable. Needs the extra `torch`.

    >>> import torchvision_dddas.functional as F

Images are (B, C, H, W) floats in [0, 1], or 0 .. 255 if an argument is called levels. Points are (B, N, 2), (u, v) in
pixels from the centre of the top left pixel. The name of a matrix states its direction (reference_from_frame). Tensors
are float32, or float64 for gradient checks, on any device. The shapes of the inputs fix all shapes; a validity mask
marks missing entries. Functions that Kornia has too keep its name and first arguments. Our further arguments must be
named, and Kornia's further arguments are refused. Functions that only Kornia has are passed on unchanged.

The table in `chain.implementations` states which implementation of an operation runs on which device, and why.
`dddas settings --backends` prints the table. `python eval/speed.py operations` compares the times with Kornia's and
OpenCV's. Engines, modules, tuning and export call only these functions.
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
