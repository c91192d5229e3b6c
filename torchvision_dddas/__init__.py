"""Dynamic data-driven visual surveillance with cooperative unmanned vehicles.

The public names below are loaded when first used (PEP 562), so that `import torchvision_dddas` costs nothing and needs
neither torch nor OpenCV.
"""

from importlib import import_module

__version__ = "0.1.0"

# Public name -> the module that holds it, and its name there.
_HOME = {
    "Adjustment": ("types", "Adjustment"),
    "Detections": ("types", "Detections"),
    "Frame": ("types", "Frame"),
    "InputError": ("errors", "InputError"),
    "Registration": ("types", "Registration"),
    "Scene": ("types", "Scene"),
    "Settings": ("config", "Settings"),
    "Telemetry": ("types", "Telemetry"),
    "load_settings": ("config", "load_config"),
    "open_source": ("io.sources", "open_source"),
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, inside = _HOME[name]
    value = getattr(import_module(f"{__name__}.{module}"), inside)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
