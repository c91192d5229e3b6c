"""From the picture to the ground: aerial cameras with telemetry and landmarks, and ranging by cameras on the ground."""

from torchvision_dddas.geo.aerial_locator import AerialLocator, FrameFix, check_table, frames_to_locate, is_outside
from torchvision_dddas.geo.aerial_targets import Targets
from torchvision_dddas.geo.ground_locator import GroundLocator
from torchvision_dddas.geo.landmark_watch import (
    LandmarkWatch,
    WatchedScene,
    check_colours,
    group_crowds,
    without_pixels,
)
from torchvision_dddas.geo.site import (
    Site,
    build_site,
    complete_site,
    describe_no_place,
    describe_unknown_heights,
    has_places,
    resolve_camera,
    to_local,
)

__all__ = [
    "AerialLocator",
    "FrameFix",
    "GroundLocator",
    "LandmarkWatch",
    "Site",
    "Targets",
    "WatchedScene",
    "build_site",
    "check_colours",
    "check_table",
    "complete_site",
    "describe_no_place",
    "describe_unknown_heights",
    "frames_to_locate",
    "group_crowds",
    "has_places",
    "is_outside",
    "resolve_camera",
    "to_local",
    "without_pixels",
]
