"""Instruments of a served vehicle that are off, stuck, wrong or slow."""

import math

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.simulation.instrument_faults import SLOW_S, WRONG_DEG, Instruments, parse_fault
from torchvision_dddas.types import Flight


def flown(fault, seconds=20, step_s=0.5):
    """The pictures and reports of a flight to the north, with a fault: lists by half seconds."""
    instruments = Instruments([parse_fault(fault)] if fault else [])
    shown = []
    for k in range(round(seconds / step_s)):
        image = np.full((2, 2, 3), k, np.uint8)
        image[0] += 100
        said = Flight(50.0, 1.0, (11.0, 48.0 + k / 1000), heading_rad=k / 100, pitch_rad=1.0)
        shown.append(instruments.show(k * step_s, image, said))
    return shown


def latitudes(shown):
    return [round(1000 * (report.place[1] - 48)) for _, report in shown]


@pytest.mark.parametrize(
    "text", ["gps", "gps=stuck", "gps=stuck@3", "gps=stuck@5..3", "radar=off@1..2", "gps=gone@1..2", "gps=off@-1..2"]
)
def test_a_wrong_fault_is_named(text):
    with pytest.raises(InputError, match=r"wanted INSTRUMENT=VERB@FROM\.\.TO"):
        parse_fault(text)


def test_without_faults_everything_is_passed_on():
    shown = flown("")
    assert latitudes(shown) == list(range(40))
    assert [image[1, 0, 0] for image, _ in shown] == list(range(40))


def test_a_receiver_that_is_off_has_no_place_but_angles_go_on():
    shown = flown("gps=off@5..10")
    is_off = [math.isnan(report.place[0]) for _, report in shown]
    assert is_off == [False] * 10 + [True] * 10 + [False] * 20
    assert all(math.isnan(report.altitude_m) == off for (_, report), off in zip(shown, is_off, strict=True))
    assert [report.heading_rad for _, report in shown] == [k / 100 for k in range(40)]


def test_a_stuck_receiver_repeats_its_last_place():
    assert latitudes(flown("gps=stuck@5..10")) == [*range(10), *[9] * 10, *range(20, 40)]


def test_a_slow_receiver_is_late():
    late = round(SLOW_S / 0.5)
    assert latitudes(flown("gps=slow@5..10")) == [*range(10), *range(10 - late, 20 - late), *range(20, 40)]


def test_a_wrong_attitude_is_turned():
    shown = flown("attitude=wrong@5..10")
    off = [math.degrees(report.heading_rad) - math.degrees(k / 100) for k, (_, report) in enumerate(shown)]
    assert off == pytest.approx([0] * 10 + [WRONG_DEG] * 10 + [0] * 20)
    assert latitudes(shown) == list(range(40))


def test_a_camera_that_is_off_stuck_or_wrong():
    assert [image is None for image, _ in flown("camera=off@5..10")] == [False] * 10 + [True] * 10 + [False] * 20
    assert [image[1, 0, 0] for image, _ in flown("camera=stuck@5..10")] == [*range(10), *[9] * 10, *range(20, 40)]
    upside_down = [image[0, 0, 0] < image[1, 0, 0] for image, _ in flown("camera=wrong@5..10")]
    assert upside_down == [False] * 10 + [True] * 10 + [False] * 20


def test_a_silent_world_stays_silent():
    instruments = Instruments([parse_fault("gps=stuck@0..9")])
    assert instruments.show(1.0, None, None) == (None, None)
