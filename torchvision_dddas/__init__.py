"""Dynamic data-driven visual surveillance with cooperative unmanned vehicles.

The public names below are loaded when first used (PEP 562), so that `import torchvision_dddas` costs nothing and needs
neither torch nor OpenCV.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

# ONNX Runtime 1.29 and newer write a device id and a database of events below the home directory, and send the events
# to Microsoft. They read this variable when they are loaded. Calling `disable_telemetry_events` would be too late.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

if TYPE_CHECKING:
    from pathlib import Path

    from torchvision_dddas.types import Source

# Each public name by subject, with its module and its name in that module. `__init__.pyi` declares the same names for
# type checkers and editors, and a test compares the two.
_HOME = {
    # Clips, settings, and runs
    "Source": ("types", "Source"),
    "Frame": ("types", "Frame"),
    "Settings": ("config", "Settings"),
    "load_settings": ("config", "load_config"),
    "Pipeline": ("pipeline", "Pipeline"),
    "FrameResult": ("types", "FrameResult"),
    "Adjustment": ("types", "Adjustment"),
    "InputError": ("errors", "InputError"),
    "__version__": ("runtime", "VERSION"),
    # Detection
    "MotionDetector": ("detection", "MotionDetector"),
    "OnnxDetector": ("detection", "OnnxDetector"),
    "PersonDetector": ("people", "PersonDetector"),
    "Detections": ("types", "Detections"),
    "People": ("types", "People"),
    "LinearSvm": ("types", "LinearSvm"),
    "Registration": ("types", "Registration"),
    "Scene": ("types", "Scene"),
    # Tracking
    "Tracker": ("tracking", "Tracker"),
    "MultiViewTracker": ("tracking", "MultiViewTracker"),
    "Tracks": ("types", "Tracks"),
    "TrackedFrame": ("types", "TrackedFrame"),
    "AppearanceUse": ("types", "AppearanceUse"),
    "SharedFrame": ("types", "SharedFrame"),
    "ViewMap": ("types", "ViewMap"),
    "DetectionTable": ("types", "DetectionTable"),
    "read_detections": ("io.detection_tables", "read_detections"),
    # Positions on the ground
    "AerialLocator": ("geo", "AerialLocator"),
    "GroundLocator": ("geo", "GroundLocator"),
    "TargetFusion": ("geo", "TargetFusion"),
    "Camera": ("types", "Camera"),
    "CameraPose": ("types", "CameraPose"),
    "Poses": ("types", "Poses"),
    "PoseTable": ("types", "PoseTable"),
    "Telemetry": ("types", "Telemetry"),
    "Flight": ("types", "Flight"),
    "Landmarks": ("types", "Landmarks"),
    "LandmarkObservations": ("types", "LandmarkObservations"),
    "Colours": ("types", "Colours"),
    "Elevation": ("types", "Elevation"),
    "Ortho": ("types", "Ortho"),
    "Fix": ("types", "Fix"),
    "Positions": ("types", "Positions"),
    "AerialLocations": ("types", "AerialLocations"),
    "GroundLocations": ("types", "GroundLocations"),
    "Sightings": ("types", "Sightings"),
    "FusedTargets": ("types", "FusedTargets"),
    "Confirmation": ("types", "Confirmation"),
    "GroundCrowds": ("types", "GroundCrowds"),
    "read_telemetry": ("io.telemetry", "read_telemetry"),
    "read_camera": ("io.camera_files", "read_camera"),
    "read_poses": ("io.camera_files", "read_poses"),
    "read_landmarks": ("io.ground_tables", "read_landmarks"),
    "read_positions": ("io.ground_tables", "read_positions"),
    "read_colours": ("io.colour_files", "read_colours"),
    "read_elevation": ("io.elevation", "read_elevation"),
    "read_ortho": ("io.elevation", "read_ortho"),
    # Pictures and files of results
    "draw": ("io.drawing", "draw"),
    "write_tracks": ("io.track_files", "write_tracks"),
    # Zones
    "Zones": ("geo", "Zones"),
    "Zone": ("types", "Zone"),
    "ZoneEvent": ("types", "ZoneEvent"),
}

__all__ = ["open_source", "open_video", *_HOME]


def open_video(spec: "str | Path", **options: Any) -> "Source":
    """Open a clip: a video file, a folder or glob of images, `camera:0`, `rtsp://...`, or `sim:` and a scenario.

    options: rate_hz, full_scale, single, as in `io.sources.open_source`. A simulated clip can be steered.
    Raise InputError if the clip cannot be read.

    >>> import cv2
    >>> for number in (1, 2):
    ...     written = cv2.imwrite(f"{number:06d}.png", np.zeros((48, 64), np.uint8))
    >>> clip = td.open_video(".", rate_hz=25)
    >>> clip.size, [frame.time_s for frame in clip]
    ((64, 48), [0.0, 0.04])
    """
    from torchvision_dddas.io.sources import names_file, open_source

    text = str(spec)
    if not text.startswith("sim:") or names_file(text):
        return open_source(spec, **options)
    from torchvision_dddas.errors import InputError
    from torchvision_dddas.lab.simulation import open_scenario  # takes 0.4 s to import

    if options.get("rate_hz") is not None:
        raise InputError(f"the scenario of {text} sets the frame rate (clip.rate_hz); leave --rate out")
    return open_scenario(text.removeprefix("sim:"))


open_source = open_video


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, inside = _HOME[name]
    value = getattr(import_module(f"{__name__}.{module}"), inside)
    if name == "Pipeline":
        value.open_clip = staticmethod(open_video)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
