"""Graphs traced from `ops`: what torch computes, of standard operations, the same bytes each time.

A graph takes time for every node, so the step is traced once, at a small size and with as little flow and morphology
as there can be; eval/step_graph.py compares the whole of it, on real clips too.
"""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxscript")
pytest.importorskip("torch")

import onnx
import onnxruntime
import torch

from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.export import traced_graphs as traced
from torchvision_dddas.export.checked import Made
from torchvision_dddas.export.graph_builder import OPSET

SIZE, STEP_SIZE = (96, 80), (128, 96)
LEAST = {
    "registration.model": "affine",
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
def made(fast: Settings) -> Made:
    (found,) = traced.made("warp_difference", fast, SIZE).values()
    return found


def test_the_graph_computes_what_torch_does_on_pictures_it_was_not_traced_with(made, fast):
    """Whole grey levels: what differs at all is a pixel in thousands, by rounding."""
    graph = traced.module("warp_difference", fast, SIZE)
    session = onnxruntime.InferenceSession(made.content, providers=["CPUExecutionProvider"])
    for seed in (5, 6):
        given = traced.example("warp_difference", fast, SIZE, seed)
        difference, mask = session.run(None, {name: value.numpy() for name, value in given.items()})
        wanted, wanted_mask = (value.numpy() for value in graph(*given.values()))
        assert wanted_mask.any() and not wanted_mask.all()
        assert np.mean(difference != wanted) < 1e-3
        assert traced.overlap(mask, wanted_mask) > 0.999


def test_the_whole_step_computes_what_torch_does_on_pictures_it_was_not_traced_with(fast):
    settings = with_parameters(fast, LEAST)
    (made,) = traced.made("step", settings, STEP_SIZE).values()
    assert all(check.passed for check in made.checks)
    graph = traced.module("step", settings, STEP_SIZE)
    session = onnxruntime.InferenceSession(made.content, providers=["CPUExecutionProvider"])
    for seed in (1, 2):
        given = traced.example("step", settings, STEP_SIZE, seed)
        for tolerance_px in (2.0, 0.5):
            given["tolerance_px"] = torch.tensor(tolerance_px, dtype=torch.float64)
            matrix, inliers, tracked, _, mask = session.run(None, {name: v.numpy() for name, v in given.items()})
            with torch.inference_mode():
                wanted = [value.numpy() for value in graph(*given.values())]
            assert traced.corner_error(matrix, wanted[0], mask.shape) < 0.1
            np.testing.assert_array_equal(tracked, wanted[2])
            assert np.abs(inliers - wanted[1]).max() <= 1 and (inliers > 8).all()
            assert traced.overlap(mask, wanted[4]) > 0.98 and mask.any() and not mask.all()


def test_the_same_graph_is_the_same_bytes(made, fast):
    (again,) = traced.made("warp_difference", fast, SIZE).values()
    assert again.content == made.content


def test_the_threshold_is_an_input(made, fast):
    session = onnxruntime.InferenceSession(made.content, providers=["CPUExecutionProvider"])
    given = {n: v.numpy() for n, v in traced.example("warp_difference", fast, SIZE, 0).items()}
    areas = [
        np.count_nonzero(session.run(["mask"], {**given, "threshold": np.array(level, np.uint8)})[0])
        for level in (10, 40, 254)
    ]
    assert areas[0] > areas[1] > areas[2] == 0


def test_only_standard_operations_are_used_and_inputs_have_names_of_our_own(made):
    model = onnx.load_from_string(made.content)
    assert [(held.domain, held.version) for held in model.opset_import] == [("", OPSET)]
    assert {node.domain for node in model.graph.node} == {""} and not model.functions
    assert tuple(value.name for value in model.graph.input) == traced.INPUTS["warp_difference"]
    assert tuple(value.name for value in model.graph.output) == traced.OUTPUTS["warp_difference"]


def test_nothing_of_the_machine_is_in_the_file(made):
    for trace in (b".py", b"File ", str(Path.cwd()).encode(), torch.__version__.encode()):
        assert trace not in made.content


def test_a_graph_that_computes_something_else_does_not_pass(made, fast):
    assert all(check.passed for check in made.checks)
    other = traced.module("warp_difference", with_parameters(fast, {"morphology.erode_px": 1}), SIZE)
    examples = [traced.example("warp_difference", fast, SIZE, 0)]
    assert not all(check.passed for check in traced.compared(made.content, other, "warp_difference", examples))


def test_settings_that_a_graph_cannot_hold_are_refused():
    with pytest.raises(
        InputError, match=r"difference.kind = to_reference .* got normalized with 2. Give --config fast"
    ):
        traced.module("step", Settings(), SIZE)


def test_a_picture_too_small_for_keypoints_is_refused(fast):
    with pytest.raises(InputError, match=r"room for 30 keypoints at 96x80; wanted 48"):
        traced.module("step", fast, SIZE)


@pytest.mark.parametrize("model", ["homography", "affine"])
def test_the_step_finds_the_motion_of_the_background_and_what_moves_on_it(fast, model):
    """As torch runs it, before it is traced."""
    settings, size = with_parameters(fast, {"registration.model": model}), (320, 240)
    given = traced.example("step", settings, size, 0)
    known = traced.example("warp_difference", settings, size, 0)["neighbour_from_reference"].numpy()
    with torch.inference_mode():
        matrix, inliers, tracked, difference, mask = traced.module("step", settings, size)(*given.values())
    assert traced.corner_error(matrix.numpy(), known, (240, 320)) < (0.25 if model == "homography" else 1.0)
    assert (inliers > 0.8 * tracked).all() and difference.shape == mask.shape == (240, 320)
    assert mask[114:126, 128 + 4 : 148 - 4].any() or mask[72:92, 96:116].any()
    assert (mask > 0).float().mean() < 0.03


def test_where_nothing_agrees_the_motion_is_the_identity_with_no_inliers(fast):
    size = (160, 120)
    given = traced.example("step", fast, size, 0)
    given["neighbours"] = torch.randint(
        0, 256, (2, 120, 160), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)
    )
    given["reference"] = torch.full((120, 160), 90, dtype=torch.uint8)
    with torch.inference_mode():
        matrix, inliers, *_ = traced.module("step", fast, size)(*given.values())
    np.testing.assert_array_equal(matrix.numpy(), np.tile(np.eye(3), (2, 1, 1)))
    assert not inliers.any()


def test_masks_and_matrices_are_compared_as_said():
    one, other = np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.uint8)
    assert traced.overlap(one, other) == 1.0
    one[:2], other[1:3] = 255, 255
    assert traced.overlap(one, other) == pytest.approx(1 / 3)
    moved = np.eye(3)[None].copy()
    moved[0, :2, 2] = 3, 4
    assert traced.corner_error(moved, np.eye(3)[None], (10, 20)) == pytest.approx(5)
