"""torch.nn.Modules made of `functional`, for tuning and export."""

from torchvision_dddas.nn.motion_segmenter import Core, Differences, MotionSegmenter, Regions, Values

__all__ = ["Core", "Differences", "MotionSegmenter", "Regions", "Values"]
