"""How people move: with their crowd, apart from one another, at the speeds of the source."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from torchvision_dddas.simulation import CarPlan, CrowdPlan, Happening
from torchvision_dddas.simulation.crowds import FASTEST_M, SLOWEST_M, UNIT_S, Crowds
from torchvision_dddas.simulation.ground_vehicles import RADIUS_M, Cars
from torchvision_dddas.simulation.movement import Obstacles, near_pairs

NOBODY = np.zeros((0, 2))
NOTHING = np.zeros((0, 5))


def standing(*discs: tuple[float, float, float]) -> Any:
    places = np.array(discs, float).reshape(-1, 3)
    return SimpleNamespace(kind=("building",) * len(places), east_north_m=places[:, :2], radius_m=places[:, 2])


def people(*plans: CrowdPlan, happen: tuple[Happening, ...] = (), things: Any = None, seed: int = 1) -> Crowds:
    obstacles = Obstacles(standing() if things is None else things, 200.0)
    return Crowds(plans, happen, 200.0, obstacles, seed, 100)


def go(crowds: Crowds, seconds: float, start_s: float = 0.0) -> tuple[np.ndarray, list[str]]:
    """(T, N, 2) places, and what was said."""
    places, said = [crowds.place], []
    for step in range(round(seconds * 10)):
        said += crowds.step(start_s + (step + 1) / 10, 0.1, NOTHING)
        places.append(crowds.place)
    return np.array(places), said


def least_apart(place: np.ndarray) -> float:
    away = np.linalg.norm(place[:, None] - place, axis=2)
    return float(away[~np.eye(len(place), dtype=bool)].min())


def test_a_crowd_at_random_goes_as_fast_as_the_source_says() -> None:
    crowds = people(*(CrowdPlan(people=1, start_m=(0.0, y), behaviour="random") for y in range(-80, 81, 10)))
    middles = [crowds._groups.middle.copy()]
    for step in range(400):
        crowds.step((step + 1) / 10, 0.1, NOTHING)
        if (step + 1) % round(UNIT_S * 10) == 0:
            middles.append(crowds._groups.middle.copy())
    steps = np.abs(np.diff(middles, axis=0))
    # None had to wait or turn back: those are few.
    within = ((steps > SLOWEST_M - 1e-6) & (steps < FASTEST_M + 1e-6)).all(axis=2)
    assert within.mean() > 0.95
    assert steps[within].mean() == pytest.approx((SLOWEST_M + FASTEST_M) / 2, rel=0.05)


@pytest.mark.parametrize("speed_m_s", [0.8, 1.4, 3.0])
def test_walkers_walk_at_their_speed_and_with_their_heading(speed_m_s: float) -> None:
    places, _ = go(people(CrowdPlan(people=15, heading_deg=30.0, speed_m_s=speed_m_s)), 20)
    gone = (places[-1] - places[50]).mean(axis=0) / 15
    assert np.linalg.norm(gone) == pytest.approx(speed_m_s, rel=0.05)
    assert np.degrees(np.arctan2(*gone)) == pytest.approx(30.0, abs=3.0)


def test_members_stay_with_their_crowd_though_not_in_step() -> None:
    places, _ = go(people(CrowdPlan(people=20, radius_m=3.0, behaviour="random")), 60)
    about = places - places.mean(axis=1, keepdims=True)
    assert np.linalg.norm(about, axis=2).max() < 3.0 + 2.5
    assert np.std(about - about[0], axis=0).mean() > 0.1


def test_nobody_steps_on_another_even_where_many_stand() -> None:
    crowds = people(CrowdPlan(people=150, radius_m=1.0), CrowdPlan(people=60, start_m=(25.0, 0.0), heading_deg=270.0))
    places, _ = go(crowds, 20)
    assert min(least_apart(place) for place in places[::5]) > 0.35
    assert np.median([least_apart(place) for place in places[::5]]) > 0.48


def test_a_crowd_stands_until_its_time() -> None:
    places, _ = go(people(CrowdPlan(people=6, from_s=5.0)), 10)
    middle = places.mean(axis=1)
    assert np.linalg.norm(middle[49] - middle[0]) < 0.3
    assert np.linalg.norm(middle[-1] - middle[49]) == pytest.approx(1.4 * 5, rel=0.15)


def test_a_way_is_gone_there_and_back() -> None:
    places, _ = go(people(CrowdPlan(people=4, way_m=((0.0, 0.0), (14.0, 0.0), (14.0, 14.0)))), 42)
    middle = places.mean(axis=1)
    for corner in ((14.0, 0.0), (14.0, 14.0)):
        assert np.linalg.norm(middle - corner, axis=1).min() < 1.0
    assert np.linalg.norm(middle[350:] - (0.0, 0.0), axis=1).min() < 1.0


def test_crowds_turn_back_at_the_edge() -> None:
    places, _ = go(people(CrowdPlan(people=5, start_m=(80.0, 0.0), speed_m_s=2.0)), 30)
    assert places[..., 0].max() < 100.0 - 5.0
    assert places[-1, :, 0].mean() < 75.0


def test_a_crowd_walks_round_a_building() -> None:
    places, _ = go(people(CrowdPlan(people=12), things=standing((20.0, 0.0, 6.0))), 40)
    assert np.linalg.norm(places - (20.0, 0.0), axis=2).min() > 6.0
    assert places[-1, :, 0].min() > 30.0


def test_crowds_that_join_become_the_first_and_go_on_as_it() -> None:
    crowds = people(
        CrowdPlan(people=8, start_m=(-10.0, 0.0), heading_deg=0.0),
        CrowdPlan(people=5, start_m=(10.0, 0.0), behaviour="stand"),
        happen=(Happening(time_s=1.0, what="join", crowds=(1, 2)),),
    )
    assert set(crowds.target) == {1, 2}
    places, said = go(crowds, 30)
    assert said == ["crowds 1 and 2 walk to one another", "crowds 1 and 2 are one, crowd 1"]
    assert set(crowds.target) == {1}
    spread = np.linalg.norm(places[-1] - places[-1].mean(axis=0), axis=1)
    assert spread.max() < 5.0
    gone = places[-1].mean(axis=0) - places[-51].mean(axis=0)
    assert gone == pytest.approx((0.0, 7.0), abs=0.7)


def test_half_of_a_crowd_that_splits_gets_a_number_and_a_way_of_its_own() -> None:
    crowds = people(CrowdPlan(people=11, heading_deg=90.0), happen=(Happening(time_s=2.0, what="split", turn_deg=60),))
    _, said = go(crowds, 2)
    assert said == ["crowd 1 splits: 5 of 11 are now crowd 100"]
    places, _ = go(crowds, 15, 2.0)
    gone = places[-1] - places[50]
    for number, heading, many in ((1, 90.0, 6), (100, 150.0, 5)):
        mine = crowds.target == number
        assert mine.sum() == many
        assert np.degrees(np.arctan2(*gone[mine].mean(axis=0))) == pytest.approx(heading, abs=5.0)


def test_a_crowd_that_scatters_is_as_many_as_it_has_people_and_runs_apart() -> None:
    crowds = people(CrowdPlan(people=9, behaviour="stand"), happen=(Happening(time_s=1.0, what="scatter"),), seed=2)
    places, said = go(crowds, 6)
    assert said == ["the 9 of crowd 1 scatter"]
    assert sorted(crowds.target) == list(range(100, 109))
    speed = np.linalg.norm(places[-1] - places[-11], axis=1)
    assert (speed > 1.8).all()
    spread = np.linalg.norm(places - places.mean(axis=1, keepdims=True), axis=2).mean(axis=1)
    assert spread[-1] > 8 * spread[0]


def test_what_happens_to_crowds_that_are_no_more_harms_nobody() -> None:
    happen = (
        Happening(time_s=0.5, what="join", crowds=(1, 2)),
        Happening(time_s=1.0, what="scatter", crowds=(1, 2)),
        Happening(time_s=1.5, what="split", crowds=(1,)),
        Happening(time_s=2.0, what="join", crowds=(1, 2)),
    )
    crowds = people(CrowdPlan(people=3), CrowdPlan(people=1, start_m=(20.0, 0.0)), happen=happen)
    go(crowds, 5)
    assert len(set(crowds.target)) == 4


def test_legs_go_with_the_way_and_velocities_are_those_of_the_places() -> None:
    crowds = people(CrowdPlan(people=5, behaviour="walk"), CrowdPlan(people=5, start_m=(0, 30.0), behaviour="stand"))
    go(crowds, 5)
    before, phase = crowds.place, crowds.phase
    crowds.step(5.1, 0.1, NOTHING)
    assert crowds.velocity == pytest.approx((crowds.place - before) / 0.1)
    strides = (crowds.phase - phase) % 1.0
    assert strides[:5] == pytest.approx(0.1, rel=0.5)
    assert strides[5:].max() < 0.03


def test_people_make_way_for_vehicles() -> None:
    crowds = people(CrowdPlan(people=10, behaviour="stand", radius_m=2.0))
    for step in range(60):
        crowds.step(step / 10, 0.1, np.array([[0.0, 0.0, np.pi / 4, 2.0, 1.0]]))
    ahead = np.abs(crowds.place @ (np.sqrt(0.5), np.sqrt(0.5)))
    aside = np.abs(crowds.place @ (np.sqrt(0.5), -np.sqrt(0.5)))
    assert ((ahead > 2.0) | (aside > 1.0)).all()


@pytest.mark.parametrize("count", [0, 1, 2, 300])
def test_the_grid_finds_the_pairs_that_a_search_of_all_finds(count: int) -> None:
    place = np.random.default_rng(count).uniform(-6, 6, (count, 2))
    first, second = near_pairs(place, 0.9)
    found = {(min(a, b), max(a, b)) for a, b in zip(first.tolist(), second.tolist(), strict=True)}
    away = np.linalg.norm(place[:, None] - place, axis=2)
    assert found == {(int(a), int(b)) for a, b in zip(*np.nonzero(np.triu(away < 0.9, 1)), strict=True)}
    assert len(found) == len(first)


def drive(cars: Cars, seconds: float, others: np.ndarray = NOBODY) -> np.ndarray:
    places = [cars.place.copy()]
    for step in range(round(seconds * 10)):
        cars.step((step + 1) / 10, 0.1, others)
        places.append(cars.place.copy())
    return np.array(places)


def test_a_car_drives_its_way_and_turns_no_narrower_than_it_can() -> None:
    way = ((0.0, 0.0), (60.0, 0.0), (60.0, 50.0))
    places = drive(Cars((CarPlan(way_m=way),), 200.0, Obstacles(standing(), 200.0), 0), 60)[:, 0]
    for corner in way[1:]:
        assert np.linalg.norm(places - corner, axis=1).min() < RADIUS_M
    step = np.diff(places, axis=0)
    course, gone = np.unwrap(np.arctan2(step[:, 0], step[:, 1])), np.linalg.norm(step, axis=1)
    assert (np.abs(np.diff(course)) <= gone[1:] / RADIUS_M * 1.05 + 1e-6).all()
    assert gone.max() <= 0.6 + 1e-6


def test_a_car_runs_over_nobody_who_stands_in_its_way() -> None:
    cars = Cars((CarPlan(start_m=(-50.0, 0.0), speed_m_s=10.0),), 200.0, Obstacles(standing(), 200.0), 0)
    wall = np.stack([np.zeros(41), np.linspace(-20, 20, 41)], axis=1)
    places = drive(cars, 15, wall)[:, 0]
    assert np.linalg.norm(places[:, None] - wall, axis=2).min() > 2.0


def test_a_car_passes_one_who_stands_in_its_way() -> None:
    cars = Cars((CarPlan(start_m=(-50.0, 0.0), speed_m_s=8.0),), 200.0, Obstacles(standing(), 200.0), 0)
    places = drive(cars, 25, np.zeros((1, 2)))[:, 0]
    assert np.linalg.norm(places, axis=1).min() > 1.4
    assert places[:, 0].max() > 20.0
