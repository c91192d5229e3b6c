"""A scenario that runs: reproducible, steered, and true to its faults."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.simulation.small import small
from torchvision_dddas.errors import InputError
from torchvision_dddas.simulation import Simulator, build_world
from torchvision_dddas.types import Command, Elevation, Order


def shots(simulator, commands=None):
    """All of a run; commands: given after the shot of a frame."""
    simulator.restart()
    found = []
    while (shot := simulator.next()) is not None:
        found.append(shot)
        if commands and shot.truth.frame in commands:
            simulator.steer(commands[shot.truth.frame])
    return found


@cache
def plain():
    simulator = Simulator(small())
    return simulator, tuple(shots(simulator))


def test_another_seed_is_another_run():
    other = Simulator(small(seed=4))
    shot = other.next()
    assert shot is not None
    assert shot.frame is not None
    assert np.abs(shot.frame.image.astype(int) - plain()[1][0].frame.image).mean() > 2


def test_frames_that_are_left_out_change_nothing_in_those_that_are_not():
    simulator, run = plain()
    sparse = shots(simulator, {1: Command(every=4)})
    assert [shot.frame.number for shot in sparse] == [1, 5, 9, 13, 17]
    assert [shot.frame.skipped for shot in sparse] == [0, 3, 3, 3, 3]
    for shot in sparse:
        same = run[shot.frame.number - 1]
        np.testing.assert_array_equal(shot.frame.image, same.frame.image)
        np.testing.assert_allclose(shot.truth.bodies.place_m, same.truth.bodies.place_m)


def test_an_order_moves_the_vehicle_that_it_names():
    simulator, run = plain()
    first = run[0].moments[-1]
    goal = first.reported_lonlat_deg[0] + (0.0, 5e-4)
    far = shots(simulator, {1: Command(orders=(Order("ugv1", goal, 3.0),))})[-1].truth.bodies
    own = np.flatnonzero(far.kind == "ugv")[0]
    before = run[0].truth.bodies.place_m[own]
    assert far.place_m[own, 1] - before[1] > 1.0


def test_an_order_to_a_vehicle_that_is_not_there_is_refused():
    simulator, _ = plain()
    simulator.restart()
    with pytest.raises(InputError, match="no ground vehicle is named 'ugv9'; there are ugv1, ugv2, ugv3, ugv4"):
        simulator.steer(Command(orders=(Order("ugv9", np.zeros(2), 1.0),)))


def test_a_frozen_camera_repeats_its_picture_while_the_world_goes_on():
    run = shots(Simulator(small(fault=({"what": "frozen", "time_s": 0.5, "seconds": 0.45},))))
    for shot in run[5:9]:
        np.testing.assert_array_equal(shot.frame.image, run[4].frame.image)
    assert not np.array_equal(run[10].frame.image, run[4].frame.image)
    moved = run[8].truth.bodies.place_m - run[4].truth.bodies.place_m
    assert np.abs(moved[:, :2]).max() > 0.05


def test_dropped_frames_are_missing_and_their_truth_is_not():
    run = shots(Simulator(small(fault=({"what": "dropped", "time_s": 0.5, "seconds": 0.35},))))
    missing = [shot.truth.frame for shot in run if shot.frame is None]
    assert missing == [6, 7, 8, 9]
    assert [shot.truth.frame for shot in run] == list(range(1, 21))
    assert run[9].frame.skipped == 0


def test_looking_from_the_ground_changes_nothing_in_the_air():
    simulator, run = plain()
    simulator.restart()
    for shot in run[:3]:
        simulator.picture("ugv1")
        np.testing.assert_array_equal(simulator.next().frame.image, shot.frame.image)


@pytest.fixture
def tall(monkeypatch):
    """A world where 12 m stand at [5, 0], told to the simulator in place of the one that it would build."""
    name = "torchvision_dddas.simulation.simulator.build_world"

    def raised(*args):
        world = build_world(*args)
        surface = world.surface.copy()
        row, column = (int(v / world.surface_texel_m) for v in (30.0, 35.0))
        surface[row - 2 : row + 3, column - 2 : column + 3] = 12.0
        return replace(world, surface=surface)

    monkeypatch.setattr(name, raised)


def test_a_way_below_what_stands_there_is_refused(tall):
    scenario = small(uav={"altitude_m": 12.5, "way_m": ((10.0, 0.0),)})
    with pytest.raises(InputError, match=r"uav.altitude_m = 12.5 is too low: 12.0 m stand at \[\d+, 0\]"):
        Simulator(scenario)
    Simulator(small(uav={"altitude_m": 13.5, "way_m": ((10.0, 0.0),)}))
    Simulator(small(uav={"altitude_m": 12.5, "way_m": ((-10.0, 0.0),)}))


def test_an_altitude_below_the_terrain_that_it_looks_over_is_refused():
    east = np.arange(-40, 41, 2.0)
    ridge = 20 * np.exp(-((east[None] / 4) ** 2)) * np.ones((len(east), 1))
    hills = Elevation(ridge - 20.0, (-40.0, -40.0), 2.0, 1300.0)
    aslant = {"altitude_m": 10.0, "pitch_deg": 45.0, "heading_deg": 90.0, "start_m": (5.0, 0.0)}
    with pytest.raises(InputError, match="altitude_m = 10 is below the terrain that it looks over"):
        Simulator(small(uav=aslant), elevation=hills)
    Simulator(small(uav={**aslant, "start_m": (-15.0, 0.0)}), elevation=hills)


def test_an_impossible_scenario_is_refused_without_a_file():
    with pytest.raises(InputError, match="must be 4 or more"):
        Simulator(small(team={"ugvs": 2}))
