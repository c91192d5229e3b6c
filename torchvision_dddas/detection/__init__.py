"""Detect moving targets in the frames of a moving camera. Start with `MotionDetector`."""

from typing import TYPE_CHECKING

from torchvision_dddas.chain import View, Window, match_exposure
from torchvision_dddas.detection.blobs import fill_hull
from torchvision_dddas.detection.detector import MotionDetector, Retune, check_length, detect_motion, load_engine
from torchvision_dddas.detection.engine import Engine, Foreground
from torchvision_dddas.detection.interval import (
    WALKER_M_S,
    DistanceSettings,
    describe_distance,
    interval_from_flow,
    interval_from_telemetry,
    look_cost,
    settings_at,
    with_logged_focal,
)
from torchvision_dddas.detection.onnx_detector import OnnxDetector
from torchvision_dddas.detection.person_scale import pixels_per_metre

if TYPE_CHECKING:
    from torchvision_dddas.detection.torch_engine import TorchEngine, detect_masks

__all__ = [
    "WALKER_M_S",
    "DistanceSettings",
    "Engine",
    "Foreground",
    "MotionDetector",
    "OnnxDetector",
    "Retune",
    "TorchEngine",
    "View",
    "Window",
    "check_length",
    "describe_distance",
    "detect_masks",
    "detect_motion",
    "fill_hull",
    "interval_from_flow",
    "interval_from_telemetry",
    "load_engine",
    "look_cost",
    "match_exposure",
    "pixels_per_metre",
    "settings_at",
    "with_logged_focal",
]


if not TYPE_CHECKING:  # `__getattr__` would hide wrong names from the type checker

    def __getattr__(name):
        """Load the torch engine when one of its names is first used."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from torchvision_dddas.detection import torch_engine

        return getattr(torch_engine, name)
