"""The frames of a window, the interval rule, and the gates of an altitude."""

import numpy as np
import pytest

from torchvision_dddas.config import IntervalParameters, Settings, changes, config_folder, load_config, with_parameters
from torchvision_dddas.detection import interval as windows
from torchvision_dddas.detection.interval import (
    DistanceSettings,
    Gates,
    adjust_interval,
    follow_distance,
    interval_from_flow,
    interval_from_telemetry,
    look_cost,
    settings_at,
)
from torchvision_dddas.detection.person_scale import TINY, person_px, score_size
from torchvision_dddas.types import Flight

PARAMETERS = IntervalParameters(minimum_frames=1, maximum_frames=12)
# The source compares other frames at each interval.
WIDE = with_parameters(Settings(interval=PARAMETERS), {"difference.kind": "between_later"})


BASE = load_config(
    overrides=[
        *("gates.min_area_px=300", "gates.focal_px=1000", "gates.expected_size_m=2", "gates.expected_share=0.1"),
        *("gates.min_size_m=0.5", "gates.max_size_m=10", "gates.max_speed_m_s=30"),
        *("small.min_area_px=12", "small.max_box_px=1600", "small.on=true"),
    ]
)


@pytest.mark.parametrize(
    ("altitude", "speed", "rate", "interval"),
    [(20, 5, 10, 1), (40, 5, 10, 2), (20, 2.5, 10, 2), (20, 5, 30, 3), (60, 10, 20, 3)],
)
def test_the_interval_is_proportional_to_altitude_and_rate_over_speed(altitude, speed, rate, interval):
    for cost in (1.0, 1.5):
        wanted = interval_from_telemetry(altitude, speed, rate, cost, PARAMETERS)
        assert wanted == pytest.approx(cost * interval)


@pytest.mark.parametrize(
    ("flows", "width", "factor"), [([12.8], 640, 1), ([6.4], 640, 2), ([25.6], 1280, 1), ([12.8] * 4 + [300], 640, 1)]
)
def test_the_interval_is_inverse_to_the_median_flow_in_picture_widths(flows, width, factor):
    wanted = factor * PARAMETERS.reference_flow / 0.02
    assert interval_from_flow(flows, width, 1.0, PARAMETERS) == pytest.approx(wanted)


@pytest.mark.parametrize(
    ("wanted", "interval"),
    [
        (0.0, 1),
        (1.4, 1),
        (3.6, 4),
        (500, 12),
        (1e30, 12),
        (interval_from_telemetry(100, 0.0, 10, 1.0, PARAMETERS), 12),  # hovering
        (interval_from_flow([0.0], 640, 1.0, PARAMETERS), 12),  # a still camera
    ],
)
def test_the_interval_is_rounded_and_bounded(wanted, interval):
    assert adjust_interval(1, 7, wanted, "", WIDE)[0] == interval


def test_noise_between_two_intervals_changes_nothing():
    current = 3
    for k in range(40):
        current, records = adjust_interval(k, current, 3.5 + 0.2 * (-1) ** k, "", WIDE)
        assert not records


def test_an_interval_at_which_the_same_frames_are_compared_is_no_adjustment():
    """At 3 and 4 frames `fast` compares a frame with its two neighbours, at 5 with those two frames away."""
    settings = load_config("fast")
    assert adjust_interval(1, 3, 4.0, "", settings) == (3, ())
    (record,) = adjust_interval(1, 3, 5.0, "slow", settings)[1]
    assert (record.old, record.new, record.cause) == (3, 5, "slow")
    assert adjust_interval(1, 3, 4.0, "", Settings())[0] == 4


@pytest.mark.parametrize("name", [None, *sorted(path.stem for path in config_folder().glob("*.toml"))])
def test_every_shipped_configuration_compares_other_frames_at_another_interval(name):
    settings = load_config(name)
    reach = [max(map(max, windows.compared_frames(interval, settings))) for interval in (1, 3, 8)]
    assert reach[0] < reach[2] and reach == sorted(reach)


def test_the_cost_of_a_look_is_its_median_time_in_frames_of_the_reference_rate_unless_it_is_stated():
    measured = PARAMETERS.model_copy(update={"cost": 0.0})
    cost, words = look_cost([0.2, 0.25, 9.0], measured)
    assert cost == pytest.approx(2.5) and words == ", a look takes 250 ms"
    assert look_cost([0.02], measured)[0] == 1.0  # a fast computer compares frames no closer together
    assert look_cost([], measured) == (1.0, "")
    assert look_cost([0.25], PARAMETERS.model_copy(update={"cost": 2.0})) == (2.0, "")


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
    ("altitude", "area", "small"), [(50.5, 157, True), (20.0, 300, True), (12.0, 300, False), (500.0, 12, True)]
)
def test_the_expected_size_sets_the_smallest_area_and_switches_the_small_path(altitude, area, small):
    """2 m at 1000 px focal length are 2000 / altitude px; the smallest area is a tenth of its square, bounded.

    The search for small targets ends where a person seen from above, 0.5 m, is 39 px wide.
    """
    settings = settings_at(Flight(altitude), 10, BASE).settings
    assert (settings.gates.min_area_px, settings.small.on) == (area, small)


@pytest.mark.parametrize(
    ("altitude", "rate", "move_px", "gap"),
    [(100, 10, 1.4, 1), (200, 10, 1.4, 2), (200, 25, 1.4, 5), (200, 25, 0.7, 2), (400, 25, 1.4, 8), (200, 25, 0.0, 6)],
)
def test_a_walker_moves_as_far_between_the_frames_that_show_small_targets_at_any_distance_and_rate(
    altitude, rate, move_px, gap
):
    """1.4 m/s at 1000 px focal length are 1400 / altitude px a second; the gap is at most the longest interval."""
    base = with_parameters(BASE, {"small.gap_move_px": move_px})
    assert settings_at(Flight(altitude), rate, base).settings.small.gap_frames == gap


def test_a_gap_that_is_set_holds_at_any_distance():
    base = with_parameters(BASE, {"small.gap_frames": 6})
    assert settings_at(Flight(50.0), 10, base).settings.small.gap_frames == 6


@pytest.mark.parametrize(
    ("altitude", "parameters", "is_reported"),
    [
        (10.0, {}, False),
        (200.0, {}, True),
        (200.0, {"difference.kind": "between_later"}, False),
        (200.0, {"interval.rule": False, "interval.frames": 2}, False),
    ],
)
def test_the_gap_of_small_targets_is_reported_only_where_they_can_be_searched(altitude, parameters, is_reported):
    base = with_parameters(BASE, parameters)
    _, records = follow_distance(1, DistanceSettings(base), Flight(altitude), 10, base)
    assert ("small.gap_frames" in {record.parameter for record in records}) == is_reported


@pytest.mark.parametrize(
    ("altitude", "rate", "gates"), [(50, 10, (10, 200, 60)), (50, 30, (10, 200, 20)), (100, 10, (5, 100, 30))]
)
def test_gates_are_metric_bounds_times_focal_over_altitude(altitude, rate, gates):
    assert settings_at(Flight(altitude), rate, BASE).gates == Gates(*gates)


def test_closing_in_metres_is_bounded_by_the_pixels():
    base = with_parameters(Settings(), {"morphology.close_m": 1.5, "gates.focal_px": 554.0})
    closes = [settings_at(Flight(altitude), 10.0, base).settings.morphology.close_px for altitude in (10, 50, 200)]
    assert closes == [base.morphology.close_px, 17, 4]
    assert settings_at(Flight(200.0), 10.0, Settings()).settings.morphology.close_px == Settings().morphology.close_px


@pytest.mark.parametrize("refine", ["refine.on=false", "refine.on=true"])
def test_where_no_speed_is_computed_its_gate_is_not_set(refine):
    fast = load_config("fast", [refine])
    _, records = follow_distance(1, DistanceSettings(fast), Flight(100.0), 10, fast)
    assert {"gates.max_size_px"} <= (changed := {record.parameter for record in records})
    assert "gates.max_speed_px" not in changed


def test_settings_change_only_when_the_distance_changes_by_a_fifth_or_is_lost():
    current, first = follow_distance(1, DistanceSettings(BASE), Flight(100.0), 10, BASE)
    assert {record.parameter for record in first} >= {"gates.min_area_px", "gates.max_size_px", "gates.max_speed_px"}
    assert follow_distance(2, current, Flight(119.0), 10, BASE) == (current, ())
    higher, records = follow_distance(3, current, Flight(121.0), 10, BASE)
    bound = next(record for record in records if record.parameter == "gates.max_size_px")
    assert bound.new == pytest.approx(bound.old * 100 / 121)
    assert higher.flight is not None and higher.flight.altitude_m == 121.0
    assert "altitude 121.0 m" in bound.cause and "was 100.0 m" in bound.cause
    after, records = follow_distance(9, current, None, 10, BASE)
    assert after == DistanceSettings(BASE)
    assert {record.cause for record in records} == {"no telemetry for this frame"}
    assert follow_distance(10, after, None, 10, BASE) == (after, ())


@pytest.mark.parametrize(
    ("pitch_deg", "distance_m"), [(90, 40.0), (91, 40.0), (45, 56.57), (3, 400.0), (-10, 400.0), (np.nan, 40.0)]
)
def test_the_distance_along_the_view_is_the_altitude_over_the_sine_of_the_pitch(pitch_deg, distance_m):
    assert Flight(40.0, pitch_rad=np.radians(pitch_deg)).distance_m == pytest.approx(distance_m, abs=0.01)


def test_an_oblique_view_from_low_keeps_the_search_for_small_targets_on():
    """At 40 m a body straight below is 42 px long, at 57 m along a view of 45 degrees 30 px: small."""
    below, oblique = (
        follow_distance(1, DistanceSettings(Settings()), Flight(40.0, pitch_rad=np.radians(pitch)), 10, Settings())
        for pitch in (90, 45)
    )
    assert not below[0].settings.small.on and oblique[0].settings.small.on
    assert {record.cause for record in oblique[1]} == {"altitude 40.0 m, 56.6 m along the view"}


SHIPPED = {name: load_config(name) for name in ("source", "fast")} | {"default": load_config()}


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("interval", [1, 2, 3, 4, 6, 12])
def test_windows_stay_in_the_clip_and_within_two_intervals_ahead(name, interval):
    settings = SHIPPED[name]
    for first, last in [(0, 40), (0, 20), (20, 40), (19, 21), (20, 22), (18, 20)]:
        near, wide, small = windows.choose_pairs(20, interval, first, last, settings)
        used = [i for pair in [*near, wide, small] if pair for i in pair]
        assert all(first <= i <= min(last, 20 + 2 * interval) for i in used)
        assert 20 not in used or settings.difference.kind == "between_later"
        assert all(a != b for a, b in near)
    ahead = windows.look_ahead(interval, settings)
    assert interval == 1 or ahead + windows.settling_delay(interval, settings) <= 2 * interval
    for first in (0, 17, 19, 20):  # frames after the reach do not matter, so a stream equals a file
        expected = windows.choose_pairs(20, interval, first, 20 + ahead, settings)
        assert windows.choose_pairs(20, interval, first, 60, settings) == expected


@pytest.mark.parametrize(("interval", "on", "pair"), [(2, True, None), (3, True, (17, 23)), (3, False, None)])
def test_small_targets_need_a_long_interval_and_their_switch(interval, on, pair):
    settings = load_config(overrides=["small.from_interval=3", "small.gap_frames=3", f"small.on={str(on).lower()}"])
    assert windows.choose_pairs(20, interval, 0, 40, settings)[2] == pair


@pytest.mark.parametrize(
    ("near", "interval", "gaps"),
    [((1,), 1, {1}), ((1,), 8, {3}), ((1, 2), 1, {1}), ((1, 2), 3, {1, 2}), ((1, 2), 8, {1, 5}), ((4,), 8, {8})],
)
def test_without_a_wide_pair_the_longest_near_one_follows_the_interval(near, interval, gaps):
    settings = with_parameters(Settings(), {"difference.near_frames": near, "difference.wide_frames": 0})
    assert {b - 50 for _, b in windows.choose_pairs(50, interval, 0, 100, settings)[0]} == gaps


def test_near_the_ends_of_a_clip_pairs_still_look_both_ways_where_they_can():
    settings = with_parameters(load_config("fast"), {"interval.frames": 8})
    pairs = [windows.choose_pairs(at, 8, 0, 20, settings)[0] for at in (0, 1, 2, 3, 20)]
    assert pairs == [[(1, 2)], [(0, 2)], [(0, 4)], [(0, 6)], [(19, 18)]]


def test_two_frames_are_compared_one_interval_apart_and_at_the_end_with_the_earlier() -> None:
    settings = with_parameters(Settings(), {"difference.kind": "to_next"})
    assert windows.choose_pairs(3, 2, 0, 9, settings)[0] == [(5, 5)]
    assert windows.choose_pairs(9, 2, 0, 9, settings)[0] == [(7, 7)]


def down(altitude_m, pitch_deg=90.0):
    return Flight(altitude_m, pitch_rad=float(np.radians(pitch_deg)))


@pytest.mark.parametrize(
    ("flight", "size_px"), [(down(50), 10.0), (Flight(50.0), 10.0), (down(50, 45), 12.47), (down(0.1), 500.0)]
)
def test_a_person_covers_a_square_of_the_shoulders_from_above_and_of_more_of_the_body_aslant(flight, size_px):
    """0.5 m at 1000 px / 50 m. At 45 degrees the body shows 1.56 m by 0.5 m, from 71 m."""
    assert person_px(flight, 1000.0) == pytest.approx(size_px, abs=0.05)


@pytest.mark.parametrize("pitch_deg", [90.0, 45.0, 30.0])
def test_sizes_of_people_count_for_a_target_and_sizes_of_nothing_known_against_it(pitch_deg):
    """At 1000 px a metre at 1 m; the boxes stand in the middle row and on rows above and below it."""
    flight, sides = down(50, pitch_deg), np.array([0.3, 1.2, 1.8, 24.0]) * person_px(down(50, pitch_deg), 1000.0)
    box = np.stack([0 * sides, 500 - sides, sides, sides], axis=1)
    speck, person, group, wood = score_size(box, flight, 1000.0, 1000)
    assert person == pytest.approx(1.0) and speck == pytest.approx(-1.0) and wood < -0.5
    assert group < person
    metre = 1000.0 / flight.distance_m
    assert score_size(np.array([[0, 500 - 2 * metre, 4 * metre, 2 * metre]]), flight, 1000.0, 1000) == pytest.approx(0)


def test_the_expected_size_of_a_person_shrinks_towards_the_horizon():
    flight, side = down(50, 30), person_px(down(50, 30), 1000.0)
    at_foot = np.array([[0, row - side, side, side] for row in (100.0, 500.0, 900.0)])
    half, whole, double = at_foot * (1, 1, 0.5, 0.5), at_foot, at_foot * (1, 1, 2, 2)
    score = [score_size(box, flight, 1000.0, 1000) for box in (half, whole, double)]
    assert score[0].argmax() == 0, "far away, at the top of the picture, the small box fits best"
    assert score[2].argmax() == 2, "near, at the bottom, the large one"


@pytest.mark.parametrize("pitch_deg", [-90.0, -20.0, 0.0, 95.0, 150.0, 180.0, float("nan")])
def test_sizes_have_a_finite_score_at_any_pitch_of_the_camera(pitch_deg):
    box = np.array([[0, 0, 10, 10], [0, 400, 20, 40], [0, 470, 10, 10.0]])
    flight = Flight(30.0, pitch_rad=np.radians(pitch_deg))
    assert np.isfinite(score_size(box, flight, 400.0, 480)).all()


def test_boxes_above_the_largest_size_are_no_targets_and_without_telemetry_no_size_counts():
    base, boxes = with_parameters(Settings(), {"gates.focal_px": 1000.0}), np.array([[0, 0, 900.0, 900.0]])
    assert settings_at(down(50), 10, base).score_sizes(boxes, 1000) == -np.inf
    assert settings_at(None, 10, base).score_sizes(boxes, 1000) == 0


def test_tiny_people_get_their_settings_until_the_vehicle_flies_lower_or_its_log_ends():
    base = with_parameters(Settings(), {"gates.focal_px": 1000.0})
    high, records = follow_distance(1, settings_at(None, 10, base), down(100), 10, base)
    changed = {record.parameter: record.new for record in records}
    assert changed["gates.tiny"] == 1 and changed["gates.person_px"] == 5
    assert "altitude 100.0 m, focal length 1000 px" in records[0].cause
    assert high.settings.difference.threshold == TINY["difference.threshold"] and high.settings.tracklets.on
    assert high.settings.morphology.close_px == 15, "1.5 m"
    low, records = follow_distance(2, high, down(40), 10, base)
    assert low.settings.difference == base.difference and low.settings.refine.on
    assert ("gates.tiny", 1, 0) in {(record.parameter, record.old, record.new) for record in records}
    after, _ = follow_distance(3, high, None, 10, base)
    assert after == settings_at(None, 10, base) == DistanceSettings(with_parameters(base, {"small.on": False}))


def test_a_pitch_that_changes_the_size_of_people_changes_the_settings_at_the_same_distance():
    base = with_parameters(Settings(), {"gates.focal_px": 1000.0})
    below = settings_at(down(75), 10, base)
    aslant = down(75 * float(np.sin(np.radians(45))), 45)
    assert aslant.distance_m == pytest.approx(75) and below.tiny
    assert not follow_distance(2, below, aslant, 10, base)[0].tiny


@pytest.mark.parametrize(
    ("given", "tiny", "threshold"),
    [
        ({"gates.focal_px": 1000.0}, True, 2.0),
        ({}, False, 3.5),  # the focal length is not known
        ({"gates.focal_px": 1000.0, "gates.tiny_px": 0.0}, False, 3.5),
        ({"gates.focal_px": 1000.0, "difference.threshold": 3.0}, True, 3.0),  # what is set stays
        ({"gates.focal_px": 1000.0, "difference.kind": "to_reference"}, False, 3.5),
        ({"gates.person_px": 4.0}, True, 2.0),
        ({"gates.person_px": 4.0, "gates.focal_px": 4000.0}, False, 3.5),  # telemetry counts before it
    ],
)
def test_the_settings_for_tiny_people_need_a_known_scale_and_leave_what_is_set(given, tiny, threshold):
    found = settings_at(down(100), 10, with_parameters(Settings(), given))
    assert (found.tiny, found.settings.difference.threshold) == (tiny, threshold)


def test_patrol_is_the_default_with_a_size_of_people_for_clips_without_telemetry():
    patrol = load_config("patrol")
    assert changes(patrol) == {"gates.person_px": 4.0}
    assert settings_at(None, 10, patrol).settings.difference.blur_px == TINY["difference.blur_px"]


@pytest.mark.parametrize(
    ("parameters", "on"),
    [
        ({}, False),
        ({"small.on": True}, True),
        ({"small.hits": 5}, True),
        ({"tracklets.on": False}, True),
        ({"gates.person_px": 12.0}, True),
    ],
)
def test_tracklets_replace_the_search_for_small_targets_of_unknown_size(parameters, on):
    assert settings_at(None, 10, with_parameters(Settings(), parameters)).settings.small.on == on
