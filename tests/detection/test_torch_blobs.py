"""Blobs found by torch on the engine's device are OpenCV's."""

import cv2
import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from tests.synthetic_clip import render
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.detection import MotionDetector, View, Window
from torchvision_dddas.detection.blobs import Blob, find_blobs
from torchvision_dddas.detection.torch_blobs import foregrounds_with_blobs, label_components
from torchvision_dddas.detection.torch_engine import TorchEngine

SHAPE = (67, 101)
KNOBS: dict[str, float] = {"difference.threshold": 6.0, "difference.peak": 9.0, "gates.min_area_px": 12}


def smooth(seed: int, sigma: float) -> np.ndarray:
    """Speckles or islands with holes, 0 to 255."""
    noise = np.random.default_rng(seed).normal(0, 1, SHAPE)
    if sigma:
        cv2.GaussianBlur(noise, (0, 0), sigma, dst=noise)
    return np.clip(128 + 60 * noise / noise.std(), 0, 255).astype(np.uint8)


def nested() -> np.ndarray:
    """Rings in rings, diagonals, single pixels, and regions at the border."""
    core = np.zeros(SHAPE, np.uint8)
    for inset in (0, 3, 7, 12):
        cv2.rectangle(core, (20 + inset, 10 + inset), (70 - inset, 55 - inset), 255, 1)
    np.fill_diagonal(core[2:30, 72:100], 255)
    core[[0, 0, -1, -1], [0, -1, 0, -1]] = core[40:42, 0] = 255
    return core


MASKS = [(np.zeros(SHAPE, np.uint8), smooth(0, 0)), (nested(), smooth(1, 0)), (nested() | 255, smooth(2, 1))]
MASKS += [
    ((evidence > level).astype(np.uint8) * 255, evidence)
    for evidence, level in ((smooth(3, 0), 128), (smooth(4, 1), 150), (smooth(5, 2), 120), (smooth(6, 4), 140))
]


def window(settings: Settings) -> Window:
    picture = np.zeros(SHAPE, np.uint8)
    view = View(picture, picture)
    return Window(view, (view, view), np.stack([np.eye(3)] * 2), (-1, 1), ((0, 1),), (0, 1), settings=settings)


def assert_same(found: list[Blob], wanted: list[Blob]) -> None:
    assert [(blob.box, blob.peak, blob.area_px) for blob in found] == [
        (blob.box, blob.peak, blob.area_px) for blob in wanted
    ]
    for blob, other in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(blob.mask, other.mask)
        np.testing.assert_array_equal(blob.core, other.core)


def batch(pictures: list[np.ndarray]) -> torch.Tensor:
    return torch.from_numpy(np.stack(pictures))[:, None]


def test_areas_boxes_and_peaks_are_opencvs() -> None:
    """All pictures in one batch; regions of a picture in OpenCV's order."""
    cores, evidence = (list(column) for column in zip(*MASKS, strict=True))
    found = label_components(batch(cores) > 0, batch(evidence))
    for number, (core, seen) in enumerate(MASKS):
        count, labels, stats, _ = cv2.connectedComponentsWithStats(core)
        mine = found.picture == number
        wanted = sorted((*row, seen[labels == label].max()) for label, row in enumerate(stats[1:].tolist(), 1))
        table = np.c_[found.box, found.area_px, found.peak][mine]
        assert sorted(map(tuple, table.tolist())) == wanted and len(wanted) == count - 1


@pytest.mark.parametrize("hull", [False, True])
def test_blobs_are_opencvs_each_frame_by_its_own_gates(hull) -> None:
    settings = with_parameters(Settings(), KNOBS | {"morphology.hull": hull})
    freer = with_parameters(settings, {"gates.min_area_px": 1, "difference.peak": 1.0})
    given = [settings if number % 2 else freer for number in range(len(MASKS))]
    cores, near = (list(column) for column in zip(*MASKS, strict=True))
    islands = [smooth(10 + number, 2) for number in range(len(MASKS))]
    wide = [np.where(picture > 185, picture, 0).astype(np.uint8) for picture in islands]
    maps = batch(cores), batch(near), batch(wide), batch(near)
    windows = [window(one) for one in given]
    found = foregrounds_with_blobs(windows, settings, maps, None, (maps[1], maps[2]))
    assert any(frame.blobs for frame in found)
    for frame, own, core, evidence, far in zip(found, given, cores, near, wide, strict=True):
        limits = 16 * own.difference.threshold, own.gates.min_area_px, 16 * own.difference.peak
        wanted = find_blobs(core, evidence, *limits, hull)
        assert frame.blobs is not None
        assert_same(frame.blobs, wanted)
        for x, y, width, height in (blob.box for blob in frame.blobs):
            part = np.s_[y : y + height, x : x + width]
            np.testing.assert_array_equal(frame.evidence[part], evidence[part])
            np.testing.assert_array_equal(frame.wide[part], far[part])
        if frame.blobs:
            np.testing.assert_array_equal(frame.warped[1], far)


@pytest.mark.parametrize(
    "changes",
    [{}, {"refine.on": False, "history.on": True}],
    ids=["default", "history"],
)
def test_a_clip_has_the_same_scenes_whoever_finds_the_blobs(changes) -> None:
    settings = with_parameters(Settings(), {"gates.min_area_px": 20, "tracklets.on": False, **changes})
    images, scenes = render(1, 9, (160, 120)).images, []
    for components in ("opencv", "torch"):
        detector = MotionDetector(settings, backend=TorchEngine(settings, "cpu", components))
        scenes.append([scene for image in images for scene in detector.update(image)] + detector.flush())
    assert any(len(scene.detections) for scene in scenes[0])
    for one, other in zip(*scenes, strict=True):
        np.testing.assert_array_equal(one.mask, other.mask)
        np.testing.assert_array_equal(one.core, other.core)
        np.testing.assert_array_equal(one.detections.box_px, other.detections.box_px)
        np.testing.assert_array_equal(one.detections.score, other.detections.score)
        np.testing.assert_array_equal(one.detections.speed_px, other.detections.speed_px)


@pytest.mark.gpu
def test_on_a_gpu_blobs_are_those_of_the_cpu() -> None:
    cores, near = (batch(list(column)) for column in zip(*MASKS, strict=True))
    wanted, found = label_components(cores > 0, near), label_components(cores.cuda() > 0, near.cuda())
    for name in ("picture", "box", "area_px", "peak"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
