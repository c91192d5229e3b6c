"""What a run notices of its own instruments: silence, leaps, frozen and jerking pictures, told once each."""

import numpy as np
import pytest

from torchvision_dddas.control import SensorMonitor
from torchvision_dddas.types import Frame, Landmarks, Registration, Telemetry

RATE_HZ = 10.0


def reports(rows):
    """rows: (frame, which, east, north) or with planned."""
    table = np.array([(*row, 0)[:5] for row in rows], float).reshape(-1, 5)
    n = len(table)
    which, nowhere, sigma = table[:, 1].astype(np.int64), np.full((n, 2), np.nan), np.full(n, 0.1)
    return Landmarks(
        ("ugv1", "ugv2"), table[:, 0], which, nowhere, table[:, 2:4], sigma, table[:, 4] == 1, np.arange(n), False
    )


def telemetry(times):
    nothing = np.full(len(times), np.nan)
    return Telemetry(np.asarray(times, float), nothing, nothing, np.zeros((len(times), 2)))


def standing(until, which=(0, 1)):
    return [(frame, k, 5.0 * k, 0.0) for frame in range(1, until + 1) for k in which]


def watched(until, rows, times=None):
    """All that is noticed from frame to frame, as (frame, text)."""
    watch = SensorMonitor(("ugv1", "ugv2"), RATE_HZ)
    times = np.arange(until) / RATE_HZ if times is None else np.asarray(times)
    said = []
    for now in range(1, until + 1):
        there = reports([row for row in rows if row[0] <= now or len(row) == 5])
        watch.check_reports(now, there, telemetry(times[times <= (now - 1) / RATE_HZ + 1e-9]))
        said += [(notice.frame, notice.text) for notice in watch.notices()]
    return said


def test_a_vehicle_that_falls_silent_is_told_once_and_again_when_it_is_back():
    rows = standing(60, (0,)) + [row for row in standing(60, (1,)) if not 20 < row[0] < 50]
    assert watched(60, rows) == [
        (41, "ugv2 reports no place for 2.1 s: nothing stands in for it"),
        (50, "ugv2 reports its place again, after 3.0 s"),
    ]


def test_a_plan_that_goes_on_stands_in_for_a_silent_vehicle():
    rows = [*standing(60, (0,)), *standing(20, (1,)), *((frame, 1, 5.0, 0.0, 1) for frame in range(30, 100, 10))]
    assert watched(60, rows) == [(41, "ugv2 reports no place for 2.1 s: its plan stands in for it")]


def test_telemetry_that_stops_is_told():
    (said,) = watched(40, standing(40), np.arange(10) / RATE_HZ)
    assert said == (31, "the UAV says nothing of itself for 2.1 s: landmarks alone tell its place")


def test_a_leap_is_told_with_its_length_there_and_back():
    rows = standing(30, (0,)) + [(f, 1, 5.0 + (10.0 if 10 <= f < 20 else 0.0), 0.0) for f in range(1, 31)]
    assert watched(30, rows) == [
        (10, "ugv2's reports leap by 10.0 m within 0.1 s"),
        (20, "ugv2's reports leap by 10.0 m within 0.1 s"),
    ]


def film(moves_px, frozen=()):
    """What is noticed of pictures of which the ground moves by so many pixels each; 0.1 m a pixel."""
    watch, rng = SensorMonitor((), RATE_HZ), np.random.default_rng(0)
    image, said = rng.integers(1, 255, (48, 64, 3), np.uint8), []
    for k, moved in enumerate(moves_px):
        if k not in frozen:
            image = rng.integers(1, 255, (48, 64, 3), np.uint8)
        step = np.eye(3)
        step[0, 2] = moved
        watch.check_picture(Frame(k + 1, k / RATE_HZ, image), Registration(step, 100, 100, 0.1, abs(moved)), 0.1)
        said += [(notice.frame, notice.text) for notice in watch.notices()]
    return said


def test_pictures_that_repeat_are_told_at_the_first_and_counted_at_the_end():
    assert film([0.0] * 20, frozen=(8, 9, 10)) == [
        (9, "the picture repeats the one before: the camera is frozen"),
        (12, "the camera sees again: 3 pictures repeated the one before"),
    ]


@pytest.mark.parametrize("sign", [1, -1])
def test_a_sudden_motion_of_the_picture_is_told_and_a_steady_one_is_not(sign):
    assert film([3.0 * sign] * 20) == []
    assert film([k * 0.2 * sign for k in range(40)]) == []
    ((frame, text),) = film([0.5] * 12 + [sign * 6.5] * 8)
    assert frame == 13 and "jerks" in text
