"""Detect people in pictures from the ground by HOG and a linear SVM. The public class is `PersonDetector`."""

from torchvision_dddas.people.detector import (
    PersonDetector,
    PersonTracker,
    WindowScorer,
    detect_in_clip,
    detect_people,
    load_scorer,
)
from torchvision_dddas.people.pyramid import levels, smallest_body_px

__all__ = [
    "PersonDetector",
    "PersonTracker",
    "WindowScorer",
    "detect_in_clip",
    "detect_people",
    "levels",
    "load_scorer",
    "smallest_body_px",
]
