"""The camera's height and pitch from people all over its picture."""

from dataclasses import replace

import numpy as np
import pytest

from tests.upright import boxes, camera
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.camera_calibration import calibrate_pose, with_pose


def crowd(cam, rng, n=300, noise=0.03, scatter=0.08):
    people = np.stack([rng.uniform(-4, 4, n), rng.uniform(8, 30, n)], axis=1)
    box = np.concatenate(
        [boxes(person[None], tall, cam) for person, tall in zip(people, rng.normal(1.75, scatter, n), strict=True)]
    )
    grown = box[:, 3] * rng.normal(1, noise, n)
    box[:, 1] += box[:, 3] - grown
    box[:, 3] = grown
    return box


@pytest.mark.parametrize(("height", "pitch"), [(1.0, 0.0), (4.0, 0.15), (7.0, 0.3)])
def test_people_tell_how_the_camera_stands(height, pitch):
    box = crowd(camera(height_m=height, pitch_rad=pitch), np.random.default_rng(2))
    found = calibrate_pose(box, camera(height_m=np.nan), 1.75, 0.05)
    assert abs(found.height_m - height) < max(4 * found.height_sigma_m, 0.03)
    assert abs(found.pitch_rad - pitch) < max(4 * found.pitch_sigma_rad, 0.01)
    assert found.height_sigma_m < 0.15 * height
    assert found.miss < 0.06


def test_exact_people_tell_it_exactly():
    box = crowd(camera(height_m=3.0, pitch_rad=0.1), np.random.default_rng(0), n=40, noise=0, scatter=0)
    found = calibrate_pose(box, camera(), 1.75, 0.05)
    assert found.height_m == pytest.approx(3.0, abs=1e-4)
    assert found.pitch_rad == pytest.approx(0.1, abs=1e-5)
    complete = with_pose(camera(), found)
    assert (complete.height_m, complete.pitch_rad) == (found.height_m, found.pitch_rad)


def test_people_half_hidden_hardly_count():
    cam, rng = camera(height_m=3.0, pitch_rad=0.1), np.random.default_rng(1)
    box = crowd(cam, rng)
    hidden = rng.random(len(box)) < 0.15
    box[hidden, 3] *= 0.6  # the legs are hidden
    assert calibrate_pose(box, cam, 1.75, 0.05).height_m == pytest.approx(3.0, rel=0.1)


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


def test_few_people_do_not_tell():
    with pytest.raises(InputError, match="3 whole boxes of people; wanted 20"):
        calibrate_pose(np.ones((3, 4)), camera(), 1.75, 0.05)
