"""torch.nn.Modules made of `functional`, for tuning and export."""

from torchvision_dddas.nn.motion_segmenter import Core, Differences, MotionSegmenter, Regions, Values
from torchvision_dddas.nn.step import PlaneHomography, RawPlaneHomography, Register, Step, WarpDifference

__all__ = [
    "Core",
    "Differences",
    "MotionSegmenter",
    "PlaneHomography",
    "RawPlaneHomography",
    "Regions",
    "Register",
    "Step",
    "Values",
    "WarpDifference",
]
