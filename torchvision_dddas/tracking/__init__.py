"""Tracking: from detections to identities. `Tracker` is the public class; the other names serve other rooms."""

from torchvision_dddas.tracking.camera_motion import CameraMotion
from torchvision_dddas.tracking.crowd_identity import CrowdIdentities
from torchvision_dddas.tracking.source_tracker import rgb_histograms
from torchvision_dddas.tracking.tracker import (
    FrameTracker,
    SceneTracker,
    Tracker,
    track_clip,
    track_scenes,
    track_table,
    without_picture,
)

__all__ = [
    "CameraMotion",
    "CrowdIdentities",
    "FrameTracker",
    "SceneTracker",
    "Tracker",
    "rgb_histograms",
    "track_clip",
    "track_scenes",
    "track_table",
    "without_picture",
]
