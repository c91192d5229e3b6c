"""The folder of graphs: written whole or not at all, with one manifest that lists what is there."""

from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("onnx")
pytest.importorskip("torch")

from onnx import TensorProto

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import PartFile
from torchvision_dddas.lab.export.graph_files import Check, ExportedGraph, write_graphs
from torchvision_dddas.lab.export.people_graphs import GraphBuilder
from torchvision_dddas.runtime import MANIFEST, manifest, opened


def doubled(factor: float) -> ExportedGraph:
    graph = GraphBuilder()
    graph("Mul", "x", graph.number(factor), out="y")
    content = graph.model({"x": (TensorProto.FLOAT, ["n"])}, {"y": (TensorProto.FLOAT, ["n"])}, {}, "doubled")
    return ExportedGraph(content, "twice as much", "ops.nothing", {"factor": factor}, (Check("-", 0.0, 1e-6),))


def test_what_is_written_opens_and_the_manifest_says_what_it_is(tmp_path: Path):
    write_graphs(tmp_path / "deep" / "own", {"a.onnx": doubled(2.0)})
    folder = tmp_path / "deep" / "own"
    assert sorted(path.name for path in folder.iterdir()) == ["a.onnx", MANIFEST]
    (held,) = manifest(folder)["graphs"].values()
    assert held["inputs"] == {"x": {"type": "float", "shape": ["n"]}} and held["knobs"] == {"factor": 2.0}
    assert held["about"] == "twice as much" and held["checks"] == [{"unit": "-", "off": 0.0, "limit": 1e-06}]
    (found,) = opened(folder, "a.onnx").run(None, {"x": [1.5]})
    assert found.tolist() == [3.0]


def test_the_same_graphs_give_the_same_bytes(tmp_path: Path):
    written = []
    for name in ("one", "other"):
        write_graphs(tmp_path / name, {"a.onnx": doubled(2.0), "b.onnx": doubled(3.0)})
        written.append({path.name: path.read_bytes() for path in (tmp_path / name).iterdir()})
    assert written[0] == written[1] and set(written[0]) == {"a.onnx", "b.onnx", MANIFEST}


@pytest.mark.parametrize("off", [(2e-6,), (float("nan"),), (float("inf"),), ()])
def test_a_graph_that_is_off_or_was_not_compared_keeps_all_of_them_from_being_written(tmp_path: Path, off):
    wrong = replace(doubled(2.0), checks=tuple(Check("m", value, 1e-6) for value in off))
    line = r" m, 1e-06 allowed" if off else "was never compared"
    with pytest.raises(InputError, match=rf"b.onnx does not agree with ops.nothing: .*{line}"):
        write_graphs(tmp_path / "own", {"a.onnx": doubled(2.0), "b.onnx": wrong})
    assert not (tmp_path / "own").exists()


def test_graphs_that_were_there_stay_listed_and_a_newer_one_takes_its_place(tmp_path: Path):
    write_graphs(tmp_path, {"a.onnx": doubled(2.0), "b.onnx": doubled(3.0)})
    write_graphs(tmp_path, {"b.onnx": doubled(4.0)})
    factors = {name: held["knobs"]["factor"] for name, held in manifest(tmp_path)["graphs"].items()}
    assert factors == {"a.onnx": 2.0, "b.onnx": 4.0}
    assert opened(tmp_path, "a.onnx") is not None and opened(tmp_path, "b.onnx") is not None


def test_writing_again_mends_a_folder_whose_manifest_was_changed(tmp_path: Path):
    write_graphs(tmp_path, {"a.onnx": doubled(2.0), "b.onnx": doubled(3.0)})
    (tmp_path / MANIFEST).write_text((tmp_path / MANIFEST).read_text().replace("twice", "thrice"))
    write_graphs(tmp_path, {"b.onnx": doubled(3.0)})
    assert opened(tmp_path, "b.onnx") is not None
    with pytest.raises(InputError, match=r"lists no a.onnx"):
        opened(tmp_path, "a.onnx")


def test_a_full_disk_leaves_what_was_there(tmp_path: Path, monkeypatch):
    write_graphs(tmp_path, {"a.onnx": doubled(2.0)})
    before, real = {path.name: path.read_bytes() for path in tmp_path.iterdir()}, PartFile.write

    def full(part: PartFile, content: bytes) -> None:
        if "manifest" in part.path.name:
            raise OSError(28, "No space left on device")
        real(part, content)

    monkeypatch.setattr(PartFile, "write", full)
    with pytest.raises(InputError, match=r"cannot write .*No space left on device"):
        write_graphs(tmp_path, {"a.onnx": doubled(5.0), "b.onnx": doubled(3.0)})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
