"""Which frames a window looks at, the interval rule, and the sizes that targets may have at an altitude."""

import numpy as np
import pytest

from torchvision_dddas.config import IntervalParameters, Settings, load_config, with_parameters
from torchvision_dddas.detection import interval as windows
from torchvision_dddas.detection.interval import (
    AltitudeSettings,
    Gates,
    adjust_interval,
    follow_altitude,
    interval_from_flow,
    interval_from_telemetry,
    settings_at,
)

PARAMETERS = IntervalParameters(minimum_frames=1, maximum_frames=12)
BASE = with_parameters(
    Settings(),
    {
        "gates.min_area_px": 300,
        "gates.focal_px": 1000.0,
        "gates.expected_size_m": 2.0,
        "gates.expected_share": 0.1,
        "gates.min_size_m": 0.5,
        "gates.max_size_m": 10.0,
        "gates.max_speed_m_s": 30.0,
        "small.min_area_px": 12,
        "small.max_box_px": 1600,
        "small.on": True,
    },
)


@pytest.mark.parametrize(
    ("altitude", "speed", "rate", "interval"),
    [(20, 5, 10, 1), (40, 5, 10, 2), (20, 2.5, 10, 2), (20, 5, 30, 3), (60, 10, 20, 3)],
)
def test_the_interval_is_one_at_the_reference_and_proportional_to_altitude_rate_and_one_over_speed(
    altitude, speed, rate, interval
):
    assert interval_from_telemetry(altitude, speed, rate, PARAMETERS) == pytest.approx(interval)


def test_the_interval_from_flow_is_inverse_to_the_median_flow_and_independent_of_the_picture_size():
    once = interval_from_flow([12.8], 640, PARAMETERS)
    assert once == pytest.approx(PARAMETERS.reference_flow / 0.02)
    assert interval_from_flow([6.4], 640, PARAMETERS) == pytest.approx(2 * once)
    assert interval_from_flow([25.6], 1280, PARAMETERS) == pytest.approx(once)
    assert interval_from_flow([5, 5, 5, 5, 300], 640, PARAMETERS) == interval_from_flow([5], 640, PARAMETERS)


@pytest.mark.parametrize(
    ("wanted", "interval"),
    [
        (0.0, 1),
        (1.4, 1),
        (3.6, 4),
        (500, 12),
        (1e30, 12),
        (interval_from_telemetry(100, 0.0, 10, PARAMETERS), 12),  # hovering
        (interval_from_flow([0.0], 640, PARAMETERS), 12),  # a still camera
    ],
)
def test_the_interval_is_rounded_and_bounded(wanted, interval):
    assert adjust_interval(1, 7, wanted, "", PARAMETERS)[0] == interval


def test_noise_around_the_middle_between_two_intervals_does_not_make_it_flutter():
    current, changes = 3, 0
    for k in range(40):
        current, records = adjust_interval(k, current, 3.5 + 0.2 * (-1) ** k, "", PARAMETERS)
        changes += len(records)
    assert changes == 0


def test_gates_are_metric_bounds_times_focal_over_altitude():
    assert settings_at(50.0, 10.0, BASE).gates == Gates(min_size_px=10.0, max_size_px=200.0, max_speed_px=60.0)
    assert settings_at(50.0, 30.0, BASE).gates == Gates(10.0, 200.0, 20.0)
    assert settings_at(100.0, 10.0, BASE).gates == Gates(5.0, 100.0, 30.0)


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


@pytest.mark.parametrize(
    ("altitude", "area", "small"), [(50.5, 157, True), (49.5, 163, False), (10.0, 300, False), (500.0, 12, True)]
)
def test_the_expected_size_sets_the_smallest_area_between_its_bounds_and_switches_the_small_path(altitude, area, small):
    """2 m at 1000 px focal length are 2000 / altitude px; the smallest area is a tenth of its square."""
    settings = settings_at(altitude, 10, BASE).settings
    assert (settings.gates.min_area_px, settings.small.on) == (area, small)


def test_gaps_are_closed_in_metres_where_that_is_wanted_and_never_wider_than_in_pixels():
    base = with_parameters(Settings(), {"morphology.close_m": 1.5, "gates.focal_px": 554.0})
    closes = [settings_at(altitude, 10.0, base).settings.morphology.close_px for altitude in (10, 50, 200)]
    assert closes == [base.morphology.close_px, 17, 4]
    assert settings_at(200.0, 10.0, Settings()).settings.morphology.close_px == Settings().morphology.close_px


def test_settings_move_only_when_the_altitude_has_changed_by_a_fifth_or_is_lost():
    current, first = follow_altitude(1, AltitudeSettings(BASE), 100.0, 10, BASE)
    assert {record.parameter for record in first} >= {"gates.min_area_px", "gates.max_size_px", "gates.max_speed_px"}
    assert all("altitude 100.0 m" in record.cause for record in first)
    assert follow_altitude(2, current, 119.0, 10, BASE) == (current, ())
    higher, records = follow_altitude(3, current, 121.0, 10, BASE)
    assert higher.altitude_m == 121.0
    bound = next(record for record in records if record.parameter == "gates.max_size_px")
    assert bound.new == pytest.approx(bound.old * 100 / 121)
    assert "was 100.0 m" in bound.cause
    after, records = follow_altitude(9, current, None, 10, BASE)
    assert after == AltitudeSettings(BASE)
    assert {record.cause for record in records} == {"no telemetry for this frame"}
    assert follow_altitude(10, after, None, 10, BASE) == (after, ())


SHIPPED = {name: load_config(name) for name in ("source", "fast")} | {"default": load_config()}
ENDS = [(0, 40), (0, 20), (20, 40), (19, 21), (20, 22), (18, 20)]


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("interval", [1, 2, 3, 4, 6, 12])
@pytest.mark.parametrize(("first", "last"), ENDS)
def test_every_frame_of_a_window_hangs_together_with_it_and_lies_at_most_two_intervals_ahead(
    name, interval, first, last
):
    near, wide, small = windows.choose_pairs(20, interval, first, last, SHIPPED[name])
    used = [i for pair in [*near, wide, small] if pair for i in pair]
    assert all(first <= i <= min(last, 20 + 2 * interval) for i in used)
    assert 20 not in used or SHIPPED[name].difference.kind == "between_later"
    assert all(a != b for a, b in near)


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("interval", [1, 2, 3, 4, 6, 12])
def test_reach_covers_all_that_a_window_looks_at(name, interval):
    """What comes after the reach must not matter, or a stream would give other results than a file."""
    ahead = windows.look_ahead(interval, SHIPPED[name])
    for first in (0, 17, 19, 20):
        seen = windows.choose_pairs(20, interval, first, 20 + ahead, SHIPPED[name])
        assert windows.choose_pairs(20, interval, first, 60, SHIPPED[name]) == seen


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("interval", [2, 3, 4, 6, 12])
def test_reach_and_delay_together_are_at_most_two_intervals(name, interval):
    settings = SHIPPED[name]
    assert windows.look_ahead(interval, settings) + windows.settling_delay(interval, settings) <= 2 * interval


def test_small_targets_are_looked_for_only_over_long_intervals_and_where_they_are_switched_on():
    settings = with_parameters(load_config(), {"small.from_interval": 3, "small.gap_frames": 3})
    assert windows.choose_pairs(20, 2, 0, 40, settings)[2] is None
    assert windows.choose_pairs(20, 3, 0, 40, settings)[2] == (17, 23)
    assert windows.choose_pairs(20, 3, 0, 40, with_parameters(settings, {"small.on": False}))[2] is None
