"""Dynamic data-driven visual surveillance with cooperative unmanned vehicles.

The public names below are loaded when first used (PEP 562), so that `import torchvision_dddas` costs nothing and needs
neither torch nor OpenCV.
"""

from importlib import import_module

__version__ = "0.1.0"

# Public name -> the module that holds it.
_HOME = {
    "Adjustment": "types",
    "Detections": "types",
    "Frame": "types",
    "Registration": "types",
    "Scene": "types",
    "Telemetry": "types",
    "InputError": "errors",
    "Settings": "settings",
    "load_settings": "settings",
    "open_source": "sources",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
