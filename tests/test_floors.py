"""Who may import whom. Two floors, one seam: torch stays below it, and the onboard install never meets it."""

import ast
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

import torchvision_dddas

PACKAGE = Path(torchvision_dddas.__file__).parent
OWN = "torchvision_dddas"

# Module or folder -> what it may import beside the standard library, itself and names of shapes. The longest name that
# fits decides. A new module or folder needs a line here. "*" is anything but torch and kornia at module level.
FLOORS: dict[str, set[str]] = {
    "__init__": set(),
    "types": {"numpy"},
    "errors": set(),
    "shapes": set(),
    "settings": {"pydantic", "errors"},
    "ops": {"torch", "kornia", "errors"},
    # Labelling stays in OpenCV for every runtime: hence cv2 here.
    "targets": {"numpy", "scipy", "cv2", "pymap3d", "types", "settings", "errors"},
    "vision": {"numpy", "targets.projective", "types", "settings", "errors"},
    "vision.torch_vision": {"torch", "numpy", "cv2", "ops", "types", "settings", "errors"},
    "vision.torch_registration": {"torch", "numpy", "ops", "targets.projective", "types", "settings", "errors"},
    "vision.torch_following": {"torch", "ops", "types", "settings"},
    "vision.torch_pixels": {"torch", "ops", "settings"},
    "vision.torch_people": {"torch", "numpy", "ops", "types", "settings", "errors"},
    "vision.onboard_people": {"cv2", "numpy", "onnxruntime", "types", "settings", "errors"},
    "vision.graphs": {"onnxruntime", "errors", "__init__"},
    "vision.onboard_gradient": {"cv2", "numpy"},
    "vision.onboard_plane": {"numpy", "onnxruntime", "types", "errors"},
    "vision.onboard_colours": {"cv2", "numpy", "types", "errors"},
    "vision.torch_plane": {"torch", "numpy", "ops", "types", "errors"},
    "vision.torch_colours": {"torch", "numpy", "ops", "types", "errors"},
    "vision.scratch": {"numpy"},
    "vision.exposure": {"cv2", "numpy"},
    "vision.histograms": {"cv2", "numpy"},
    "vision.onboard_vision": {"cv2", "numpy", "onnxruntime", "targets.silhouette", "types", "settings", "errors"},
    "vision.onboard_registration": {"cv2", "numpy", "targets.projective", "types", "settings", "errors"},
    "vision.onboard_half": {"cv2", "numpy", "types", "settings"},
    "vision.onboard_pixels": {"cv2", "numpy", "targets.projective", "types", "settings", "errors"},
    "vision.appearance": {"cv2", "numpy"},
    "vision.camera": {"cv2", "numpy", "targets.projective", "types", "settings"},
    "windows": {"settings"},
    "pipeline": {"numpy", "targets", "types", "settings", "vision", "errors"},
    "control": {"numpy", "targets.gates", "types", "settings", "errors"},
    "run": {"numpy", "pipeline", "control", "windows", "sources", "vision", "targets", "types", "settings", "errors"},
    "recognizing": {"numpy", "sources", "vision", "targets", "types", "settings", "errors"},
    "confirming": {"numpy", "sources", "targets", "types", "settings", "errors"},
    "locating": {"numpy", "sources", "targets", "types", "settings", "errors"},
    "following": {"numpy", "sources", "vision", "targets", "types", "settings", "errors"},
    "geolocating": {"numpy", "sources", "vision", "targets", "control", "types", "settings", "errors"},
    "steering": {"numpy", "scipy", "control", "targets", "types", "settings", "errors"},
    # The whole path, and the loop about it.
    "surveying": {"following", "run", "geolocating", "sources", "vision", "targets", "mission", "types", "settings"},
    "spotting": {"numpy", "recognizing", "following", "sources", "vision", "targets", "types", "settings", "errors"},
    "mission": {
        "numpy",
        "steering",
        "geolocating",
        "recognizing",
        "confirming",
        "sources",
        "vision",
        "targets",
        "types",
        "settings",
        "errors",
    },
    # A run that keeps up with a camera: capture, load, health, the page that shows it.
    "live": {"numpy", "run", "surveying", "control", "sources", "vision", "types", "settings", "errors"},
    # What files of pictures hold, for all that read such.
    "picture_bytes": {"cv2", "numpy"},
    "sources": {"numpy", "cv2", "av", "simulation", "picture_bytes", "types", "errors"},
    "sources.telemetry": {"numpy", "av", "pymavlink", "pyulog", "pynmea2", "sources", "types", "errors"},
    "sources.elevation": {"numpy", "rasterio", "types", "errors"},
    "sinks": {"numpy", "cv2", "av", "types", "errors", "__init__"},
    # A study's page tells its results and draws its clips' pictures.
    "sinks.study_report": {
        "numpy",
        "cv2",
        "sinks",
        "metrics",
        "sources",
        "studies.record",
        "studies.scored",
        "picture_bytes",
        "errors",
    },
    "simulation": {"numpy", "cv2", "types", "targets.geodesy", "errors"},
    # A scenario is knobs: the same machinery reads, checks and describes them.
    "simulation.scenario": {"pydantic", "settings", "errors"},
    "metrics": {"numpy", "scipy", "cv2", "picture_bytes", "types", "errors"},
    # Data sets as they lie on disk: what is true of their clips, and where their pictures are.
    "datasets": {"numpy", "cv2", "metrics", "sources", "picture_bytes", "types", "errors"},
    # Many clips at once: what runs them is loaded in the jobs.
    "studies": {"*"},
    "demo": {"numpy", "cv2", "simulation", "sinks", "errors"},
    "evaluate": {"numpy", "cv2", "metrics", "sources", "errors"},
    # Knobs as parameters, and the steps that they steer, softened.
    "modules": {"torch", "ops", "settings", "errors", "types"},
    # The body in a window and its odds: the same formulas on tensors.
    "modules.people": {"torch", "ops", "targets.persons"},
    # The tracker's own formulas, on tensors.
    "modules.links": {"torch", "ops", "targets", "settings"},
    # The source's own formulas, on tensors.
    "modules.affinities": {"torch", "ops", "targets", "settings"},
    "tuning": {"torch", "*"},
    "exporting": {"torch", "*"},
    "onboard": {"*"},
    "cli": {"*"},
}
# Only these may need torch to be imported at all.
NEED_TORCH = (
    "ops",
    "vision.torch_vision",
    "vision.torch_registration",
    "vision.torch_following",
    "vision.torch_pixels",
    "vision.torch_people",
    "vision.torch_plane",
    "vision.torch_colours",
    "modules",
    "tuning",
    "exporting",
)
BACK_ENDS = ("vision.torch_", "vision.onboard_")

FILES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}


def below(name: str, prefix: str) -> bool:
    return name == prefix or name.startswith(prefix + ".")


def imports(source: str, module: str, is_package: bool) -> Iterator[tuple[str, bool]]:
    """Every module imported anywhere in the file, own ones without the package's name, and whether at module level."""
    tree = ast.parse(source)
    inside = {
        id(node)
        for outer in ast.walk(tree)
        if isinstance(outer, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
        for node in ast.walk(outer)
    }
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                home = f"{OWN}.{module}".split(".")
                home = home if is_package and node.level == 1 else home[: len(home) - node.level + is_package]
                base = ".".join([*home, base] if base else home)
            # `from package import name`: the name may itself be a module.
            names = [f"{base}.{alias.name}" if is_module(f"{base}.{alias.name}") else base for alias in node.names]
        for name in names:
            own = name.removeprefix(OWN).removeprefix(".") if below(name, OWN) else name
            yield own or "__init__", id(node) not in inside


def is_module(name: str) -> bool:
    return name.removeprefix(OWN + ".") in FILES if below(name, OWN) else False


def strangers(module: str, source: str, is_package: bool = False) -> list[str]:
    """The imports of a file that its floor does not allow."""
    floors = [floor for floor in FLOORS if below(module, floor)]
    if not floors:
        return [f"torchvision_dddas/{module} is in no floor: add it to FLOORS, and to the layout"]
    floor = max(floors, key=len)
    folder = module.split(".")[0]
    allowed = FLOORS[floor]
    wrong = []
    for name, at_module_level in imports(source, module, is_package):
        top = name.split(".")[0]
        is_torch = top in {"torch", "kornia", "torchvision"}
        if top in sys.stdlib_module_names and name not in FILES:
            continue
        # Both back ends speak the seam's words; the seam loads one of them only when asked to, and neither the other.
        if folder == top == "vision":
            home, asked = (next((b for b in BACK_ENDS if m.startswith(b)), None) for m in (module, name))
            if asked is not None and asked != home and (at_module_level or home is not None):
                wrong.append(name)
            continue
        if (
            name in ("jaxtyping", "shapes")
            or (not is_torch and below(name, floor))
            or any(below(name, other) for other in allowed)
        ):
            continue
        if "*" in allowed and not (is_torch and at_module_level):
            continue
        wrong.append(name)
    return wrong


@pytest.mark.parametrize("module", FILES)
def test_a_module_imports_only_what_its_floor_allows(module: str) -> None:
    path = FILES[module]
    assert strangers(module, path.read_text(encoding="utf-8"), path.name == "__init__.py") == []


@pytest.mark.parametrize(
    ("module", "source", "stranger"),
    [
        ("targets.blobs", "import torch", "torch"),
        ("targets.blobs", "from ..ops.warp import warp", "ops.warp"),
        ("targets.blobs", "from torchvision_dddas.detection.engines import load", "vision"),
        ("types", "def f():\n    import cv2", "cv2"),
        ("ops.warp", "from torchvision_dddas.config import Settings", "settings"),
        ("ops.warp", "import numpy as np", "numpy"),
        ("vision.onboard_vision", "def f():\n    from torchvision_dddas.functional import warp", "ops.warp"),
        ("vision.onboard_vision", "from torchvision_dddas.detection.torch_engine import load", "vision.torch_vision"),
        (
            "vision.onboard_vision",
            "def f():\n    import torchvision_dddas.detection.torch_engine",
            "vision.torch_vision",
        ),
        (
            "vision.onboard_pixels",
            "from torchvision_dddas.detection.torch_foreground import warp",
            "vision.torch_pixels",
        ),
        ("vision.judgement", "from torchvision_dddas.detection.torch_foreground import warp", "vision.torch_pixels"),
        ("vision", "from torchvision_dddas.detection.torch_engine import load", "vision.torch_vision"),
        ("cli.detect", "import torch", "torch"),
        ("cli.detect", "class A:\n    from kornia import filters", "kornia"),
        ("pipeline", "from torchvision_dddas.io.sources import open_source", "sources"),
        ("control", "from . import pipeline", "pipeline"),
    ],
)
def test_a_forbidden_import_is_noticed(
    monkeypatch: pytest.MonkeyPatch, module: str, source: str, stranger: str
) -> None:
    for name in ("ops.warp", "pipeline", "vision.torch_vision", "vision.protocol"):
        monkeypatch.setitem(FILES, name, PACKAGE / "types.py")
    assert strangers(module, source) == [stranger]


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("cli.detect", "def f():\n    import torch"),
        ("vision", "def f():\n    from torchvision_dddas.detection.torch_engine import load"),
        ("vision.torch_vision", "import torch\nfrom .protocol import Vision\nfrom .torch_pixels import warp"),
        ("targets.geodesy", "import math\nfrom torchvision_dddas.types import Frame\nfrom .plane import solve"),
        ("ops.warp", "import torch.nn.functional as F\nfrom ..errors import InputError"),
    ],
)
def test_an_allowed_import_passes(monkeypatch: pytest.MonkeyPatch, module: str, source: str) -> None:
    monkeypatch.setitem(FILES, "vision.torch_vision", PACKAGE / "types.py")
    assert strangers(module, source) == []


def test_a_new_folder_must_be_given_a_floor() -> None:
    (message,) = strangers("helpers.misc", "")
    assert "add it to FLOORS" in message


def test_everything_that_the_onboard_install_needs_imports_without_torch() -> None:
    """On a machine where torch cannot be imported, all modules but those that are made of it can."""
    script = textwrap.dedent(f"""
        import importlib, pkgutil, sys

        class NoTorch:
            def find_spec(self, name, path=None, target=None):
                if name.split(".")[0] in ("torch", "kornia", "torchvision"):
                    raise ModuleNotFoundError(f"{{name}} is not part of the onboard install", name=name)

        sys.meta_path.insert(0, NoTorch())
        import {OWN}

        seen = []
        def walk(package):
            for entry in pkgutil.iter_modules(package.__path__, package.__name__ + "."):
                short = entry.name.removeprefix("{OWN}.")
                if any(short == name or short.startswith(name + ".") for name in {NEED_TORCH!r}):
                    continue
                module = importlib.import_module(entry.name)
                seen.append(short)
                if entry.ispkg:
                    walk(module)
        walk({OWN})
        for name in {OWN}.__all__:
            getattr({OWN}, name)
        assert not {{"torch", "kornia"}} & set(sys.modules)
        print(*seen)
    """)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    found = set(done.stdout.split())
    wanted = {name for name in FILES if name != "__init__" and not any(below(name, torch) for torch in NEED_TORCH)}
    assert found == wanted


def test_importing_the_package_loads_nothing_heavy() -> None:
    script = f"import sys, {OWN}; print(*{{'numpy', 'cv2', 'pydantic', 'torch', 'scipy'}} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == ""


def test_public_names_are_found_and_others_are_not() -> None:
    assert {"open_source", "load_settings"} <= set(dir(torchvision_dddas))
    with pytest.raises(AttributeError, match="has no attribute 'absent'"):
        _ = torchvision_dddas.absent
