"""One contract for every operation of the detection chain: OpenCV, torch in batches and both widths, ONNX Runtime."""

from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from tests.functional.conftest import draw_texture
from torchvision_dddas.chain import OpenCVOperations, Operations, View
from torchvision_dddas.functional import TensorOperations

HEIGHT, WIDTH, BATCH = 61, 87, 3
MOTION = np.array([[1.01, 0.02, -4.3], [-0.015, 0.99, 3.2], [2e-5, -3e-5, 1]])


class Given(NamedTuple):
    """What the operations are given: frames, and maps in bytes. Arrays of one picture, or a batch of tensors."""

    reference: Any
    view: Any
    motion: Any
    one: Any
    other: Any
    mask: Any
    weight: Any


class Case(NamedTuple):
    """An operation, and how far the results may be apart: most levels, and the share of pixels that differ at all."""

    call: Callable[[Any, Given], Any]
    levels: int = 0
    share: float = 0.0
    has_gradient: bool = False
    exports: bool = True


CASES = {
    "grey": Case(lambda on, g: on.grey(g.view)),
    "texture": Case(lambda on, g: on.texture(g.view)),
    "no_texture": Case(lambda on, g: on.no_texture(g.view), exports=False),
    "warp": Case(lambda on, g: on.warp(g.view, g.reference, g.motion), 1, 0.04),
    "seen_by_both": Case(
        lambda on, g: on.inside(
            g.one,
            on.seen_by_both(
                on.seen(g.view, g.reference, g.motion, 4), on.seen(g.view, g.reference, g.motion, 0), g.reference
            ),
        ),
        255,
        0.02,
    ),
    "fit_light": Case(
        lambda on, g: on.apply_light(
            g.reference, g.one, on.fit_light(g.reference, g.one, on.seen(g.view, g.reference, g.motion, 2))
        ),
        2,
        0.5,
        exports=False,
    ),
    "fit_level_shares": Case(
        lambda on, g: on.apply_light(g.reference, g.one, on.fit_level_shares(g.reference, g.view)), 1, 0.05
    ),
    "apply_light": Case(
        lambda on, g: on.apply_light(g.reference, g.one, (g.motion[..., 0, 0] * 0 + 0.8, g.motion[..., 0, 0] * 0 + 3))
    ),
    "difference": Case(lambda on, g: on.difference(g.one, g.other)),
    "smaller": Case(lambda on, g: on.smaller(g.one, g.other)),
    "larger": Case(lambda on, g: on.larger(g.one, g.other)),
    "inside": Case(lambda on, g: on.inside(g.one, on.exceeds(g.other, 100))),
    "outside": Case(lambda on, g: on.outside(g.one, on.exceeds(g.other, 100))),
    "exceeds": Case(lambda on, g: on.inside(g.one, on.exceeds(g.one, 130.7))),
    "stands_out": Case(lambda on, g: on.stands_out(g.one, 20, 1.3)),
    "weigh": Case(lambda on, g: on.weigh(g.one, g.weight, 200), 1, 0.01),
    "noise_weight": Case(
        lambda on, g: on.weigh(g.one, on.noise_weight(on.texture(g.view), 4.0, 0.15, 16.0), 239), 1, 0.01
    ),
    "blur": Case(lambda on, g: on.blur(g.one, 5), 2, 0.6, has_gradient=True),
    "blur of 1": Case(lambda on, g: on.blur(g.one, 1)),
    "in_units_of_median": Case(
        lambda on, g: on.in_units_of_median(g.one, on.exceeds(g.other, 90), 16.0), 1, 0.02, exports=False
    ),
    "above": Case(lambda on, g: on.above(g.one, 120.0), has_gradient=True),
    "erode": Case(lambda on, g: on.erode(g.mask, 3), has_gradient=True),
    "dilate": Case(lambda on, g: on.dilate(g.mask, 9), has_gradient=True),
    "close": Case(lambda on, g: on.close(g.mask, 15), has_gradient=True),
    "close by 1": Case(lambda on, g: on.close(g.mask, 1)),
    "halve": Case(lambda on, g: on.halve(g.one)),
}
each_case = pytest.mark.parametrize("name", CASES)


def picture(seed: int) -> np.ndarray:
    return draw_texture(seed, HEIGHT, WIDTH)


def array_given(number: int) -> Given:
    grey, other = picture(number), picture(number + 10)
    darker = cv2.convertScaleAbs(grey, alpha=0.8, beta=5)
    mask = (cv2.threshold(picture(number + 20), 170, 255, cv2.THRESH_BINARY)[1]).astype(np.uint8)
    weight = (other / 128).astype(np.float32)
    return Given(View(grey, grey), View(darker, darker), MOTION, darker, other, mask, weight)


def tensor_given(numbers: list[int], dtype: Any = torch.float32, strided: bool = False) -> Given:
    """A batch. strided: tensors whose rows and pictures do not follow each other in memory."""
    parts = [array_given(number) for number in numbers]

    def stack(pictures: list[np.ndarray]) -> Any:
        batch = torch.from_numpy(np.stack(pictures))[:, None]
        return torch.cat([batch, batch], -1).repeat(1, 2, 1, 1)[:, 1:, :, WIDTH:] if strided else batch

    frames = [stack([view.grey for view in views]).to(dtype) for views in zip(*(p[:2] for p in parts), strict=True)]
    maps = [stack(list(of)) for of in zip(*(p[3:6] for p in parts), strict=True)]
    motion = torch.from_numpy(np.stack([part.motion for part in parts]))
    (reference, view), (one, other, mask) = frames, maps
    return Given(reference, view, motion, one, other, mask, stack([part.weight for part in parts]).to(dtype))


def as_bytes(found: Any) -> np.ndarray:
    array = found.numpy() if isinstance(found, torch.Tensor) else np.asarray(found)
    return array.astype(int)


def test_every_operation_has_a_case() -> None:
    named = {name for name, member in vars(Operations).items() if callable(member) and not name.startswith("_")}
    used = {word for case in CASES.values() for word in case.call.__code__.co_names}
    assert named - used == set()


@each_case
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("strided", [False, True], ids=["contiguous", "strided"])
def test_a_batch_of_tensors_gives_what_opencv_gives_picture_by_picture(name, dtype, strided) -> None:
    case, numbers = CASES[name], list(range(BATCH))
    found = as_bytes(case.call(TensorOperations(dtype=dtype), tensor_given(numbers, dtype, strided)))
    for number in numbers:
        wanted = as_bytes(case.call(OpenCVOperations(), array_given(number)))
        apart = np.abs(found[number, 0] - wanted)
        assert apart.max() <= case.levels and (apart > 0).mean() <= case.share, (apart.max(), (apart > 0).mean())
    assert found.any() or name == "no_texture"


@each_case
def test_a_batch_is_its_members_one_by_one(name) -> None:
    together = as_bytes(CASES[name].call(TensorOperations(), tensor_given([0, 1, 2])))
    for number in range(BATCH):
        alone = as_bytes(CASES[name].call(TensorOperations(), tensor_given([number])))
        np.testing.assert_array_less(np.abs(alone - together[number : number + 1]), 2)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.exports])
def test_the_exported_graph_gives_what_torch_gives(name) -> None:
    pytest.importorskip("onnx")
    from torchvision_dddas.lab.export.graph_files import open_session, trace_graph

    class Module(torch.nn.Module):
        def forward(self, *given: Any) -> Any:
            return CASES[name].call(TensorOperations(), Given(*given))

    inputs, others = (dict(zip(Given._fields, tensor_given(numbers), strict=True)) for numbers in ([0, 1], [5, 6]))
    session = open_session(trace_graph(Module().eval(), "operation", inputs, ("found",)))
    used = {node.name for node in session.get_inputs()}
    (found,) = session.run(None, {key: value.numpy() for key, value in others.items() if key in used})
    wanted = as_bytes(Module()(*others.values()))
    apart = np.abs(as_bytes(found) - wanted)
    assert (apart > 1).mean() < 0.003


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.has_gradient])
def test_soft_forms_have_gradients_and_the_hard_values(name) -> None:
    given = tensor_given([0, 1])
    one, mask = (levels.double().requires_grad_() for levels in (given.one, given.mask))
    soft = CASES[name].call(TensorOperations(0.1, dtype=torch.float64), given._replace(one=one, mask=mask))
    hard = CASES[name].call(TensorOperations(), given)
    values = (soft > 0) * 255 if name == "above" else soft.detach()
    np.testing.assert_array_equal(as_bytes(values), as_bytes(hard))
    (slope,) = torch.autograd.grad(soft.sum(), mask if name in ("erode", "dilate", "close") else one)
    assert slope.isfinite().all() and slope.any()
