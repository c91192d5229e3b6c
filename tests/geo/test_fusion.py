"""TargetFusion: one state for each target from the measurements of several platforms."""

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import TargetFusion
from torchvision_dddas.types import AerialLocations, Fix, GroundLocations, LandmarkObservations, Positions, Sightings

GPS_M, OWN_M = 1.4, 0.2


def aerial(time_s, place, number=None, origin=None, own_m=OWN_M):
    n, frame = len(place), round(10 * time_s) + 1
    number = np.arange(1, n + 1) if number is None else np.asarray(number)
    own = np.tile(own_m**2 * np.eye(2), (n, 1, 1))
    there = Positions(
        np.full(n, frame), number, np.asarray(place, float), own + GPS_M**2 * np.eye(2), np.ones(n), origin
    )
    fix, unknown = Fix(frame, "homography"), np.full((n, 2), np.nan)
    return AerialLocations(
        frame, time_s, there, np.arange(n), own, unknown, np.ones((n, 4)), fix, LandmarkObservations()
    )


def ground(place, origin=None):
    n = len(place)
    place, camera = np.reshape(place, (n, 2)).astype(float), np.zeros((n, 2, 6))
    camera[:, :, :2] = GPS_M * np.eye(2)
    own, away = np.tile(OWN_M**2 * np.eye(2), (n, 1, 1)), np.full(n, 12.0)
    seen = Sightings(place, away, np.zeros(n), np.full(n, "both"), own, np.zeros((n, 2)), camera)
    ones, number = np.ones(n), np.arange(1, n + 1)
    there = Positions(np.ones(n, int), number, place, seen.covariance_m2, ones, origin)
    cut, box = np.zeros(n, bool), np.ones((n, 4))
    return GroundLocations(1, there, number[:, None], seen, np.zeros(n, int), number, cut, ones, box)


def walk(time_s, at=((0.0, 0.0), (6.0, 1.0), (-5.0, 7.0))):
    return np.array(at) + time_s * np.array([1.0, 0.5])


def records(seed=0, seconds=8.0, off=None):
    """(time, platform, record): three walkers seen from the air ten times a second and by two vehicles twice."""
    rng, off = np.random.default_rng(seed), off or {}
    off = {name: off.get(name, rng.normal(0, GPS_M, 2)) for name in ("uav", "ugv1", "ugv2")}
    made = []
    for k in range(round(10 * seconds)):
        time_s = k / 10
        made.append((time_s, "uav", aerial(time_s, walk(time_s) + off["uav"] + rng.normal(0, OWN_M, (3, 2)))))
        if k % 5 == 0:
            for name in ("ugv1", "ugv2"):
                place = walk(time_s) + off[name] + rng.normal(0, OWN_M, (3, 2))
                made.append((time_s, name, ground(place)))
    return made


def fuse(made, **options):
    fusion, found = TargetFusion(**options), []
    for time_s, name, record in made:
        found += fusion.update(record, name, time_s=time_s, lasting=name == "uav")
    return fusion, found + fusion.flush()


def test_people_seen_by_several_platforms_are_one_target_each_and_people():
    _, found = fuse(records())
    last = found[-1]
    assert len(last) == 3 and all(set(seen) == {"uav", "ugv1", "ugv2"} for seen in last.seen_by)
    assert last.classes == ("", "person") and (last.probability[:, 1] > 0.5).all()


def test_measurements_that_come_late_give_the_result_of_those_in_order():
    made = records()
    late = sorted(made, key=lambda one: one[0] + (1.3 if one[1] == "ugv1" else 0.0))
    (_, first), (fusion, second) = fuse(made), fuse(late)
    assert fusion.late == 0
    assert np.allclose(first[-1].state, second[-1].state, atol=1e-6)


def test_what_comes_later_than_the_delay_is_left_out_and_counted():
    fusion, _ = fuse(records())
    assert fusion.update(ground(walk(1.0)), "ugv1", time_s=1.0) == [] and fusion.late == 1


@pytest.mark.slow
def test_ellipses_and_speeds_hold_the_truth_as_often_as_they_say():
    squares = []
    for seed in range(12):
        _, found = fuse(records(seed, 5.0), delay_s=0.0)
        order = np.argsort([seen["uav"] for seen in found[-1].seen_by])
        error = np.c_[walk(found[-1].time_s), np.tile([1.0, 0.5], (3, 1))] - found[-1].state[order]
        squares += [e @ np.linalg.solve(c, e) for e, c in zip(error, found[-1].covariance[order], strict=True)]
    assert 1.5 < np.mean(squares) < 6.0  # four numbers


@pytest.mark.slow
def test_together_the_error_is_less_than_of_the_platforms_alone():
    alone, both = list[float](), list[float]()
    for seed in range(12):
        for kept, errors in ((("uav",), alone), (("uav", "ugv1", "ugv2"), both)):
            _, found = fuse([one for one in records(seed, 3.0) if one[1] in kept], delay_s=0.0)
            order = np.argsort([seen["uav"] for seen in found[-1].seen_by])
            errors.append(np.square(found[-1].state[order, :2] - walk(found[-1].time_s)).mean())
    assert np.sqrt(np.mean(both) / np.mean(alone)) < 0.75


def test_a_platform_far_from_what_the_others_agree_on_counts_less():
    fusion, found = fuse(records(off={"uav": np.zeros(2), "ugv1": np.zeros(2), "ugv2": np.array([4.0, 3.0])}))
    assert fusion.weights["ugv2"] < 0.5 * min(fusion.weights["uav"], fusion.weights["ugv1"])
    assert np.allclose(np.subtract(fusion.offsets_m["ugv2"], fusion.offsets_m["uav"]), (4, 3), atol=0.5)
    assert np.abs(found[-1].state[:, :2].mean(axis=0) - walk(found[-1].time_s).mean(axis=0)).max() < 1.0


def test_a_target_keeps_its_number_where_a_platform_changes_its_identity():
    made = [(t / 10, "uav", aerial(t / 10, walk(t / 10), np.arange(3) + (1 if t < 20 else 11))) for t in range(40)]
    _, found = fuse(made)
    assert found[-1].target.tolist() == [1, 2, 3]
    assert sorted(seen["uav"] for seen in found[-1].seen_by) == [11, 12, 13]


def test_targets_that_nobody_sees_are_forgotten():
    made = [*records(seconds=2.0), (9.0, "uav", aerial(9.0, np.zeros((0, 2))))]
    assert len(fuse(made)[1][-1]) == 0


def test_who_comes_after_a_long_pause_is_another_target():
    made = [*records(seconds=2.0), *((60 + t / 10, "uav", aerial(60 + t / 10, walk(0.0), [7, 8, 9])) for t in range(4))]
    assert not set(fuse(made)[1][-1].target) & {1, 2, 3}


def test_false_alarms_do_not_pile_up_and_hide_no_target():
    rng, fusion = np.random.default_rng(0), TargetFusion(delay_s=0.0)
    for t in range(12):
        place = np.r_[walk(t / 10), rng.uniform(100, 900, (20, 2))]
        (found,) = fusion.update(aerial(t / 10, place, [1, 2, 3, *range(100 * t + 100, 100 * t + 120)]), "uav")
    assert found.target[:3].tolist() == [1, 2, 3] and len(fusion._targets.targets) < 100  # of 243


def test_a_target_without_a_place_does_not_disturb_the_others():
    gone = np.array([[0.0, 0.0], [np.nan, np.nan], [-5.0, 7.0]])
    _, found = fuse([(t / 10, "uav", aerial(t / 10, gone)) for t in range(5)])
    assert len(found[-1]) == 2 and np.isfinite(found[-1].state).all()


def test_a_delay_below_zero_is_refused():
    for delay_s in (-1.0, np.nan):
        with pytest.raises(InputError, match="delay_s"):
            TargetFusion(delay_s=delay_s)


def test_now_tells_what_is_known_before_it_is_final():
    fusion = TargetFusion()
    assert fusion.now() is None
    for time_s, name, record in records(seconds=1.0):
        assert fusion.update(record, name, time_s=time_s) == []
    known = fusion.now()
    assert known is not None and known.time_s == pytest.approx(0.9) and len(known) == 3


def test_places_in_degrees_and_in_local_metres_do_not_mix():
    fusion = TargetFusion()
    fusion.update(aerial(0.0, walk(0.0), origin=(8.0, 50.0)), "uav")
    with pytest.raises(InputError, match="local metres"):
        fusion.update(ground(walk(0.0)), "ugv1", time_s=0.0)


def test_records_with_another_origin_are_moved_to_the_common_one():
    fusion = TargetFusion(delay_s=0.0)
    for k in range(5):
        fusion.update(aerial(k / 10, walk(0.0), origin=(8.0, 50.0)), "uav")
        other = ground(walk(0.0) + np.array([0, 111.24]), origin=(8.0, 49.999))
        (found,) = fusion.update(other, "ugv1", time_s=k / 10, lasting=False)
    assert len(found) == 3 and np.abs(found.state[:, :2] - walk(0.0)).max() < 0.3


def test_a_record_without_time_is_refused():
    with pytest.raises(InputError, match="no time"):
        TargetFusion().update(ground(walk(0.0)), "ugv1")


def test_views_that_are_off_by_a_neighbours_place_are_matched_by_more_than_one_target():
    rng, crowd = np.random.default_rng(1), [(1.0 * k, 0.6 * (k % 3)) for k in range(8)]
    fusion = TargetFusion(delay_s=0.0)
    for k in range(120):
        place = walk(k / 10, crowd) + rng.normal(0, 0.1, (8, 2))
        fusion.update(aerial(k / 10, place, own_m=0.1), "uav")
        inside = slice(0, 1 if k < 40 else 8)  # of the other view
        other = aerial(k / 10, place[inside] + (1.0, 0.5), np.arange(21, 29)[inside], own_m=0.1)
        (fused,) = fusion.update(other, "uav2")
        assert k > 40 or all(len(seen) < 2 for seen in fused.seen_by)
    assert {seen["uav"]: seen.get("uav2") for seen in fused.seen_by} == {n: n + 20 for n in range(1, 9)}


def test_a_single_target_of_two_views_is_one_where_nobody_else_is_near():
    fusion = TargetFusion(delay_s=0.0)
    for k in range(60):
        place = walk(k / 10, [(0.0, 0.0), (40.0, 0.0)])
        fusion.update(aerial(k / 10, place), "uav")
        (fused,) = fusion.update(aerial(k / 10, place[:1] + 1.0, [7]), "uav2")
    assert fused.target.tolist() == [1, 2] and fused.seen_by.tolist() == [{"uav": 1, "uav2": 7}, {"uav": 2}]
