"""The public names: the stub and the package agree, arguments keep to one convention, and every example runs."""

import ast
import dataclasses
import doctest
import inspect
import pydoc
from collections.abc import Iterator
from importlib import import_module
from itertools import combinations
from pathlib import Path
from types import ModuleType

import numpy
import pytest

import torchvision_dddas as td
from torchvision_dddas.config import load_config

STUB = Path(td.__file__).with_suffix(".pyi")


def test_the_stub_names_what_the_package_has_and_from_where() -> None:
    stub = {}
    for node in ast.parse(STUB.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module != "pathlib":
            for alias in node.names:
                module = __import__(str(node.module), fromlist=[alias.name])
                if alias.asname:
                    stub[alias.asname] = getattr(module, alias.name)
        elif isinstance(node, ast.FunctionDef):
            stub[node.name] = td.open_video
    stub |= {"__version__": td.__version__, "load_settings": load_config}
    assert stub == {name: getattr(td, name) for name in dir(td)}


def test_a_type_checker_knows_the_names_and_the_settings() -> None:
    number: float = td.Settings().difference.threshold
    text: str = td.Settings().difference.threshold  # type: ignore[assignment]
    _: int = td.open_video  # type: ignore[assignment]
    assert (number, text) == (3.5, 3.5)  # type: ignore[comparison-overlap]


def test_help_on_settings_is_short_and_says_what_each_group_and_parameter_is() -> None:
    shown = pydoc.plain(pydoc.render_doc(td.Settings))
    assert len(shown) < 5000 and "model_dump" not in shown
    assert " |  gates: " in shown
    assert " |  expected_size_m [m]: " in pydoc.plain(pydoc.render_doc(type(td.Settings().gates)))
    assert repr(td.load_settings(None, ["small.on=false"])) == "Settings(small=SmallParameters(on=False))"


# -- Arguments and examples ------------------------------------------------------------------------------------------

# Data that may be given by position though it may be left out.
INPUTS = {"telemetry", "landmarks", "camera_motion", "overrides", "weights", "later_from_earlier", "guess"}
# Protocols, and annotations.
NO_EXAMPLE = {"Source", "Bool", "Float", "Int"}
# What Kornia has too is signed as there.
KORNIA = {"find_homography", "gaussian_blur2d", "oneway_transfer_error", "transform_points", "warp_perspective"}


def rooms() -> Iterator[tuple[str, ModuleType, list[str]]]:
    pytest.importorskip("torch")
    for name in ("", ".types", ".functional", ".nn"):
        module = import_module(f"torchvision_dddas{name}")
        yield name, module, dir(td) if module is td else module.__all__


def callables() -> Iterator[tuple[str, list[inspect.Parameter]]]:
    """Every public function, and the methods of every public class; records are made by their fields."""
    for room, module, names in rooms():
        for name in names:
            value = getattr(module, name)
            members = {name: value}
            if inspect.isclass(value):
                is_record = dataclasses.is_dataclass(value)
                members = {f"{name}.{key}": each for key, each in vars(value).items() if key[0] != "_"}
                members |= {} if is_record or "__init__" not in vars(value) else {f"{name}.__init__": value.__init__}
            for label, member in members.items():
                function = inspect.unwrap(getattr(member, "__func__", member))
                if inspect.isfunction(function) and function.__module__.startswith("torchvision_dddas"):
                    given = list(inspect.signature(function).parameters.values())
                    yield f"td{room}.{label}", given[1:] if given and given[0].name in ("self", "cls") else given


def test_options_are_given_by_name() -> None:
    """By position: what has no default, the first argument unless it is a switch, and INPUTS."""
    wrong = [
        f"{label}({one.name})"
        for label, given in callables()
        for k, one in enumerate(given)
        if one.kind == one.POSITIONAL_OR_KEYWORD and one.default is not one.empty
        if isinstance(one.default, bool) or not (k == 0 or one.name in INPUTS)
        if label.split(".")[-1] not in KORNIA
    ]
    assert wrong == []


def test_arguments_come_in_the_same_order_everywhere() -> None:
    first: dict[tuple[str, str], str] = {}
    for label, given in callables():
        names = [one.name for one in given if one.kind == one.POSITIONAL_OR_KEYWORD]
        for pair in combinations(names, 2):
            first.setdefault(pair, label)
    assert [(a, b, first[a, b], first[b, a]) for a, b in first if a < b and (b, a) in first] == []


def documented() -> dict[str, str]:
    """The docstring of every public function and class."""
    found = {}
    for _, module, names in rooms():
        for name in names:
            value = getattr(module, name)
            own = getattr(value, "__module__", "").startswith("torchvision_dddas")
            if own and (inspect.isclass(value) or callable(value)) and name not in NO_EXAMPLE:
                found[f"{value.__module__}.{value.__qualname__}"] = value.__doc__ or ""
    return found


def test_every_public_name_has_an_example() -> None:
    assert [name for name, text in documented().items() if ">>> " not in text] == []


def test_every_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    modules = {"F": "torchvision_dddas.functional", "nn": "torchvision_dddas.nn", "types": "torchvision_dddas.types"}
    modules |= {"np": "numpy", "pathlib": "pathlib", "td": "torchvision_dddas", "torch": "torch"}
    given = {name: import_module(module) for name, module in modules.items()}
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    report: list[str] = []
    for name, text in documented().items():
        import_module("torch").manual_seed(0)
        with numpy.printoptions(precision=4, suppress=True):
            runner.run(doctest.DocTestParser().get_doctest(text, dict(given), name, None, 0), out=report.append)
    assert report == []
