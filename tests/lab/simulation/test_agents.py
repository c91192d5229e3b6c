"""The world's inhabitants: people and cars on their own, and all together with the faults that show and end."""

from dataclasses import astuple
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from torchvision_dddas import geometry
from torchvision_dddas.lab.simulation import CarPlan, CrowdPlan, Scenario
from torchvision_dddas.lab.simulation.agents import Agents
from torchvision_dddas.lab.simulation.crowds import FASTEST_M, SLOWEST_M, UNIT_S, Crowds
from torchvision_dddas.lab.simulation.ground_vehicles import RADIUS_M, Cars
from torchvision_dddas.lab.simulation.movement import Obstacles, near_pairs
from torchvision_dddas.lab.simulation.scenario import Happening

NOTHING = np.zeros((0, 5))


def standing(*discs, kind="building"):
    places = np.array(discs, float).reshape(-1, 3)
    return SimpleNamespace(kind=(kind,) * len(places), east_north_m=places[:, :2], radius_m=places[:, 2])


def people(*plans, happen=(), things=None, seed=1):
    return Crowds(plans, happen, 200.0, Obstacles(things or standing(), 200.0), seed, 100)


def walk(crowds, seconds, start_s=0.0):
    """(T, N, 2) places, and the events."""
    places, events = [crowds.place], []
    for step in range(round(seconds * 10)):
        events += crowds.step(start_s + (step + 1) / 10, 0.1, NOTHING)
        places.append(crowds.place)
    return np.array(places), events


def bearing_deg(way):
    return np.degrees(np.arctan2(*way))


def test_a_random_crowd_moves_at_the_speeds_of_its_source():
    crowds = people(*(CrowdPlan(people=1, start_m=(0.0, y), behaviour="random") for y in range(-80, 81, 10)))
    middles = [crowds._groups.middle.copy()]
    for unit in range(40):
        walk(crowds, UNIT_S, unit * UNIT_S)
        middles.append(crowds._groups.middle.copy())
    steps = np.abs(np.diff(middles, axis=0))
    # Few of them had to wait or turn back.
    within = ((steps > SLOWEST_M - 1e-6) & (steps < FASTEST_M + 1e-6)).all(axis=2)
    assert within.mean() > 0.95
    assert steps[within].mean() == pytest.approx((SLOWEST_M + FASTEST_M) / 2, rel=0.05)


@pytest.mark.parametrize("speed_m_s", [0.8, 3.0])
def test_walkers_walk_at_their_speed_and_heading(speed_m_s):
    places, _ = walk(people(CrowdPlan(people=15, heading_deg=30.0, speed_m_s=speed_m_s)), 20)
    gone = (places[-1] - places[50]).mean(axis=0) / 15
    assert np.linalg.norm(gone) == pytest.approx(speed_m_s, rel=0.05)
    assert bearing_deg(gone) == pytest.approx(30.0, abs=3.0)


def test_nobody_steps_on_another_in_a_dense_crowd():
    crowds = people(CrowdPlan(people=150, radius_m=1.0), CrowdPlan(people=60, start_m=(25.0, 0.0), heading_deg=270.0))
    places, _ = walk(crowds, 20)
    apart = np.linalg.norm(places[::5, :, None] - places[::5, None], axis=3) + 10 * np.eye(210)
    assert apart.min() > 0.35
    assert np.median(apart.min(axis=(1, 2))) > 0.48


def test_a_crowd_waits_for_its_start_time():
    middle = walk(people(CrowdPlan(people=6, from_s=5.0)), 10)[0].mean(axis=1)
    assert np.linalg.norm(middle[49] - middle[0]) < 0.3
    assert np.linalg.norm(middle[-1] - middle[49]) == pytest.approx(1.4 * 5, rel=0.15)


def test_crowds_turn_back_at_the_edge_and_walk_round_a_building():
    places, _ = walk(people(CrowdPlan(people=5, start_m=(80.0, 0.0), speed_m_s=2.0)), 30)
    assert places[..., 0].max() < 100.0 - 5.0
    assert places[-1, :, 0].mean() < 75.0
    places, _ = walk(people(CrowdPlan(people=12), things=standing((20.0, 0.0, 6.0))), 40)
    assert np.linalg.norm(places - (20.0, 0.0), axis=2).min() > 6.0
    assert places[-1, :, 0].min() > 30.0


def test_crowds_that_join_become_the_first():
    crowds = people(
        CrowdPlan(people=8, start_m=(-10.0, 0.0), heading_deg=0.0),
        CrowdPlan(people=5, start_m=(10.0, 0.0), behaviour="stand"),
        happen=(Happening(time_s=1.0, what="join", crowds=(1, 2)),),
    )
    assert set(crowds.target) == {1, 2}
    places, events = walk(crowds, 30)
    assert events == ["crowds 1 and 2 walk towards each other", "crowds 1 and 2 join into crowd 1"]
    assert set(crowds.target) == {1}
    assert np.linalg.norm(places[-1] - places[-1].mean(axis=0), axis=1).max() < 5.0
    assert places[-1].mean(axis=0) - places[-51].mean(axis=0) == pytest.approx((0.0, 7.0), abs=0.7)


@pytest.mark.parametrize("plan", [{}, {"behaviour": "stand", "speed_m_s": 0.0}])
def test_half_of_a_crowd_that_splits_gets_a_number_and_a_way_of_its_own(plan):
    split = Happening(time_s=2.0, what="split", turn_deg=60)
    crowds = people(CrowdPlan(people=11, heading_deg=90.0, **plan), happen=(split,))
    assert walk(crowds, 2)[1] == ["crowd 1 splits: 5 of 11 are now crowd 100"]
    places, _ = walk(crowds, 15, 2.0)
    for number, heading, many in ((1, 90.0, 6), (100, 150.0, 5)):
        mine = crowds.target == number
        assert mine.sum() == many
        if number == 100 or not plan:
            assert bearing_deg((places[-1] - places[50])[mine].mean(axis=0)) == pytest.approx(heading, abs=5.0)


def test_a_crowd_that_scatters_runs_apart_one_by_one():
    crowds = people(CrowdPlan(people=9, behaviour="stand"), happen=(Happening(time_s=1.0, what="scatter"),), seed=2)
    places, events = walk(crowds, 6)
    assert events == ["the 9 people of crowd 1 scatter"]
    assert sorted(crowds.target) == list(range(100, 109))
    assert (np.linalg.norm(places[-1] - places[-11], axis=1) > 1.8).all()
    spread = np.linalg.norm(places - places.mean(axis=1, keepdims=True), axis=2).mean(axis=1)
    assert spread[-1] > 8 * spread[0]


def test_happenings_of_crowds_that_are_no_more_do_nothing():
    order: Any = (("join", (1, 2)), ("scatter", (1, 2)), ("split", (1,)), ("scatter", (1,)), ("join", (1, 2)))
    happen = tuple(Happening(time_s=0.5 * (k + 1), what=what, crowds=of) for k, (what, of) in enumerate(order))
    crowds = people(CrowdPlan(people=3), CrowdPlan(people=1, start_m=(20.0, 0.0)), happen=happen)
    walk(crowds, 5)
    assert len(set(crowds.target)) == 4


def test_people_make_way_for_vehicles():
    crowds = people(CrowdPlan(people=10, behaviour="stand", radius_m=2.0))
    for step in range(60):
        crowds.step(step / 10, 0.1, np.array([[0.0, 0.0, np.pi / 4, 2.0, 1.0]]))
    ahead, aside = np.abs(np.sqrt(0.5) * crowds.place @ [[1, 1], [1, -1]]).T
    assert ((ahead > 2.0) | (aside > 1.0)).all()


@pytest.mark.parametrize("count", [0, 1, 300])
def test_near_pairs_are_those_of_a_search_of_all(count):
    place = np.random.default_rng(count).uniform(-6, 6, (count, 2))
    found = [tuple(sorted(pair)) for pair in zip(*(side.tolist() for side in near_pairs(place, 0.9)), strict=True)]
    away = np.linalg.norm(place[:, None] - place, axis=2)
    assert sorted(found) == [tuple(pair) for pair in np.argwhere(np.triu(away < 0.9, 1)).tolist()]


def drive(plan, seconds, others=()):
    cars, places = Cars((plan,), 200.0, Obstacles(standing(), 200.0), 0), []
    for step in range(round(seconds * 10)):
        cars.step((step + 1) / 10, 0.1, np.reshape(others, (-1, 2)))
        places.append(cars.place[0].copy())
    return np.array(places)


def test_a_car_drives_its_way_and_turns_no_narrower_than_it_can():
    way = ((0.0, 0.0), (60.0, 0.0), (60.0, 50.0))
    places = drive(CarPlan(way_m=way), 60)
    for corner in way[1:]:
        assert np.linalg.norm(places - corner, axis=1).min() < RADIUS_M
    step = np.diff(places, axis=0)
    course, gone = np.unwrap(np.arctan2(step[:, 0], step[:, 1])), np.linalg.norm(step, axis=1)
    assert (np.abs(np.diff(course)) <= gone[1:] / RADIUS_M * 1.05 + 1e-6).all()
    assert gone.max() <= 0.6 + 1e-6


def test_a_car_stops_before_many_people_and_passes_one():
    wall = np.stack([np.zeros(41), np.linspace(-20, 20, 41)], axis=1)
    places = drive(CarPlan(start_m=(-50.0, 0.0), speed_m_s=10.0), 15, wall)
    assert np.linalg.norm(places[:, None] - wall, axis=2).min() > 2.0
    places = drive(CarPlan(start_m=(-50.0, 0.0), speed_m_s=8.0), 25, np.zeros((1, 2)))
    assert np.linalg.norm(places, axis=1).min() > 1.4
    assert places[:, 0].max() > 20.0


# All together.


def world_of(side_m=200.0, trees=12):
    rng = np.random.default_rng(3)
    places, radius = rng.uniform(-side_m / 2, side_m / 2, (trees, 2)), rng.uniform(1.0, 3.0, trees)
    things = standing(*np.c_[places, radius], kind="tree")
    return SimpleNamespace(side_m=side_m, things=things, up_m=lambda at: 0.02 * at[:, 0] + 0.01 * at[:, 1])


def busy(**changed):
    given = {
        "seed": 5,
        "world": {"side_m": 200.0},
        "crowd": (
            {"people": 10, "start_m": (-30.0, 10.0)},
            {"people": 8, "start_m": (25.0, 0.0), "behaviour": "random"},
            {"people": 6, "start_m": (0.0, 35.0), "behaviour": "stand"},
        ),
        "car": ({"start_m": (-60.0, -40.0)}, {"start_m": (40.0, 50.0), "way_m": ((0.0, 60.0), (-60.0, 50.0))}),
        "happening": (
            {"time_s": 2.0, "what": "split", "crowds": (1,)},
            {"time_s": 3.0, "what": "scatter", "crowds": (2,)},
        ),
        "gps": {"error95_m": 3.5, "common_m": 0.5},
        "uav": {"way_m": ((20.0, 0.0), (20.0, 20.0))},
    }
    return Scenario.model_validate({**given, **changed})


def run(agents, frames):
    for _ in range(frames):
        agents.step()
    return agents.moment()


def moments(scenario, count, every=1):
    agents = Agents(scenario, world_of(scenario.world.side_m))
    return [run(agents, every) for _ in range(count)]


def is_same(one, other):
    """Where both hold NaN, they are the same."""
    arrays = [
        (m.bodies.place_m, m.bodies.target, m.bodies.phase, m.pose.place_m, m.pose.axes, m.turn_rad_s,
         m.reported_lonlat_deg, m.heading_rad, np.hstack(astuple(m.flight)[:9]))
        for m in (one, other)
    ]  # fmt: skip
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(*arrays, strict=True))


def test_a_run_depends_on_its_seed_and_not_on_skipped_frames():
    each, some, other = moments(busy(), 40), moments(busy(), 8, 5), moments(busy(seed=6), 40)
    assert all(is_same(each[5 * k + 4], found) for k, found in enumerate(some))
    assert [one.number for one in some] == [6 + 5 * k for k in range(8)]
    said = [[(r.vehicle, r.frame, r.planned, *r.lonlat_deg) for m in run for r in m.reports] for run in (each, some)]
    assert said[0] == said[1]
    assert [e for one in each for e in one.events] == [e for one in some for e in one.events]
    assert not np.allclose(each[-1].bodies.place_m[:10], other[-1].bodies.place_m[:10])


def test_nobody_leaves_the_world_and_feet_are_on_the_ground():
    scenario = busy(
        world={"side_m": 80.0},
        crowd=tuple({"people": 5, "speed_m_s": 6.0, "heading_deg": h} for h in (0.0, 45.0, 170.0)),
        car=({"speed_m_s": 12.0, "heading_deg": 30.0}, {"start_m": (5.0, 20.0), "way_m": ((500.0, 0.0),)}),
        happening=({"time_s": 1.0, "what": "scatter", "crowds": (1, 2)},),
    )
    for found in moments(scenario, 30, 6):
        place = found.bodies.place_m
        assert (np.abs(place[:, :2]) <= 40.0).all()
        assert np.allclose(place[:, 2], world_of().up_m(place[:, :2]))


def test_bodies_keep_their_numbers_and_vehicles_their_targets():
    first, *_, last = (found.bodies for found in moments(busy(), 60))
    assert np.array_equal(first.number, last.number)
    machines = first.kind != "person"
    assert np.array_equal(first.target[machines], last.target[machines])
    assert len(set(first.target[machines])) == machines.sum()
    assert not set(last.target[machines]) & set(last.target[~machines])
    assert np.array_equal(np.isfinite(first.plate[:, 0]), first.kind == "ugv")


def test_a_world_without_people_and_vehicles_goes_on():
    last = moments(Scenario.model_validate({"team": {"ugvs": 0}}), 30)[-1]
    assert len(last.bodies) == 0
    assert last.reports == ()
    assert last.reported_lonlat_deg.shape == (0, 2)


@pytest.mark.parametrize("rate_hz", [1.0, 7.0])
def test_any_rate_of_frames_is_possible(rate_hz):
    scenario = busy(clip={"rate_hz": rate_hz})
    found = moments(scenario, 20)
    assert found[-1].time_s == pytest.approx(20 / rate_hz)
    frames = sorted({r.frame for one in found for r in one.reports if not r.planned})
    assert np.allclose(np.diff(frames), rate_hz / scenario.gps.rate_hz)


def faulty(what, **more):
    fault = {"what": what, "time_s": 2.0, "seconds": 1.5, "vehicle": 2} | more
    quiet: dict = {"crowd": (), "car": (), "happening": (), "gps": {}}
    return moments(busy(fault=(fault,), team={"patrol": "along"}, **quiet), 60)


def is_on(one):
    return 2.0 - 1e-6 <= one.time_s < 3.5 - 1e-6


def heard(one, planned=False):
    return {r.vehicle for r in one.reports if r.planned == planned}


@pytest.mark.parametrize(
    ("what", "begins", "ends"),
    [
        ("ugv_lost", "ugv2 is lost", "ugv2 is back"),
        ("gps_dropout", "ugv2 has no GPS", "ugv2 has GPS again"),
        ("gps_jump", "the GPS of ugv2 is off by 10 m", "the GPS of ugv2 is correct again"),
        ("frozen", "the UAV's camera repeats a picture", "the UAV's camera works again"),
        ("dropped", "pictures of the UAV are missing", "the UAV's pictures are back"),
        ("gust", "a gust pushes the UAV at 10 m/s", "the gust is over"),
        ("landmark_hidden", "the marker of ugv2 is covered", "the marker of ugv2 is visible again"),
        ("telemetry_silent", "the UAV sends no telemetry", "the UAV sends telemetry again"),
    ],
)
def test_a_fault_shows_from_its_first_event_to_its_last(what, begins, ends):
    found = faulty(what)
    assert {one.time_s: event for one in found for event in one.events} == {2.0: begins, 3.5: ends}
    origin = busy().world.origin_deg
    for one in found:
        assert (one.picture == what) == (is_on(one) and what in ("frozen", "dropped"))
        assert (one.flight is None) == (is_on(one) and what == "telemetry_silent")
        assert one.bodies.hidden.tolist() == [False, is_on(one) and what == "landmark_hidden", False, False]
        is_silent = is_on(one) and what in ("ugv_lost", "gps_dropout")
        assert np.isnan(one.reported_lonlat_deg).all(axis=1).tolist() == [False, is_silent, False, False]
        off = np.linalg.norm(geometry.east_north(one.reported_lonlat_deg, origin) - one.bodies.place_m[:, :2], axis=1)
        assert off[[0, 2, 3]] == pytest.approx(0.0, abs=1e-4)
        assert is_silent or off[1] == pytest.approx(10.0 * (is_on(one) and what == "gps_jump"), abs=1e-4)


def test_a_lost_vehicle_stands_still_and_one_without_gps_shares_its_plans():
    found = faulty("ugv_lost")
    lost = [one for one in found if is_on(one)]
    places = np.array([one.bodies.place_m[1] for one in lost])
    assert np.ptp(places, axis=0).max() == 0
    assert not any(1 in heard(one) | heard(one, planned=True) for one in lost[:-1])
    assert np.linalg.norm(found[-1].bodies.place_m[1] - places[0]) > 1.0
    assert 1 in heard(found[-1])
    found = faulty("gps_dropout")
    assert all((1 in heard(one)) != is_on(one) and 0 in heard(one) for one in found)
    assert any(1 in heard(one, planned=True) for one in found if is_on(one))


def test_a_gust_pushes_the_uav_at_about_its_own_speed():
    for size, fastest in ((10.0, pytest.approx(10.0, rel=0.4)), (0.0, pytest.approx(2.0, abs=2.0))):
        found = [np.linalg.norm(one.velocity_m_s[:2]) for one in faulty("gust", size=size) if is_on(one)]
        assert max(found) == fastest


@pytest.mark.slow
def test_nobody_is_run_over():
    across = (CrowdPlan(people=12, start_m=(0.0, -20.0), heading_deg=0.0), CrowdPlan(people=8, behaviour="stand"))
    agents = Agents(busy(crowd=across, car=(CarPlan(start_m=(-60.0, 0.0), speed_m_s=8.0),)), world_of())
    for _ in range(100):
        run(agents, 2)
        bodies = agents.moment().bodies
        car = np.flatnonzero(bodies.kind == "car")[0]
        ahead = np.array([np.sin(bodies.facing_rad[car]), np.cos(bodies.facing_rad[car])])
        to = bodies.place_m[bodies.kind == "person", :2] - bodies.place_m[car, :2]
        assert ((np.abs(to @ ahead) > 2.2) | (np.abs(to @ (ahead[1], -ahead[0])) > 0.9)).all()


def test_after_a_cut_the_film_and_its_log_go_on_elsewhere():
    found = faulty("cut", size=12.0)
    after = next(k for k, one in enumerate(found) if is_on(one))
    before, now = found[after - 1], found[after]
    assert now.pose.place_m[0] - before.pose.place_m[0] == pytest.approx(12, abs=1)
    lonlat = np.array([before.flight.place, now.flight.place])
    assert np.ptp(geometry.east_north(lonlat, busy().world.origin_deg)[:, 0]) == pytest.approx(12, abs=1)
