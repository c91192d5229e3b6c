"""The detection chain, written once for all engines, and its operations in OpenCV. No torch is needed."""

from torchvision_dddas.chain.exposure import View, exposure_between, fit_exposure, match_exposure
from torchvision_dddas.chain.foreground import (
    DetectionChain,
    Maps,
    Neighbours,
    Pair,
    Reference,
    Window,
    evidence_scale,
    halve_side,
)
from torchvision_dddas.chain.frame_pairs import later_pair, near_gaps, near_pairs, next_pair, pair_about
from torchvision_dddas.chain.implementations import IMPLEMENTATIONS, uses_kornia
from torchvision_dddas.chain.opencv_operations import (
    REGION_PX,
    SAMPLED,
    OpenCVOperations,
    close_mask,
    ellipse,
    no_texture,
)
from torchvision_dddas.chain.operations import Number, Operations

__all__ = [
    "IMPLEMENTATIONS",
    "REGION_PX",
    "SAMPLED",
    "DetectionChain",
    "Maps",
    "Neighbours",
    "Number",
    "OpenCVOperations",
    "Operations",
    "Pair",
    "Reference",
    "View",
    "Window",
    "close_mask",
    "ellipse",
    "evidence_scale",
    "exposure_between",
    "fit_exposure",
    "halve_side",
    "later_pair",
    "match_exposure",
    "near_gaps",
    "near_pairs",
    "next_pair",
    "no_texture",
    "pair_about",
    "uses_kornia",
]
