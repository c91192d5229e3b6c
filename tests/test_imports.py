"""Who may import whom: each room imports only rooms below it, and only the torch rooms need torch."""

import ast
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

import torchvision_dddas

PACKAGE = Path(torchvision_dddas.__file__).parent
OWN = "torchvision_dddas"

# From the bottom to the top; rooms of one line do not import each other, except on the first line.
ORDER = (
    ("errors", "types", "config", "geometry", "memory", "runtime"),
    ("chain",),
    ("functional",),
    ("nn",),
    ("io",),
    ("detection", "tracking", "people", "geo"),
    ("control",),
    ("pipeline",),
    ("live",),
    ("lab", "lab.simulation", "lab.benchmark"),
    ("lab.evaluation", "lab.export"),
    ("lab.tuning",),
    ("cli",),
)
FLOOR = {room: floor for floor, rooms in enumerate(ORDER) for room in rooms}
# Rooms that are made of torch; elsewhere only modules whose name begins with `torch_` import it.
TORCH_ROOMS = ("functional", "nn", "lab.tuning", "lab.export")
# Rooms that load a file at a time, for the start of a command: these modules are what other rooms may name.
OPEN = {
    "io": "atomic_files camera_files colour_files detection_tables drawing elevation foreign_boxes ground_tables "
    "images interrupts joined_clips live_streams maps.formats maps.ground_tracks maps.map_picture mavlink_link output "
    "overlay overlay_video report report.charts report.figure_files report.table_files platform_files sources streams "
    "tables telemetry track_files video_packets zone_files",
    "lab.evaluation": "datasets.record evaluate metrics.matching metrics.registry metrics.truth simulated_run "
    "studies.cache studies.comparison studies.jobs studies.kept studies.methods studies.records studies.runner "
    "studies.scoring studies.stages studies.summary studies.sweep",
}
# Tuning and export take the inside of the engines apart; what needs torch is not loaded with a room that does not.
PAST = {
    ("cli", "lab.benchmark.torch_operations"),
    ("cli", "lab.export.graph_files"),
    ("detection", "functional.filters"),
    *(("lab.export", name) for name in ("functional.hog_svm", "people.onnx_scorer", "people.torch_scorer")),
    ("lab.tuning", "detection.opencv_engine"),
    *(
        ("lab.tuning", f"tracking.{n}")
        for n in ("appearance", "kalman", "scene", "score_tracker", "scores", "smoother")
    ),
}
MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}


def room(module: str) -> str:
    first, *others = module.split(".")
    return f"lab.{others[0]}" if first == "lab" and others else first


def imports(module: str, source: str, is_package: bool) -> Iterator[tuple[str, bool]]:
    """Every module that a file imports, own ones without the package's name; and whether at the top of the file."""
    tree = ast.parse(source)
    inside = {id(n) for f in ast.walk(tree) if isinstance(f, (ast.FunctionDef, ast.Lambda)) for n in ast.walk(f)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                home = f"{OWN}.{module}".split(".") if module != "__init__" else [OWN]
                home = home[: len(home) - node.level + is_package]
                base = ".".join([*home, base] if base else home)
            names = [f"{base}.{a.name}" if f"{base}.{a.name}"[len(OWN) + 1 :] in MODULES else base for a in node.names]
        elif isinstance(node, ast.Call) and getattr(node.func, "id", getattr(node.func, "attr", "")) == "import_module":
            names = [str(given.value) for given in node.args[:1] if isinstance(given, ast.Constant)]
        else:
            continue
        for name in names:
            own = name == OWN or name.startswith(OWN + ".")
            yield name[len(OWN) + 1 :] or "__init__" if own else name, id(node) not in inside


def upward(module: str, source: str, is_package: bool = False) -> list[str]:
    """The own modules that a file imports from above its floor, or from another room of the same floor."""
    if module == "__init__":
        return []
    if room(module) not in FLOOR:
        return [f"{module} is in no room: give it a place in ORDER and in docs/architecture.md"]
    here = FLOOR[room(module)]
    found = []
    for name, _ in imports(module, source, is_package):
        if room(name) in FLOOR and room(name) != room(module):
            there = FLOOR[room(name)]
            if there > here or (there == here and here > 0):
                found.append(name)
    return sorted(set(found))


def listed(name: str) -> set[str]:
    """What the `__init__` of a room lists for other rooms."""
    text = PACKAGE.joinpath(*name.split("."), "__init__.py").read_text(encoding="utf-8")
    names = re.search(r"^__all__ = (\[.*?\])", text, re.MULTILINE | re.DOTALL)
    return set(ast.literal_eval(names[1])) if names else set()


def past(module: str, source: str, is_package: bool = False) -> set[tuple[str, str]]:
    """The file's room and each module of another room that it names past the `__init__` of that room."""
    here, found = room(module), set()
    for name, _ in imports(module, source, is_package):
        there = room(name)
        if there in FLOOR and name != there and there != here != "__init__":
            may = OPEN[there].split() if there in OPEN else listed(there)
            found |= set() if name.removeprefix(f"{there}.") in may else {(here, name)}
    return found


def needs_torch(module: str) -> bool:
    return room(module) in TORCH_ROOMS or module.rpartition(".")[2].startswith("torch_")


@pytest.mark.parametrize("module", MODULES)
def test_a_module_imports_only_from_rooms_below_its_own(module: str) -> None:
    path = MODULES[module]
    assert upward(module, path.read_text(encoding="utf-8"), path.name == "__init__.py") == []


@pytest.mark.parametrize("module", [m for m in MODULES if not needs_torch(m)])
def test_only_torch_modules_import_torch_at_the_top(module: str) -> None:
    path = MODULES[module]
    at_top = {
        name.split(".")[0]
        for name, top in imports(module, path.read_text(encoding="utf-8"), path.name == "__init__.py")
        if top
    }
    assert not at_top & {"torch", "kornia"}


@pytest.mark.parametrize(
    ("module", "source", "wrong"),
    [
        ("geo.plane", f"from {OWN}.detection.engine import View", ["detection.engine"]),
        ("types", f"def f():\n    from {OWN}.config import Settings", []),
        ("detection.blobs", f"from {OWN} import pipeline", ["pipeline"]),
        ("control.rules", f"import {OWN}.live.session", ["live.session"]),
        ("geo.plane", f"import importlib\nimportlib.import_module('{OWN}.live.session')", ["live.session"]),
        ("live.session", f"def f():\n    from {OWN}.lab.tuning import tuner", ["lab.tuning.tuner"]),
        ("cli.detect", f"from {OWN}.io.sources import VideoSource", []),
        ("helpers.misc", "", ["helpers.misc is in no room: give it a place in ORDER and in docs/architecture.md"]),
    ],
)
def test_an_import_upward_is_noticed(monkeypatch, module: str, source: str, wrong: list[str]) -> None:
    assert upward(module, source) == wrong


def test_rooms_are_entered_by_their_init_but_for_stated_exceptions() -> None:
    found = (past(m, path.read_text(encoding="utf-8"), path.name == "__init__.py") for m, path in MODULES.items())
    assert set().union(*found) == PAST


@pytest.mark.parametrize(
    ("source", "wrong"),
    [
        (f"from {OWN}.geo.site import Site", {("control", "geo.site")}),
        (f"def f():\n    from {OWN}.people import detector", {("control", "people.detector")}),
        (f"import {OWN}.io.captures", {("control", "io.captures")}),
        (f"from {OWN}.geo import Site\nfrom {OWN}.io.images import Masks\nfrom {OWN}.control.rules import shed", set()),
    ],
)
def test_an_import_past_the_init_of_a_room_is_noticed(source: str, wrong: set[tuple[str, str]]) -> None:
    assert past("control.mission", source) == wrong


def test_everything_but_torch_modules_imports_without_torch() -> None:
    """On a machine where torch cannot be imported, all modules but those that are made of it can."""
    names = [name for name in MODULES if name != "__init__" and not needs_torch(name)]
    script = textwrap.dedent(f"""
        import importlib, sys

        class NoTorch:
            def find_spec(self, name, path=None, target=None):
                if name.split(".")[0] in ("torch", "kornia", "torchvision"):
                    raise ModuleNotFoundError(f"{{name}} is not part of the onboard install", name=name)

        sys.meta_path.insert(0, NoTorch())
        for name in {names!r}:
            importlib.import_module("{OWN}." + name)
        assert not {{"torch", "kornia"}} & set(sys.modules)
    """)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("statement", "heavy"),
    [
        (f"import {OWN}", {"numpy", "cv2", "pydantic", "torch", "scipy"}),
        (f"from {OWN} import MotionDetector, Tracker", {"torch", "kornia", "pandas", "scipy.optimize"}),
    ],
)
def test_an_import_loads_nothing_heavy(statement: str, heavy: set[str]) -> None:
    script = f"import sys; {statement}; print(*{heavy!r} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == ""


def test_unknown_public_names_are_refused() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'absent'"):
        _ = torchvision_dddas.absent  # type: ignore[attr-defined]
