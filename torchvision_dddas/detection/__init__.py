"""Moving targets from a moving camera: frames to targets. `MotionDetector` is the way in."""

from torchvision_dddas.detection.blobs import fill_hull
from torchvision_dddas.detection.detector import (
    Clip,
    MotionDetector,
    Retune,
    check_length,
    detect_motion,
    load_engine,
)
from torchvision_dddas.detection.engine import EVIDENCE_CAP, EVIDENCE_SCALE, Engine, Foreground, View, Window
from torchvision_dddas.detection.interval import interval_from_flow, interval_from_telemetry, pixels_per_metre
from torchvision_dddas.detection.registration import cell_side, match_exposure

__all__ = [
    "EVIDENCE_CAP",
    "EVIDENCE_SCALE",
    "Clip",
    "Engine",
    "Foreground",
    "MotionDetector",
    "Retune",
    "View",
    "Window",
    "cell_side",
    "check_length",
    "detect_motion",
    "fill_hull",
    "interval_from_flow",
    "interval_from_telemetry",
    "load_engine",
    "match_exposure",
    "pixels_per_metre",
]
