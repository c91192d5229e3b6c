"""The camera's focal length, height and pitch from people of known height."""

from dataclasses import replace

import numpy as np
import pytest

from tests.upright import boxes, camera
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.camera_calibration import calibrate_focal_length, calibrate_pose


def crowd(cam, rng, n=300, noise=0.03, scatter=0.08):
    people = np.stack([rng.uniform(-4, 4, n), rng.uniform(8, 30, n)], axis=1)
    box = np.concatenate(
        [boxes(person[None], tall, cam) for person, tall in zip(people, rng.normal(1.75, scatter, n), strict=True)]
    )
    grown = box[:, 3] * rng.normal(1, noise, n)
    box[:, 1] += box[:, 3] - grown
    box[:, 3] = grown
    return box


def test_exact_people_tell_it_exactly():
    box = crowd(camera(height_m=3.0, pitch_rad=0.1), np.random.default_rng(0), n=40, noise=0, scatter=0)
    found = calibrate_pose(box, camera(), 1.75, 0.05)
    assert found.height_m == pytest.approx(3.0, abs=1e-4)
    assert found.pitch_rad == pytest.approx(0.1, abs=1e-5)


def test_people_in_one_row_do_not_tell():
    rng = np.random.default_rng(0)
    box = np.stack([rng.uniform(0, 1000, 100), np.zeros(100), np.full(100, 40.0), rng.normal(100, 8, 100)], axis=1)
    box[:, 1] = rng.normal(500, 3, 100) - box[:, 3]
    with pytest.raises(InputError, match="which does not tell how the camera stands"):
        calibrate_pose(box, camera(), 1.75, 0.05)


def test_boxes_where_the_lens_shows_nothing_are_left_out_and_said():
    box = crowd(camera(height_m=3.0, pitch_rad=0.1), np.random.default_rng(0), n=40)
    with pytest.raises(InputError, match="where the lens shows nothing: check k1 and k2"):
        calibrate_pose(box, replace(camera(), k1=-10.0), 1.75, 0.05)


def test_an_outlier_is_said_and_not_used():
    height = np.array([180.0, 181.0, 179.0, 120.0, 180.0])
    found = calibrate_focal_length(np.full(5, 10.0), height, 1.8)
    assert found.outlier.tolist() == [False, False, False, True, False]
    assert found.focal_px == pytest.approx(1000)
    assert found.spread_px == pytest.approx(1000 * np.std([180, 181, 179, 180], ddof=1) / 180)


@pytest.mark.parametrize(
    ("distance", "height", "body", "words"),
    [
        ([], [], 1.8, "no measurement to calibrate by"),
        ([0.0], [100.0], 1.8, "a distance of 0 will not do"),
        ([5.0], [np.nan], 1.8, "a height in pixels of nan will not do"),
        ([5.0], [100.0], -1.8, r"a body height of -1\.8 will not do"),
    ],
)
def test_what_cannot_calibrate_is_named(distance, height, body, words):
    with pytest.raises(InputError, match=words):
        calibrate_focal_length(np.array(distance), np.array(height), body)
