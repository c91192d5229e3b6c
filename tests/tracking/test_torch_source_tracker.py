"""The source's association with affinities from torch's batches: the same as one window at a time in NumPy."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.tracking import Tracker
from torchvision_dddas.tracking import torch_source_tracker as batched
from torchvision_dddas.tracking.source_tracker import Features, PicturedBoxes, affinity
from torchvision_dddas.tracking.torch_source_tracker import FRAMES, TorchSourceTracker

SIZE = (160, 120)
SOURCE = with_parameters(Settings(), {"track.mode": "paper"})


def walk(frames: int, grey: bool = False, seed: int = 0) -> list[tuple[np.ndarray | None, np.ndarray]]:
    """Pictures and shuffled boxes of up to 5 targets of a colour each, close to each other; some frames lack either."""
    random = np.random.default_rng(seed)
    start, step = random.uniform(20, 70, (5, 2)), random.normal(0, 2, (5, 2))
    colours, found = random.integers(0, 256, (5, 3)).tolist(), []
    for number in range(frames):
        image = random.integers(90, 110, (SIZE[1], SIZE[0], 3), np.uint8)
        there = random.permutation(5)[: 0 if number == 7 else random.integers(1, 6)]
        boxes = np.concatenate([start + step * number, np.tile((14.6, 22.3), (5, 1))], axis=1)[there]
        for (x, y, w, h), k in zip(boxes.round().astype(int).tolist(), there.tolist(), strict=True):
            cv2.rectangle(image, (x, y), (x + w, y + h), colours[k], -1)
        shown = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if grey else image
        found.append((None if number == 9 else shown, boxes))
    return found


def identities(backend: str, settings: Settings, clip: list[tuple[np.ndarray | None, np.ndarray]]) -> list[list[int]]:
    tracker = Tracker(settings, size=SIZE, backend=backend)
    settled = [tracks for image, boxes in clip for tracks in tracker.update(boxes, image=image)] + tracker.flush()
    assert [tracks.frame for tracks in settled] == list(range(1, len(clip) + 1))
    return [tracks.identity.tolist() for tracks in settled]


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"window": 2},
        {"rule": "fixed", "weight": 0.3, "dummy": "formula"},
        {"dummy": "real_pair", "histogram_scale": 1.0, "appearance_cut": 0.25},
        {"rule": "fixed", "weight": 0.0, "window": 2, "histogram": "count"},
        {"lowest_dispersion": 1.0, "histogram": "count", "dispersion_of": "newest"},
    ],
)
@pytest.mark.parametrize("grey", [False, True])
def test_identities_are_those_of_one_window_at_a_time(values, grey):
    settings = with_parameters(SOURCE, {f"paper.{name}": value for name, value in values.items()})
    clip = walk(2 * FRAMES + 3, grey)
    assert identities("torch", settings, clip) == identities("onboard", settings, clip)


@pytest.mark.parametrize("values", [{}, {"dummy": "formula"}, {"window": 2}])
def test_affinities_of_a_batch_are_numpys_to_the_last_digit(values):
    settings = with_parameters(SOURCE, {f"paper.{name}": value for name, value in values.items()} | {
        "paper.rule": "fixed", "paper.weight": 0.5
    })  # fmt: skip
    tracker, frames = TorchSourceTracker(settings, 1), walk(9)
    pictured = [PicturedBoxes(image, boxes) for image, boxes in frames if image is not None]
    count = settings.paper.window
    places = [range(k, k + count) for k in range(len(pictured) - count + 1)]
    targets = [Features(each.box_px, each) for each in pictured]
    found = tracker._affinities([[targets[k] for k in window] for window in places])
    for window, by_feature in zip(places, found, strict=True):
        alone = [Features(pictured[k].box_px, pictured[k]) for k in window]
        for feature, table in by_feature.items():
            wanted = affinity([frame.values(feature, "channel") for frame in alone], settings.paper)
            np.testing.assert_allclose(table, wanted, atol=1e-15)
    assert all(set(by_feature) == {"location", "appearance"} for by_feature in found)


def test_a_batch_is_settled_earlier_where_its_windows_are_large_and_pictures_go_in_parts(monkeypatch):
    clip = walk(12)
    wanted = identities("onboard", SOURCE, clip)
    monkeypatch.setattr(batched, "_AFFINITIES", 100)
    monkeypatch.setattr(batched, "_PIXELS", 1)
    monkeypatch.setattr("torchvision_dddas.nn.histogram_affinity._PIXELS", 1)
    monkeypatch.setattr("torchvision_dddas.nn.histogram_affinity._AFFINITIES", 1)
    tracker = Tracker(SOURCE, size=SIZE, backend="torch")
    settled = [len(tracker.update(boxes, image=image)) for image, boxes in clip]
    assert sum(settled) > 0 and max(settled) < FRAMES
    assert identities("torch", SOURCE, clip) == wanted


def test_a_back_end_of_another_name_is_refused():
    with pytest.raises(InputError, match="no backend is named 'gpu'"):
        Tracker(SOURCE, backend="gpu")
