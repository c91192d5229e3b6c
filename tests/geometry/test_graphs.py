"""Graphs are opened where they are what their manifest lists, and refused in one line where they are not."""

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchvision_dddas import runtime
from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import plane_homography
from torchvision_dddas.people.onnx_scorer import OnnxScorer
from torchvision_dddas.runtime import MANIFEST, SHIPPED, manifest, opened, seal
from torchvision_dddas.types import LinearSvm

NAME = "homography.onnx"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the shipped graphs."""
    return Path(shutil.copytree(SHIPPED, tmp_path / "graphs"))


def rewrite(folder: Path, change: Callable[[dict[str, Any]], object], sealed: bool = False) -> None:
    held = json.loads((folder / MANIFEST).read_text())
    change(held)
    (folder / MANIFEST).write_text(json.dumps(held | ({"seal": seal(held)} if sealed else {})))


def refusal(folder: Path, name: str = NAME) -> str:
    with pytest.raises(InputError) as caught:
        opened(folder, name)
    return str(caught.value)


def test_the_manifest_lists_every_shipped_graph_as_the_runtime_sees_it_and_as_it_was_compared_with_torch():
    held = manifest(SHIPPED)
    assert set(held["graphs"]) == {path.name for path in SHIPPED.glob("*.onnx")}
    for name, entry in held["graphs"].items():
        session = opened(SHIPPED, name)
        for side, found in (("inputs", session.get_inputs()), ("outputs", session.get_outputs())):
            listed = [(value, f"tensor({one['type']})", one["shape"]) for value, one in entry[side].items()]
            assert [(v.name, v.type, v.shape) for v in found] == listed
        assert entry["checks"] and all(check["off"] <= check["limit"] for check in entry["checks"])
        assert {"torch", "onnx", "onnxruntime"} == set(entry["versions"])


@pytest.mark.parametrize("place", [0, 100, -1])
def test_a_graph_of_which_one_bit_was_changed_is_refused_also_by_both_back_ends(folder: Path, place: int, monkeypatch):
    for name in (NAME, "people_scores.onnx"):
        content = bytearray((folder / name).read_bytes())
        content[place] ^= 1
        (folder / name).write_bytes(content)
        assert f"{name} is not the graph that its manifest.json lists" in refusal(folder, name)
    nothing = LinearSvm(np.zeros(PeopleParameters().features, np.float32), 0.0, "none")
    with pytest.raises(InputError, match=r"people_scores.onnx is not the graph"):
        OnnxScorer(PeopleParameters(graphs=str(folder)), nothing)
    monkeypatch.setattr(plane_homography, "SHIPPED", folder)
    with pytest.raises(InputError, match=r"homography.onnx is not the graph"):
        plane_homography.open_graph.__wrapped__("homography")
    # The package's own graphs are not to be exported again.
    monkeypatch.setattr(runtime, "SHIPPED", folder)
    assert "install torchvision-dddas again" in refusal(folder)


def fit(held: dict[str, Any]) -> None:
    """As if another graph were in the place of this one."""
    held["graphs"][NAME]["sha256"] = held["graphs"]["homography_raw.onnx"]["sha256"]


@pytest.mark.parametrize(
    "change",
    [
        fit,
        lambda held: held["graphs"]["people_scores.onnx"]["knobs"].update(cell_px=4),
        lambda held: held.update(seal="0" * 64),
        lambda held: held.pop("seal"),
        lambda held: held.update(package=None),
        lambda held: held.update(more=1),
    ],
)
def test_a_manifest_that_was_changed_is_refused_even_where_it_fits_the_graph(folder: Path, change):
    shutil.copy(folder / "homography_raw.onnx", folder / NAME)
    rewrite(folder, change)
    assert "manifest.json is not as `dddas export` wrote it" in refusal(folder)


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b"null", b'{"graphs": []}', b"\xff\xfe", b"[" * 100_000])
def test_a_manifest_that_is_none_is_refused(folder: Path, text: bytes):
    (folder / MANIFEST).write_bytes(text)
    assert "damaged or changed" in refusal(folder)


def test_graphs_of_another_version_and_absent_files_are_named_in_one_line(folder: Path):
    for sealed in (True, False):
        rewrite(folder, lambda held: held.update(package="9.9.9"), sealed)
        line = refusal(folder)
        assert "made by torchvision-dddas 9.9.9, but this is version" in line and f"dddas export --out {folder}" in line
    shutil.copy(SHIPPED / MANIFEST, folder / MANIFEST)
    assert "lists no absent.onnx" in refusal(folder, "absent.onnx")
    (folder / NAME).unlink()
    assert f"cannot read {folder / NAME}" in refusal(folder)
    (folder / MANIFEST).unlink()
    assert "has no graphs with a manifest.json" in refusal(folder)


def test_a_listed_graph_that_the_runtime_cannot_open_is_one_line(folder: Path):
    (folder / NAME).write_bytes(b"no graph at all")
    digest = hashlib.sha256(b"no graph at all").hexdigest()
    rewrite(folder, lambda held: held["graphs"][NAME].update(sha256=digest), sealed=True)
    assert "cannot open" in refusal(folder)
