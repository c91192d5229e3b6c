"""The public names, for type checkers and editors."""

from pathlib import Path

from torchvision_dddas.config import Settings as Settings
from torchvision_dddas.config import load_config
from torchvision_dddas.detection import MotionDetector as MotionDetector
from torchvision_dddas.detection import OnnxDetector as OnnxDetector
from torchvision_dddas.errors import InputError as InputError
from torchvision_dddas.geo import AerialLocator as AerialLocator
from torchvision_dddas.geo import GroundLocator as GroundLocator
from torchvision_dddas.geo import TargetFusion as TargetFusion
from torchvision_dddas.geo import Zones as Zones
from torchvision_dddas.io.camera_files import read_camera as read_camera
from torchvision_dddas.io.camera_files import read_poses as read_poses
from torchvision_dddas.io.colour_files import read_colours as read_colours
from torchvision_dddas.io.detection_tables import read_detections as read_detections
from torchvision_dddas.io.drawing import draw as draw
from torchvision_dddas.io.elevation import read_elevation as read_elevation
from torchvision_dddas.io.elevation import read_ortho as read_ortho
from torchvision_dddas.io.ground_tables import read_landmarks as read_landmarks
from torchvision_dddas.io.ground_tables import read_positions as read_positions
from torchvision_dddas.io.telemetry import read_telemetry as read_telemetry
from torchvision_dddas.io.track_files import write_tracks as write_tracks
from torchvision_dddas.people import PersonDetector as PersonDetector
from torchvision_dddas.pipeline import Pipeline as Pipeline
from torchvision_dddas.tracking import MultiViewTracker as MultiViewTracker
from torchvision_dddas.tracking import Tracker as Tracker
from torchvision_dddas.types import Adjustment as Adjustment
from torchvision_dddas.types import AerialLocations as AerialLocations
from torchvision_dddas.types import AppearanceUse as AppearanceUse
from torchvision_dddas.types import Camera as Camera
from torchvision_dddas.types import CameraPose as CameraPose
from torchvision_dddas.types import Colours as Colours
from torchvision_dddas.types import Confirmation as Confirmation
from torchvision_dddas.types import Detections as Detections
from torchvision_dddas.types import DetectionTable as DetectionTable
from torchvision_dddas.types import Elevation as Elevation
from torchvision_dddas.types import Fix as Fix
from torchvision_dddas.types import Flight as Flight
from torchvision_dddas.types import Frame as Frame
from torchvision_dddas.types import FrameResult as FrameResult
from torchvision_dddas.types import FusedTargets as FusedTargets
from torchvision_dddas.types import GroundCrowds as GroundCrowds
from torchvision_dddas.types import GroundLocations as GroundLocations
from torchvision_dddas.types import LandmarkObservations as LandmarkObservations
from torchvision_dddas.types import Landmarks as Landmarks
from torchvision_dddas.types import LinearSvm as LinearSvm
from torchvision_dddas.types import Ortho as Ortho
from torchvision_dddas.types import People as People
from torchvision_dddas.types import Poses as Poses
from torchvision_dddas.types import PoseTable as PoseTable
from torchvision_dddas.types import Positions as Positions
from torchvision_dddas.types import Registration as Registration
from torchvision_dddas.types import Scene as Scene
from torchvision_dddas.types import SharedFrame as SharedFrame
from torchvision_dddas.types import Sightings as Sightings
from torchvision_dddas.types import Source as Source
from torchvision_dddas.types import Telemetry as Telemetry
from torchvision_dddas.types import TrackedFrame as TrackedFrame
from torchvision_dddas.types import Tracks as Tracks
from torchvision_dddas.types import ViewMap as ViewMap
from torchvision_dddas.types import Zone as Zone
from torchvision_dddas.types import ZoneEvent as ZoneEvent

__version__: str
load_settings = load_config

def open_video(
    spec: str | Path,
    *,
    rate_hz: float | None = None,
    full_scale: int | tuple[int, int] | None = None,
    single: bool = False,
) -> Source: ...
def open_source(
    spec: str | Path,
    *,
    rate_hz: float | None = None,
    full_scale: int | tuple[int, int] | None = None,
    single: bool = False,
) -> Source: ...
