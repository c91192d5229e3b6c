"""What a run notices of its own instruments: silence, leaps, frozen and jerking pictures."""

import numpy as np
import pytest

from torchvision_dddas.control import SensorMonitor
from torchvision_dddas.types import Frame, Landmarks, Registration, Telemetry

RATE_HZ = 10.0


def reports(rows):
    """rows: (frame, which, east) or with planned."""
    table = np.array([(*row, 0)[:4] for row in rows], float).reshape(-1, 4)
    n = len(table)
    which, nowhere, place = table[:, 1].astype(np.int64), np.full((n, 2), np.nan), np.c_[table[:, 2], np.zeros(n)]
    sigma, planned = np.full(n, 0.1), table[:, 3] == 1
    return Landmarks(("ugv1", "ugv2"), table[:, 0], which, nowhere, place, sigma, planned, np.arange(n), False)


def standing(frames, which=1):
    return [(frame, which, 5.0 * which) for frame in frames]


def watched(until, rows, flown=1000):
    """All that is noticed from frame to frame, as (frame, text), where the first vehicle stands and reports."""
    watch, said = SensorMonitor(("ugv1", "ugv2"), RATE_HZ), []
    rows = standing(range(1, until + 1), 0) + rows
    for now in range(1, until + 1):
        heard = np.arange(min(now, flown)) / RATE_HZ
        nothing = np.full(len(heard), np.nan)
        there = reports([row for row in rows if row[0] <= now or len(row) == 4])
        watch.check_reports(now, there, Telemetry(heard, nothing, nothing, np.zeros((len(heard), 2))))
        said += [(notice.frame, notice.text) for notice in watch.notices()]
    return said


PLANNED = [(frame, 1, 5.0, 1) for frame in range(30, 100, 10)]
LEAP = "ugv2's reports leap by 10.0 m within 0.1 s"
SILENT, MUTE = "ugv2 reports no position for 2.1 s", "the UAV sends no telemetry for 2.1 s"
BACK = (50, "ugv2 reports its position again, after 3.0 s")


@pytest.mark.parametrize(
    ("rows", "flown", "said"),
    [
        (standing([*range(1, 21), *range(50, 61)]), 60, [(41, f"{SILENT}: it has no planned waypoints"), BACK]),
        (standing(range(1, 21)) + PLANNED, 60, [(41, f"{SILENT}: its planned waypoints are used")]),
        (standing(range(1, 61)), 10, [(31, f"{MUTE}: only landmarks give its position")]),
        ([(f, 1, 15.0 if 10 <= f < 20 else 5.0) for f in range(1, 61)], 60, [(10, LEAP), (20, LEAP)]),
    ],
    ids=["silent", "planned", "no telemetry", "leap"],
)
def test_silence_and_leaps_are_noticed_once_each(rows, flown, said):
    assert watched(60, rows, flown) == said


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


def test_pictures_that_repeat_are_noticed_at_the_first_and_counted_at_the_end():
    assert film([0.0] * 20, frozen=(8, 9, 10)) == [
        (9, "the picture repeats the one before: the camera is frozen"),
        (12, "the camera works again: 3 pictures repeated the one before"),
    ]


@pytest.mark.parametrize("sign", [1, -1])
def test_a_sudden_motion_of_the_picture_is_noticed_and_a_steady_one_is_not(sign):
    assert film([3.0 * sign] * 20) == []
    assert film([k * 0.2 * sign for k in range(40)]) == []
    ((frame, text),) = film([0.5] * 12 + [sign * 6.5] * 8)
    assert frame == 13 and "jerks" in text
