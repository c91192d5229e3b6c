"""The world's inhabitants together: reproducible, within bounds, and faults that show and end."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from torchvision_dddas import geometry
from torchvision_dddas.simulation import (
    AircraftParameters,
    CarPlan,
    ClipParameters,
    CrowdPlan,
    Fault,
    GpsParameters,
    Happening,
    Scenario,
    TeamParameters,
    WorldParameters,
)
from torchvision_dddas.simulation.agents import Agents, Moment
from torchvision_dddas.types import Command, Order


def scenario_of(given: dict[str, object]) -> Scenario:
    return Scenario.model_validate(given)


def world_of(side_m: float = 200.0, trees: int = 12, seed: int = 3) -> Any:
    rng = np.random.default_rng(seed)
    places = rng.uniform(-side_m / 2, side_m / 2, (trees, 2))
    things = SimpleNamespace(kind=np.repeat("tree", trees), east_north_m=places, radius_m=rng.uniform(1.0, 3.0, trees))
    return SimpleNamespace(side_m=side_m, things=things, up_m=lambda at: 0.02 * at[:, 0] + 0.01 * at[:, 1])


def busy(**changed: object) -> Scenario:
    given: dict[str, object] = {
        "seed": 5,
        "world": WorldParameters(side_m=200.0),
        "crowd": (
            CrowdPlan(people=10, start_m=(-30.0, 10.0)),
            CrowdPlan(people=8, start_m=(25.0, 0.0), behaviour="random"),
            CrowdPlan(people=6, start_m=(0.0, 35.0), behaviour="stand"),
        ),
        "car": (CarPlan(start_m=(-60.0, -40.0)), CarPlan(start_m=(40.0, 50.0), way_m=((0.0, 60.0), (-60.0, 50.0)))),
        "happening": (
            Happening(time_s=2.0, what="split", crowds=(1,)),
            Happening(time_s=3.0, what="scatter", crowds=(2,)),
        ),
        "gps": GpsParameters(error95_m=3.5, common_m=0.5),
        "uav": AircraftParameters(way_m=((20.0, 0.0), (20.0, 20.0))),
    }
    return scenario_of(given | changed)


def moments(scenario: Scenario, count: int, every: int = 1) -> list[Moment]:
    agents, found = Agents(scenario, world_of(scenario.world.side_m)), []
    for _ in range(count):
        for _ in range(every):
            agents.step()
        found.append(agents.moment())
    return found


def run(agents: Agents, frames: int) -> None:
    for _ in range(frames):
        agents.step()


def same(one: Moment, other: Moment) -> bool:
    pairs = [
        (one.bodies.place_m, other.bodies.place_m),
        (one.bodies.target, other.bodies.target),
        (one.bodies.phase, other.bodies.phase),
        (one.pose.place_m, other.pose.place_m),
        (one.pose.axes, other.pose.axes),
        (one.turn_rad_s, other.turn_rad_s),
        (one.reported_lonlat_deg, other.reported_lonlat_deg),
        (one.heading_rad, other.heading_rad),
    ]
    return one.flight == other.flight and all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def test_the_same_seed_gives_the_same_run_and_another_seed_another() -> None:
    one, again, other = moments(busy(), 40)[-1], moments(busy(), 40)[-1], moments(busy(seed=6), 40)[-1]
    assert same(one, again)
    assert not np.allclose(one.bodies.place_m[:10], other.bodies.place_m[:10])


@pytest.mark.parametrize("every", [2, 5])
def test_what_happens_does_not_depend_on_how_many_frames_are_looked_at(every: int) -> None:
    each, some = moments(busy(), 40), moments(busy(), 40 // every, every)
    assert all(same(each[every * (k + 1) - 1], found) for k, found in enumerate(some))
    assert [one.number for one in some] == [1 + every * (k + 1) for k in range(40 // every)]
    said = [(r.vehicle, r.frame, r.planned, *r.lonlat_deg) for one in each for r in one.reports]
    assert said == [(r.vehicle, r.frame, r.planned, *r.lonlat_deg) for one in some for r in one.reports]
    assert [e for one in each for e in one.events] == [e for one in some for e in one.events]


def test_nobody_leaves_the_world() -> None:
    scenario = busy(
        world=WorldParameters(side_m=80.0),
        crowd=tuple(CrowdPlan(people=5, start_m=(0.0, 0.0), speed_m_s=6.0, heading_deg=h) for h in (0.0, 45.0, 170.0)),
        car=(CarPlan(speed_m_s=12.0, heading_deg=30.0), CarPlan(start_m=(5.0, 20.0), way_m=((500.0, 0.0),))),
        happening=(Happening(time_s=1.0, what="scatter", crowds=(1, 2)),),
    )
    for found in moments(scenario, 30, 6):
        assert (np.abs(found.bodies.place_m[:, :2]) <= 40.0).all()


def test_nobody_is_run_over() -> None:
    across = (CrowdPlan(people=12, start_m=(0.0, -20.0), heading_deg=0.0), CrowdPlan(people=8, behaviour="stand"))
    agents = Agents(busy(crowd=across, car=(CarPlan(start_m=(-60.0, 0.0), speed_m_s=8.0),)), world_of())
    for _ in range(200):
        agents.step()
        bodies = agents.moment().bodies
        car = np.flatnonzero(bodies.kind == "car")[0]
        ahead = np.array([np.sin(bodies.facing_rad[car]), np.cos(bodies.facing_rad[car])])
        to = bodies.place_m[bodies.kind == "person", :2] - bodies.place_m[car, :2]
        assert ((np.abs(to @ ahead) > 2.2) | (np.abs(to @ (ahead[1], -ahead[0])) > 0.9)).all()


def test_feet_are_on_the_ground() -> None:
    bodies = moments(busy(), 3)[-1].bodies
    assert np.allclose(bodies.place_m[:, 2], world_of().up_m(bodies.place_m[:, :2]))


def test_bodies_keep_their_numbers_and_vehicles_their_targets() -> None:
    found = moments(busy(), 60)
    first, last = found[0].bodies, found[-1].bodies
    assert np.array_equal(first.number, last.number)
    machines = first.kind != "person"
    assert np.array_equal(first.target[machines], last.target[machines])
    assert len(set(first.target[machines])) == machines.sum()
    assert not set(last.target[machines]) & set(last.target[~machines])
    assert np.array_equal(np.isfinite(first.plate[:, 0]), first.kind == "ugv")


def test_a_world_without_people_and_vehicles_goes_on() -> None:
    empty = scenario_of({"team": TeamParameters(ugvs=0)})
    last = moments(empty, 30)[-1]
    assert len(last.bodies) == 0
    assert last.reports == ()
    assert last.reported_lonlat_deg.shape == (0, 2)
    assert len(moments(scenario_of({}), 3)[-1].bodies) == 4


@pytest.mark.parametrize("rate_hz", [1.0, 7.0, 30.0])
def test_any_rate_of_frames_will_do(rate_hz: float) -> None:
    scenario = busy(clip=ClipParameters(rate_hz=rate_hz))
    found = moments(scenario, 20)
    assert found[-1].time_s == pytest.approx(20 / rate_hz)
    frames = sorted({r.frame for one in found for r in one.reports if not r.planned})
    assert np.allclose(np.diff(frames), rate_hz / scenario.gps.rate_hz)


def faulty(what: str, **more: object) -> list[Moment]:
    scenario = busy(
        fault=(Fault.model_validate({"what": what, "time_s": 2.0, "seconds": 1.5, "vehicle": 2} | more),),
        team=TeamParameters(patrol="along", ugvs=4),
        gps=GpsParameters(),
    )
    return moments(scenario, 60)


def events_of(found: list[Moment]) -> dict[float, str]:
    about_crowds = ("split", "scatter", "walk", "one,")
    return {one.time_s: said for one in found for said in one.events if not any(word in said for word in about_crowds)}


@pytest.mark.parametrize(
    ("what", "begins", "ends"),
    [
        ("ugv_lost", "ugv2 is lost", "ugv2 is back"),
        ("gps_dropout", "ugv2 has no GPS", "ugv2 has GPS again"),
        ("gps_jump", "the GPS of ugv2 is off by 10 m", "the GPS of ugv2 is as before"),
        ("frozen", "the UAV's camera repeats a picture", "the UAV's camera sees again"),
        ("dropped", "pictures of the UAV are missing", "the UAV's pictures come again"),
        ("gust", "a gust pushes the UAV with 10 m/s", "the gust is over"),
        ("landmark_hidden", "the marker of ugv2 is covered", "the marker of ugv2 is seen again"),
        ("telemetry_silent", "the UAV says nothing of itself", "the UAV reports again"),
    ],
)
def test_a_fault_begins_and_ends_with_words(what: str, begins: str, ends: str) -> None:
    assert events_of(faulty(what)) == {2.0: begins, 3.5: ends}


def within(one: Moment) -> bool:
    return 2.0 - 1e-6 <= one.time_s < 3.5 - 1e-6


def heard(one: Moment, planned: bool = False) -> set[int]:
    return {r.vehicle for r in one.reports if r.planned == planned}


def test_a_lost_vehicle_stands_still_and_is_silent_but_shows_its_plate() -> None:
    found = faulty("ugv_lost")
    lost = [one for one in found if within(one)]
    rows = [np.flatnonzero(one.bodies.kind == "ugv")[1] for one in lost]
    places = np.array([one.bodies.place_m[row] for one, row in zip(lost, rows, strict=True)])
    assert np.ptp(places, axis=0).max() == 0
    assert not any(1 in heard(one) for one in lost[:-1])
    assert all(np.isnan(one.reported_lonlat_deg[1]).all() and not one.bodies.hidden.any() for one in lost)
    after = found[-1].bodies.place_m[rows[0]]
    assert np.linalg.norm(after - places[0]) > 1.0
    assert 1 in heard(found[-1])


def test_a_dropout_silences_the_receiver_but_not_the_plans() -> None:
    found = faulty("gps_dropout")
    assert all((1 in heard(one)) != within(one) for one in found)
    assert all(0 in heard(one) for one in found)
    assert any(1 in heard(one, planned=True) for one in found if within(one))


def test_a_jump_moves_what_is_said_by_its_size() -> None:
    origin = busy().world.origin_deg
    for one in faulty("gps_jump"):
        true = one.bodies.place_m[one.bodies.kind == "ugv", :2]
        off = np.linalg.norm(geometry.east_north(one.reported_lonlat_deg, origin) - true, axis=1)
        assert off[1] == pytest.approx(10.0 if within(one) else 0.0, abs=1e-4)
        assert off[[0, 2, 3]] == pytest.approx(0.0, abs=1e-4)


@pytest.mark.slow
def test_pictures_markers_and_telemetry_fail_while_the_fault_lasts() -> None:
    assert all((one.picture == "frozen") == within(one) for one in faulty("frozen"))
    assert all((one.picture == "dropped") == within(one) for one in faulty("dropped"))
    assert all((one.flight is None) == within(one) for one in faulty("telemetry_silent"))
    for one in faulty("landmark_hidden"):
        assert one.bodies.hidden.tolist() == ((one.bodies.number == one.bodies.number[-3]) & within(one)).tolist()


def test_a_gust_pushes_the_uav_about_as_fast_as_it_is() -> None:
    def fastest(found: list[Moment]) -> float:
        return max(float(np.linalg.norm(one.velocity_m_s[:2])) for one in found if within(one))

    assert fastest(faulty("gust", size=10.0)) == pytest.approx(10.0, rel=0.4)
    assert fastest(faulty("gust", size=0.0)) < 4.0


def test_orders_in_degrees_reach_the_vehicles_and_hold() -> None:
    scenario = busy(crowd=(), car=(), happening=())
    agents = Agents(scenario, world_of(trees=0))
    goal, seen = np.array([18.0, -12.0]), np.array([18.0, 40.0])
    goal_deg, seen_deg = geometry.lonlat(np.stack([goal, seen]), scenario.world.origin_deg)
    agents.step()
    agents.moment()
    agents.steer(Command(orders=(Order("ugv3", goal_deg, 3.0, seen_deg),)))
    run(agents, 50)
    agents.steer(Command())
    run(agents, 200)
    found = agents.moment()
    row = np.flatnonzero(found.bodies.kind == "ugv")[2]
    assert found.bodies.place_m[row, :2] == pytest.approx(goal, abs=0.5)
    bearing = np.arctan2(*(seen - found.bodies.place_m[row, :2]))
    assert np.cos(found.heading_rad[2] - bearing) > np.cos(0.01)
