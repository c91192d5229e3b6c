"""Map pictures to the ground: aerial cameras with telemetry and landmarks, and ranging by cameras on the ground."""

from torchvision_dddas.geo.aerial_locator import AerialLocator, check_table, frames_to_locate, is_outside
from torchvision_dddas.geo.aerial_targets import Targets, tracked_targets
from torchvision_dddas.geo.camera_calibration import calibrate_focal_length, calibrate_pose
from torchvision_dddas.geo.clock_offset import describe_clock_offset, measure_clock_offset
from torchvision_dddas.geo.colours import CalibratedColours, calibrate_colours, draw_calibration
from torchvision_dddas.geo.flight_calibration import (
    OFFSETS,
    PART_OF_OFFSET,
    PARTS,
    FlightErrors,
    Look,
    estimate_flight_errors,
    find_looks,
)
from torchvision_dddas.geo.flight_prediction import predict_flight
from torchvision_dddas.geo.fusion import TargetFusion
from torchvision_dddas.geo.ground_locator import GroundLocator
from torchvision_dddas.geo.heading_offset import describe_heading_offset, find_heading_offset
from torchvision_dddas.geo.heights import geoid_of
from torchvision_dddas.geo.landmark_watch import (
    LandmarkWatch,
    WatchedScene,
    check_colours,
    group_crowds,
    without_pixels,
)
from torchvision_dddas.geo.plane_homography import load_solver
from torchvision_dddas.geo.pose_estimation import pose_prior
from torchvision_dddas.geo.ranging import range_people, touches_border
from torchvision_dddas.geo.site import (
    Site,
    build_site,
    complete_site,
    complete_telemetry,
    describe_no_place,
    describe_unknown_heights,
    has_places,
    resolve_camera,
    to_local,
)
from torchvision_dddas.geo.turn_agreement import (
    Contradiction,
    describe_contradictions,
    find_contradictions,
    flying_height,
)
from torchvision_dddas.geo.zones import Zones

__all__ = [
    "OFFSETS",
    "PARTS",
    "PART_OF_OFFSET",
    "AerialLocator",
    "CalibratedColours",
    "Contradiction",
    "FlightErrors",
    "GroundLocator",
    "LandmarkWatch",
    "Look",
    "Site",
    "TargetFusion",
    "Targets",
    "WatchedScene",
    "Zones",
    "build_site",
    "calibrate_colours",
    "calibrate_focal_length",
    "calibrate_pose",
    "check_colours",
    "check_table",
    "complete_site",
    "complete_telemetry",
    "describe_clock_offset",
    "describe_contradictions",
    "describe_heading_offset",
    "describe_no_place",
    "describe_unknown_heights",
    "draw_calibration",
    "estimate_flight_errors",
    "find_contradictions",
    "find_heading_offset",
    "find_looks",
    "flying_height",
    "frames_to_locate",
    "geoid_of",
    "group_crowds",
    "has_places",
    "is_outside",
    "load_solver",
    "measure_clock_offset",
    "pose_prior",
    "predict_flight",
    "range_people",
    "resolve_camera",
    "to_local",
    "touches_border",
    "tracked_targets",
    "without_pixels",
]
