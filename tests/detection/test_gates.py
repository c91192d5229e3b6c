"""Bounds in metres, in pixels at an altitude."""

import numpy as np
import pytest

from torchvision_dddas.config import GateParameters
from torchvision_dddas.detection.gates import Gates, gates_at, pixels_per_metre

KNOBS = GateParameters(min_size_m=0.5, max_size_m=10.0, max_speed_m_s=30.0, focal_px=800.0)


def test_bounds_are_metric_bounds_times_focal_over_altitude():
    gates = gates_at(40.0, 10.0, KNOBS)
    assert gates == Gates(min_size_px=10.0, max_size_px=200.0, max_speed_px=60.0)


@pytest.mark.parametrize("altitude", [5.0, 40.0, 200.0])
def test_twice_as_high_everything_is_half_as_large(altitude):
    low, high = gates_at(altitude, 10.0, KNOBS), gates_at(2 * altitude, 10.0, KNOBS)
    assert high.min_size_px == pytest.approx(low.min_size_px / 2)
    assert high.max_size_px == pytest.approx(low.max_size_px / 2)
    assert high.max_speed_px == pytest.approx(low.max_speed_px / 2)


def test_a_faster_camera_sees_less_movement_a_frame():
    assert gates_at(40.0, 30.0, KNOBS).max_speed_px == pytest.approx(gates_at(40.0, 10.0, KNOBS).max_speed_px / 3)


@pytest.mark.parametrize("altitude", [0.0, -3.0, 0.5])
def test_on_the_ground_the_scale_stays_finite(altitude):
    assert pixels_per_metre(altitude, 800.0) == 800.0


@pytest.mark.parametrize(
    ("box", "velocity", "passes"),
    [
        ((20, 40), (3, 4), True),
        ((9, 9), (0, 0), False),
        ((9, 10), (0, 0), True),
        ((10, 201), (0, 0), False),
        ((20, 40), (0, 60.5), False),
        ((20, 40), (np.nan, np.nan), True),
    ],
)
def test_the_longer_side_and_the_speed_decide(box, velocity, passes):
    assert Gates(10.0, 200.0, 60.0).admit(box[0], box[1], np.array(velocity)) is passes
