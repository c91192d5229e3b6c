"""Levels, windows and parts of the pyramid."""

from itertools import pairwise

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import PeopleParameters, load_config
from torchvision_dddas.errors import InputError
from torchvision_dddas.people import pyramid
from torchvision_dddas.people.suppression import body_boxes

SIZE = (180, 220)


def parameters(**changed) -> PeopleParameters:
    changed = {"enlarge": 1.0, "padding_px": 0, "threshold": 0.0} | changed
    return load_config(overrides=[f"people.{k}={v}" for k, v in changed.items()]).people


@pytest.mark.parametrize("changed", [{}, {"padding_px": 16}, {"window_stride_px": 4, "scale_step": 1.1}])
def test_levels_and_windows_are_those_of_opencv(changed):
    k, hog = parameters(suppression="opencv", threshold=-2.0, **changed), cv2.HOGDescriptor()
    hog.setSVMDetector(np.array(cv2.HOGDescriptor.getDefaultPeopleDetector()))
    noise = cv2.GaussianBlur(np.random.default_rng(3).normal(size=(SIZE[1], SIZE[0], 3)), (0, 0), 4)
    picture = np.clip(128 + 400 * noise, 0, 255).astype(np.uint8)  # its windows score around -2
    stride, pad = (k.window_stride_px,) * 2, (k.padding_px,) * 2
    parts, maps = pyramid.everywhere(SIZE, k), []
    for part in parts:
        level = cv2.resize(picture, part.level, interpolation=cv2.INTER_LINEAR_EXACT)
        place, score = map(np.asarray, hog.detect(level, -1e9, stride, pad))
        maps.append(np.full(((part.height - 128) // stride[0] + 1, (part.width - 64) // stride[0] + 1), np.nan))
        maps[-1][tuple((place[:, ::-1] + pad).T // stride[0])] = np.ravel(score)
    box, margin = pyramid.windows(parts, [m.astype(np.float32) for m in maps], SIZE, k)
    theirs, weight = hog.detectMultiScale(picture, -2.0, stride, pad, k.scale_step, 0)
    # Padded windows may lie outside; detectMultiScale clips what it returns.
    low = np.maximum(box[:, :2], 0)
    clipped = np.concatenate([low, np.minimum(box[:, :2] + box[:, 2:], SIZE) - low], axis=1)
    ours = sorted((*row, round(m, 4)) for row, m in zip(clipped.astype(int).tolist(), margin.tolist(), strict=True))
    wanted = sorted(
        (*row, round(w, 4)) for row, w in zip(np.asarray(theirs).tolist(), np.ravel(weight).tolist(), strict=True)
    )
    assert len(ours) > 20
    assert ours == wanted


def test_enlarged_pyramids_begin_with_a_larger_picture_and_end_at_the_window():
    found = pyramid.levels(SIZE, parameters(enlarge=2.0))
    assert found[0].scale == pytest.approx(1.05**-14) and 1.05**14 <= 2 < 1.05**15
    assert all(a.scale * 1.05 == pytest.approx(b.scale) for a, b in pairwise(found))
    last = found[-1].size
    assert last[0] >= 64 and last[1] >= 128
    assert min(last[0] / 64, last[1] / 128) < 1.05


def test_a_picture_smaller_than_the_window_is_refused_with_both_sizes():
    with pytest.raises(InputError, match=r"60 x 200 px, enlarged 1 times, is smaller than the window of 64 x 128 px"):
        pyramid.levels((60, 200), parameters())


def positions(parts, k):
    """Level, x and y of every window of parts, as often as they hold it."""
    stride = k.window_stride_px
    return [
        (part.level, part.x + i * stride, part.y + j * stride)
        for part in parts
        for j in range((part.height - k.window_height_px) // stride + 1)
        for i in range((part.width - k.window_width_px) // stride + 1)
    ]


REGIONS = np.array([[30.0, 20, 90, 150], [90, 60, 80, 130], [100, 70, 60, 110]])
HEIGHTS = np.array([[80.0, 100], [100, 130], [np.nan, np.nan]])


@pytest.mark.parametrize("changed", [{}, {"padding_px": 20, "enlarge": 1.4, "window_stride_px": 4}])
def test_parts_hold_every_window_whose_body_lies_in_its_region(changed):
    k = parameters(**changed)
    everywhere = positions(pyramid.everywhere(SIZE, k), k)
    within = set(positions(pyramid.within(REGIONS, HEIGHTS, SIZE, k), k))
    assert within < set(everywhere)
    scale = {level.size: level.scale for level in pyramid.levels(SIZE, k)}
    window = np.array([(x, y, 64, 128) for _, x, y in everywhere]) * [[scale[size]] for size, _, _ in everywhere]
    bodies, wanted = body_boxes(window, k), set()
    low, high = bodies[:, :2], bodies[:, :2] + bodies[:, 2:]
    for region, (least, largest) in zip(REGIONS, HEIGHTS, strict=True):
        inside = (low >= region[:2]).all(axis=1) & (high <= region[:2] + region[2:]).all(axis=1)
        fits = np.isnan(least) | ((bodies[:, 3] >= least) & (bodies[:, 3] <= largest))
        wanted |= {everywhere[i] for i in np.flatnonzero(inside & fits)}
    assert len(wanted) > 20 and wanted <= within
    assert len(within) < 0.5 * len(everywhere)


@pytest.mark.parametrize(
    ("region", "heights"), [([10, 10, 90, 150], [20, 40]), ([500, 500, 90, 150], [np.nan] * 2), ([], [])]
)
def test_bodies_too_small_for_the_pyramid_and_regions_off_the_picture_have_no_parts(region, heights):
    region, heights = np.reshape(region, (-1, 4)).astype(float), np.reshape(heights, (-1, 2)).astype(float)
    assert pyramid.within(region, heights, SIZE, parameters()) == []
