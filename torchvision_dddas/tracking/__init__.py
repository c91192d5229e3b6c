"""Tracking: give detections identities. `Tracker` is the public class; the other names are for other rooms."""

from torchvision_dddas.tracking.camera_motion import CameraMotion, Registrar
from torchvision_dddas.tracking.crowd_events import CrowdEvents
from torchvision_dddas.tracking.crowd_identity import CrowdIdentities
from torchvision_dddas.tracking.shared_identities import MultiViewTracker, share_identities
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
    "CrowdEvents",
    "CrowdIdentities",
    "FrameTracker",
    "MultiViewTracker",
    "Registrar",
    "SceneTracker",
    "Tracker",
    "rgb_histograms",
    "share_identities",
    "track_clip",
    "track_scenes",
    "track_table",
    "without_picture",
]
