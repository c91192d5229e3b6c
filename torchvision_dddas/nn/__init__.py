"""Modules of torch.nn built from `functional`, for users' own models, the torch engines, tuning and export."""

from torchvision_dddas.nn.histogram_affinity import HistogramAffinity
from torchvision_dddas.nn.motion_segmenter import (
    Core,
    Differences,
    MotionSegmenter,
    Regions,
    Values,
    check_softness,
    differences_of,
)
from torchvision_dddas.nn.people import HOGDescriptor, PersonScorer
from torchvision_dddas.nn.plane_homography import PlaneHomography
from torchvision_dddas.nn.registration import GRAPH_EFFORT, FrameRegistration, Motion

__all__ = [
    "GRAPH_EFFORT",
    "Core",
    "Differences",
    "FrameRegistration",
    "HOGDescriptor",
    "HistogramAffinity",
    "Motion",
    "MotionSegmenter",
    "PersonScorer",
    "PlaneHomography",
    "Regions",
    "Values",
    "check_softness",
    "differences_of",
]
