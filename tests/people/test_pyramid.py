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
    return load_config(
        overrides=[
            f"people.{k}={v}" for k, v in ({"enlarge": 1.0, "padding_px": 0, "threshold": 0.0} | changed).items()
        ]
    ).people


@pytest.fixture(scope="module")
def hog():
    detector = cv2.HOGDescriptor()
    detector.setSVMDetector(np.array(cv2.HOGDescriptor.getDefaultPeopleDetector()))
    return detector


@pytest.fixture(scope="module")
def picture():
    """Smooth noise: its windows score around -2."""
    rng = np.random.default_rng(3)
    noise = cv2.GaussianBlur(rng.normal(size=(SIZE[1], SIZE[0], 3)), (0, 0), 4)
    return np.clip(128 + 400 * noise, 0, 255).astype(np.uint8)


def maps_of(picture, parts, parameters, hog):
    """What a recognizer gives, by OpenCV, for whole levels."""
    stride, pad, maps = parameters.window_stride_px, parameters.padding_px, []
    for part in parts:
        level = cv2.resize(picture, part.level, interpolation=cv2.INTER_LINEAR_EXACT)
        place, score = hog.detect(level, -1e9, (stride, stride), (pad, pad))
        shape = (part.height - 128) // stride + 1, (part.width - 64) // stride + 1
        found = np.full(shape, np.nan, np.float32)
        found[(place[:, 1] + pad) // stride, (place[:, 0] + pad) // stride] = np.ravel(score)
        maps.append(found)
    return maps


@pytest.mark.parametrize("changed", [{}, {"padding_px": 16}, {"window_stride_px": 4, "scale_step": 1.1}])
def test_levels_and_windows_are_those_of_opencv(hog, picture, changed):
    k = parameters(suppression="opencv", threshold=-2.0, **changed)
    parts = pyramid.everywhere(SIZE, k)
    box, margin = pyramid.windows(parts, maps_of(picture, parts, k, hog), SIZE, k)
    stride, pad = k.window_stride_px, k.padding_px
    theirs, weight = hog.detectMultiScale(picture, -2.0, (stride, stride), (pad, pad), k.scale_step, 0)
    # Padded windows may lie outside; detectMultiScale clips what it returns.
    low = np.maximum(box[:, :2], 0)
    clipped = np.concatenate([low, np.minimum(box[:, :2] + box[:, 2:], SIZE) - low], axis=1)
    ours = sorted((*row, round(m, 4)) for row, m in zip(clipped.astype(int).tolist(), margin.tolist(), strict=True))
    wanted = sorted((*row, round(w, 4)) for row, w in zip(theirs.tolist(), np.ravel(weight).tolist(), strict=True))
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
def test_parts_hold_every_window_whose_body_lies_in_its_region_where_a_search_everywhere_has_it(changed):
    k = parameters(**changed)
    everywhere = positions(pyramid.everywhere(SIZE, k), k)
    within = set(positions(pyramid.within(REGIONS, HEIGHTS, SIZE, k), k))
    assert within < set(everywhere)
    scale = {level.size: level.scale for level in pyramid.levels(SIZE, k)}
    window = np.array([(x, y, 64, 128) for _, x, y in everywhere]) * [[scale[size]] for size, _, _ in everywhere]
    bodies, wanted = body_boxes(window, k), set()
    for region, (least, largest) in zip(REGIONS, HEIGHTS, strict=True):
        inside = (bodies[:, :2] >= region[:2]).all(1) & (bodies[:, :2] + bodies[:, 2:] <= region[:2] + region[2:]).all(
            1
        )
        fits = np.isnan(least) | ((bodies[:, 3] >= least) & (bodies[:, 3] <= largest))
        wanted |= {everywhere[i] for i in np.flatnonzero(inside & fits)}
    assert len(wanted) > 20
    assert wanted <= within
    assert len(within) < 0.5 * len(everywhere)


def test_no_part_is_made_for_bodies_that_the_pyramid_does_not_reach_or_regions_off_the_picture():
    k = parameters()
    assert pyramid.within(np.array([[10.0, 10, 90, 150]]), np.array([[20.0, 40]]), SIZE, k) == []
    assert pyramid.within(np.array([[500.0, 500, 90, 150]]), np.array([[np.nan, np.nan]]), SIZE, k) == []
    assert pyramid.within(np.zeros((0, 4)), np.zeros((0, 2)), SIZE, k) == []
