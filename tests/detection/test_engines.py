"""Both engines agree; batches equal single pairs and windows."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

import torchvision_dddas.functional as F
from tests.synthetic_clip import RATE_HZ, flight, render
from torchvision_dddas import config as parameters
from torchvision_dddas import runtime
from torchvision_dddas.detection import Engine, View, Window, load_engine
from torchvision_dddas.detection.observation import observe
from torchvision_dddas.detection.person_scale import TINY
from torchvision_dddas.detection.torch_engine import TorchEngine
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import chain, corner_error

SIZES = [(320, 240), (251, 187)]
FRAMES = 7
GAIN = [1.0, 1.0, 1.15, 1.0, 0.85, 1.0, 1.0]
CONFIGS = [[], ["difference.kind=to_reference", "difference.blur_px=7", "difference.threshold=20.0"]]
CONFIGS += [["difference.kind=between_later", "difference.threshold=20.0", "registration.model=affine"]]
CONFIGS += [["difference.kind=between_later", "difference.threshold=20.0", "difference.blur_of=silhouette"]]
CONFIGS[-1] += ["morphology.dilate_px=9", "morphology.close_px=1", "registration.corners=frame"]
IDS = ["normalized", "to_reference", "between_later-affine", "source"]


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Two threads that wait for each other on a busy machine turn seconds into minutes."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(params=CONFIGS, ids=IDS)
def engines(request) -> tuple[Engine, Engine]:
    settings = parameters.load_config(None, request.param)
    # Whole maps are compared, also where there is a GPU.
    return load_engine("onboard", settings), TorchEngine(settings, components="opencv")


def window(views: Sequence[View], steps: list[np.ndarray], at: int, pairs: list[tuple[int, int]], far: bool) -> Window:
    """The window at frame `at` whose pairs are given as frames; with `far`, the last pair is the wide and small one."""
    used = sorted({frame for pair in pairs for frame in pair})
    matrices = []
    for other in used:
        forward = chain(steps[min(at, other) : max(at, other)])
        matrices.append(forward if other > at else np.linalg.inv(forward))
    places = tuple((used.index(a), used.index(b)) for a, b in pairs)
    last = places[-1] if far else None
    neighbours = tuple(views[i] for i in used)
    near = places[:-1] if far else places
    return Window(views[at], neighbours, np.array(matrices), tuple(i - at for i in used), near, last, last)


# Of the clip's middle, start and end: the frame, its pairs, and whether the last pair is the wide and small one.
every_window = pytest.mark.parametrize(
    ("at", "pairs", "far"),
    [(3, [(2, 4), (1, 5), (0, 6)], True), (0, [(1, 2), (2, 4)], False), (6, [(5, 4), (4, 2), (3, 1)], True)],
)


def registered(engine: Engine, images: list[np.ndarray]) -> tuple[list[View], list[np.ndarray]]:
    """Views, and the reliable registrations of successive frames."""
    views = [engine.prepare(image) for image in images]
    steps = engine.register(list(pairwise(views)))
    assert all(step.reliable for step in steps), [step.cause for step in steps]
    return views, [step.later_from_earlier for step in steps]


@pytest.mark.parametrize("size", SIZES, ids=["even", "odd"])
def test_registrations_agree_to_half_a_pixel(engines, size) -> None:
    onboard, batched = (registered(engine, render(1, FRAMES, size).images)[1] for engine in engines)
    assert max(corner_error(a, b, size) for a, b in zip(onboard, batched, strict=True)) <= 0.5


@every_window
@pytest.mark.parametrize("size", SIZES, ids=["even", "odd"])
def test_foregrounds_agree_each_engine_on_its_own_registrations(engines, size, at, pairs, far) -> None:
    images = render(1, FRAMES, size).images
    onboard, batched = (
        engine.foreground([window(*registered(engine, images), at, pairs, far)])[0] for engine in engines
    )
    a, b = onboard.core > 0, batched.core > 0
    assert a.any() and (a & b).sum() / (a | b).sum() >= 0.95
    for name in ("evidence", "wide", "texture"):
        apart = np.abs(getattr(onboard, name).astype(int) - getattr(batched, name))
        assert getattr(batched, name).dtype == np.uint8
        assert np.percentile(apart, 99) <= 6, name
    assert batched.offsets == onboard.offsets
    for ours, theirs in zip(batched.warped, onboard.warped, strict=True):
        assert np.percentile(np.abs(ours.astype(int) - theirs), 99) <= 3


@every_window
@pytest.mark.parametrize("size", SIZES, ids=["even", "odd"])
def test_on_the_same_registrations_only_rounding_differs_even_where_the_gain_jumps(
    engines, size, at, pairs, far
) -> None:
    images = render(1, FRAMES, size, GAIN).images
    ground = [view.image_from_ground for view in flight(1, FRAMES, size, RATE_HZ)]
    steps = [later @ np.linalg.inv(earlier) for earlier, later in pairwise(ground)]
    onboard, batched = (
        engine.foreground([window([engine.prepare(image) for image in images], steps, at, pairs, far)])[0]
        for engine in engines
    )
    np.testing.assert_array_equal(batched.texture, onboard.texture)
    for name in ("evidence", "wide", "core", "small") if far else ("evidence", "wide", "core"):
        apart = np.abs(getattr(onboard, name).astype(int) - getattr(batched, name))
        assert (apart > 2).mean() < 0.002, name
    assert onboard.core.any() and batched.core.dtype == np.uint8
    assert batched.offsets == onboard.offsets
    for ours, theirs in zip(batched.warped, onboard.warped, strict=True):
        assert np.percentile(np.abs(ours.astype(int) - theirs), 99) <= 3


@pytest.mark.parametrize(("shape", "contrast"), [((96, 128), 0), ((9, 11), 0), ((1, 1), 0), ((9, 200), 160)])
def test_both_engines_flag_blank_and_tiny_frames(engines, shape, contrast) -> None:
    causes, random = set(), np.random.default_rng(0)
    for engine in engines:
        pictures = 90 + random.integers(0, contrast + 1, (3, *shape, 3))
        views = [engine.prepare(picture.astype(np.uint8)) for picture in pictures]
        steps = engine.register(list(pairwise(views)))
        assert not any(step.reliable for step in steps)
        # Of noise the corners of a whole frame are a few more or fewer.
        is_counted = engine.parameters.registration.corners == "cells"
        causes |= {step.cause if is_counted else re.sub(r"only \d+", "only some", step.cause) for step in steps}
        found = engine.foreground([window(views, [np.eye(3)] * 2, 1, [(0, 2)], False)])[0]
        assert found.core.shape == shape and (contrast or not found.core.any())
    assert len(causes) == 1 and "keypoints" in causes.pop()


def test_a_batch_of_pairs_or_windows_equals_one_at_a_time() -> None:
    engine = TorchEngine(parameters.load_config(), device="cpu")
    images = render(2, 6, (256, 192)).images
    views = [engine.prepare(image) for image in images]
    for pair, whole in zip(pairwise(images), engine.register(list(pairwise(views))), strict=True):
        (alone,) = engine.register([(engine.prepare(pair[0]), engine.prepare(pair[1]))])
        np.testing.assert_allclose(whole.later_from_earlier, alone.later_from_earlier, rtol=0, atol=1e-6)
        assert (whole.tracked, whole.inliers) == (alone.tracked, alone.inliers)
    still = [np.eye(3)] * 5
    odd = Window(views[0], tuple(views[1:4]), np.stack(still[:3]), (1, 2, 3), ((0, 1),), (1, 2), (0, 2))
    asked = [window(views, still, at, [(at - 1, at + 1)], False) for at in (1, 2, 4)]
    asked.insert(1, odd)
    for found, one in zip(engine.foreground(asked), asked, strict=True):
        (single,) = engine.foreground([one])
        for name in ("core", "evidence", "wide", "texture"):
            np.testing.assert_array_equal(getattr(found, name), getattr(single, name))
        assert (found.small is None) == (single.small is None) == (one.small is None)
        assert found.offsets == single.offsets


@pytest.mark.parametrize("components", ["opencv", "torch"])
def test_a_window_is_searched_by_its_own_settings_beside_others_in_the_same_batch(components) -> None:
    usual = parameters.load_config(None, ["tracklets.on=false"])
    tiny = parameters.with_parameters(usual, TINY)
    engines = load_engine("onboard", usual), TorchEngine(usual, "cpu", components)
    images, found = render(1, FRAMES, (320, 240)).images, []
    for engine in engines:
        views, steps = registered(engine, images)
        of_each = ((2, usual), (3, tiny), (4, usual))
        windows = [replace(window(views, steps, at, [(at - 1, at + 1)], False), settings=own) for at, own in of_each]
        maps = zip(windows, engine.foreground(windows), of_each, strict=True)
        found.append([observe(window, shown, own).blobs for window, shown, (_, own) in maps])
        cores = [engine.foreground([replace(windows[1], settings=own)])[0].core > 0 for own in (usual, tiny)]
        if engine.name == "onboard":
            assert cores[1].sum() > 1.2 * cores[0].sum()
    for onboard, batched in zip(*found, strict=True):
        assert len(onboard) == len(batched) > 0
        for a, b in zip(onboard, batched, strict=True):
            assert a.box == pytest.approx(b.box, abs=2)


@pytest.mark.parametrize(("driver", "wanted"), [(True, "torch"), (False, "onboard")])
def test_auto_takes_torch_where_there_is_a_cuda_device_and_only_for_pictures(monkeypatch, driver, wanted) -> None:
    monkeypatch.setattr(runtime, "_has_cuda", lambda: driver)
    assert load_engine("auto", parameters.Settings()).name == wanted
    assert not runtime.wants_torch("auto", auto_with_gpu=False)
    for backend in ("onboard", "torch"):
        assert load_engine(backend, parameters.Settings()).name == backend
    with pytest.raises(InputError, match="no backend is named 'gpu'"):
        load_engine("gpu", parameters.Settings())


def test_a_device_without_float64_is_refused_and_auto_does_not_take_it(monkeypatch) -> None:
    with pytest.raises(InputError, match="needs float64, which mps does not support"):
        TorchEngine(parameters.Settings(), "mps")
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert runtime.torch_device() == "cpu"


@pytest.mark.gpu
@pytest.mark.skipif(not torch.backends.mps.is_available(), reason="needs MPS")
def test_on_mps_byte_operations_hold_but_homographies_raise() -> None:
    """What keeps MPS out: when this fails, it may be taken."""
    mask = torch.rand(2, 1, 40, 50, generator=torch.Generator().manual_seed(0)) > 0.6
    kernel = F.structuring_element("ellipse", 5)
    assert torch.equal(F.closing(mask.to("mps"), kernel).cpu(), F.closing(mask, kernel))
    with pytest.raises(TypeError):
        torch.zeros(1, device="mps").double()


def test_without_a_driver_torch_is_not_asked_for_its_devices(monkeypatch) -> None:
    def absent(name: str) -> None:
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr("ctypes.CDLL", absent)
    monkeypatch.setattr(runtime, "torch_device", lambda: pytest.fail("torch was loaded"))
    runtime._has_cuda.cache_clear()
    assert not runtime.wants_torch("auto")
    runtime._has_cuda.cache_clear()


@pytest.mark.parametrize("name", ["registration.halved", "difference.halved"])
def test_half_resolution_is_opencvs_alone(name, monkeypatch) -> None:
    settings = parameters.with_parameters(parameters.Settings(), {name: True})
    with pytest.raises(InputError, match=f"does not support {name}; set it false or use onboard"):
        load_engine("torch", settings)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert load_engine("auto", settings).name == "onboard"
