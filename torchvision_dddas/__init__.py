"""Dynamic data-driven visual surveillance with cooperative unmanned vehicles.

The public names below are loaded when first used (PEP 562), so that `import torchvision_dddas` costs nothing and needs
neither torch nor OpenCV.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

# ONNX Runtime 1.29 and newer write a device id and a database of events below the home directory and send the events to
# their maker. They read this variable when they are loaded, and a call of `disable_telemetry_events` comes too late.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

if TYPE_CHECKING:
    from pathlib import Path

    from torchvision_dddas.types import Source

# Public name -> the module that holds it, and its name there.
_HOME = {
    "AerialLocator": ("geo", "AerialLocator"),
    "GroundLocator": ("geo", "GroundLocator"),
    "__version__": ("runtime", "VERSION"),
    "Adjustment": ("types", "Adjustment"),
    "Detections": ("types", "Detections"),
    "Frame": ("types", "Frame"),
    "InputError": ("errors", "InputError"),
    "MotionDetector": ("detection", "MotionDetector"),
    "Pipeline": ("pipeline", "Pipeline"),
    "Registration": ("types", "Registration"),
    "Scene": ("types", "Scene"),
    "Settings": ("config", "Settings"),
    "Telemetry": ("types", "Telemetry"),
    "load_settings": ("config", "load_config"),
    "read_telemetry": ("io.telemetry", "read_telemetry"),
    "PersonDetector": ("people", "PersonDetector"),
    "Tracker": ("tracking", "Tracker"),
    "Tracks": ("types", "Tracks"),
}

__all__ = ["open_source", "open_video", *_HOME]


def open_video(spec: "str | Path", **options: Any) -> "Source":
    """Open a clip: a video file, a folder or glob of images, `camera:0`, `rtsp://...`, or `sim:` and a scenario.

    options: rate_hz, full_scale, single, as `io.sources.open_source` has them. A simulated clip can be steered.
    Raises InputError with one line when it cannot be read.
    """
    from torchvision_dddas.io.sources import names_file, open_source

    text = str(spec)
    if not text.startswith("sim:") or names_file(text):
        return open_source(spec, **options)
    from torchvision_dddas.errors import InputError
    from torchvision_dddas.lab.simulation import open_scenario  # takes 0.4 s to import

    if options.get("rate_hz") is not None:
        raise InputError(f"the scenario of {text} sets the frame rate (clip.rate_hz): leave --rate out")
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
