"""Graphs traced from `functional`: what torch computes, of standard operations, the same bytes each time.

A graph takes time for every node, so the step is traced once, at a small size and with as little flow and morphology
as there can be.
"""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxscript")
pytest.importorskip("torch")

import onnx
import torch

import torchvision_dddas.functional as F
from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.lab.export import traced_graphs as traced
from torchvision_dddas.lab.export.graph_files import OPSET, ExportedGraph, open_session, refuse_failed
from torchvision_dddas.runtime import SHIPPED

SIZE, STEP_SIZE = (96, 80), (128, 96)
LEAST = {
    "registration.levels": 1,
    "registration.iterations": 1,
    "registration.cell_px": 12,
    "difference.blur_px": 3,
    "morphology.erode_px": 1,
    "morphology.close_px": 3,
}


@pytest.fixture(scope="module")
def fast() -> Settings:
    return load_config("fast", [])


@pytest.fixture(scope="module")
def made(fast: Settings) -> ExportedGraph:
    (found,) = traced.export_segmentation("warp_difference", fast, SIZE).values()
    return found


@pytest.mark.slow
def test_the_graph_computes_what_torch_does_on_pictures_it_was_not_traced_with(made, fast):
    """Whole grey levels: three pixels in thousands may differ by rounding."""
    graph, session = traced.build_module("warp_difference", fast, SIZE), open_session(made.content)
    for seed in (5, 6):
        given = traced.example_pictures("warp_difference", fast, SIZE, seed)
        difference, mask = session.run(None, {name: value.numpy() for name, value in given.items()})
        wanted, wanted_mask = (value.numpy() for value in graph(*given.values()))
        assert wanted_mask.any() and not wanted_mask.all()
        assert np.mean(difference != wanted) < 3e-3
        assert traced.overlap(mask, wanted_mask) > 0.999


@pytest.mark.slow
def test_the_whole_step_computes_what_torch_does_on_pictures_it_was_not_traced_with(fast):
    settings = with_parameters(fast, LEAST)
    (made,) = traced.export_segmentation("step", settings, STEP_SIZE).values()
    assert all(check.is_passed for check in made.checks)
    graph, session = traced.build_module("step", settings, STEP_SIZE), open_session(made.content)
    given = traced.example_pictures("step", settings, STEP_SIZE, 1)
    for tolerance_px in (2.0, 0.5):
        given["tolerance_px"] = torch.tensor(tolerance_px, dtype=torch.float64)
        matrix, inliers, tracked, _, mask = session.run(None, {name: v.numpy() for name, v in given.items()})
        with torch.inference_mode():
            wanted = [value.numpy() for value in graph(*given.values())]
        assert traced.corner_error(matrix, wanted[0], mask.shape) < 0.1
        np.testing.assert_array_equal(tracked, wanted[2])
        assert np.abs(inliers - wanted[1]).max() <= 1 and (inliers > 8).all()
        assert traced.overlap(mask, wanted[4]) > 0.98 and mask.any() and not mask.all()


def test_the_threshold_is_an_input(made, fast):
    session = open_session(made.content)
    given = {n: v.numpy() for n, v in traced.example_pictures("warp_difference", fast, SIZE, 0).items()}
    feeds = [given | {"threshold": np.array(level, np.uint8)} for level in (10, 40, 254)]
    areas = [np.count_nonzero(session.run(["mask"], feed)[0]) for feed in feeds]
    assert areas[0] > areas[1] > areas[2] == 0


def test_only_standard_operations_are_used_and_inputs_have_names_of_our_own(made):
    model = onnx.load_from_string(made.content)
    assert [(held.domain, held.version) for held in model.opset_import] == [("", OPSET)]
    assert {node.domain for node in model.graph.node} == {""} and not model.functions
    given = traced.example_pictures("warp_difference", load_config("fast"), SIZE, 0)
    assert [value.name for value in model.graph.input] == list(given)
    assert tuple(value.name for value in model.graph.output) == traced.SEGMENTATION["warp_difference"][1]


@pytest.mark.slow
def test_the_file_is_the_same_each_time_and_holds_nothing_of_the_machine(made, fast):
    (again,) = traced.export_segmentation("warp_difference", fast, SIZE).values()
    assert again.content == made.content
    for trace in (b".py", b"File ", str(Path.cwd()).encode(), torch.__version__.encode()):
        assert trace not in made.content


def test_a_graph_that_computes_something_else_does_not_pass(made, fast):
    assert all(check.is_passed for check in made.checks)
    other = traced.build_module("warp_difference", with_parameters(fast, {"morphology.erode_px": 1}), SIZE)
    examples = [traced.example_pictures("warp_difference", fast, SIZE, 0)]
    assert not all(check.is_passed for check in traced.compare(made.content, other, "warp_difference", examples))


@pytest.mark.parametrize(("model", "off_px"), [("homography", 0.25), ("affine", 1.0)])
def test_the_step_finds_the_motion_of_the_background_and_what_moves_on_it(fast, model, off_px):
    """As torch runs it, before it is traced."""
    settings, size = with_parameters(fast, {"registration.model": model}), (320, 240)
    given = traced.example_pictures("step", settings, size, 0)
    known = traced.example_pictures("warp_difference", settings, size, 0)["neighbour_from_reference"].numpy()
    with torch.inference_mode():
        matrix, inliers, tracked, difference, mask = traced.build_module("step", settings, size)(*given.values())
    assert traced.corner_error(matrix.numpy(), known, (240, 320)) < off_px
    assert (inliers > 0.8 * tracked).all() and difference.shape == mask.shape == (240, 320)
    assert mask[114:126, 128 + 4 : 148 - 4].any() or mask[72:92, 96:116].any()
    assert (mask > 0).float().mean() < 0.03


def test_where_nothing_agrees_the_motion_is_the_identity_with_no_inliers(fast):
    size, noise = (160, 120), torch.Generator().manual_seed(0)
    given = traced.example_pictures("step", fast, size, 0)
    given["neighbours"] = torch.randint(0, 256, (2, 120, 160), dtype=torch.uint8, generator=noise)
    given["reference"] = torch.full((120, 160), 90, dtype=torch.uint8)
    with torch.inference_mode():
        matrix, inliers, *_ = traced.build_module("step", fast, size)(*given.values())
    np.testing.assert_array_equal(matrix.numpy(), np.tile(np.eye(3), (2, 1, 1)))
    assert not inliers.any()


@pytest.fixture(scope="module")
def planes() -> dict[str, ExportedGraph]:
    return traced.export_homographies()


def test_homographies_place_4_to_16_landmarks_where_torch_does(planes):
    refuse_failed(planes)
    assert traced.homography_difference_px({name: made.content for name, made in planes.items()}) < 1e-6
    assert traced.homography_difference_px({name: (SHIPPED / name).read_bytes() for name in planes}) < 1e-6


def test_homographies_take_any_batch_and_use_standard_operations(planes):
    for made in planes.values():
        model = onnx.load_from_string(made.content)
        assert {node.domain for node in model.graph.node} == {""}
        for value in model.graph.input:
            assert [d.dim_param for d in value.type.tensor_type.shape.dim][:2] == ["B", "n"]
    given, session = traced.example_landmarks(6, 3, 1), open_session(planes["homography.onnx"].content)
    together, _ = session.run(None, given)
    for k in range(3):
        alone, _ = session.run(None, {name: array[k : k + 1] for name, array in given.items()})
        np.testing.assert_allclose(together[k : k + 1], alone, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("tilt", "is_seen"), [(-0.999, True), (-1.001, False)])
def test_the_horizon_of_the_homography_graph_is_that_of_torch(planes, tilt: float, is_seen: bool):
    corners = np.array([[[0.0, 0], [1, 0], [1, 1], [0, 1]]])
    image = corners / (1 + corners @ (tilt, 0))[..., None]
    given = {"ground": corners, "image": image, "weight": np.ones((1, 4))}
    _, valid = open_session(planes["homography.onnx"].content).run(None, given)
    torch_valid = F.find_homography(*(torch.from_numpy(array) for array in given.values()))[1]
    assert valid.item() == torch_valid.item() == is_seen
