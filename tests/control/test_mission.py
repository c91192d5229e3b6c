"""The loop about the whole path, in a world of a few seconds: what is found goes out, what is reported comes in."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests.lab.simulation.small import small
from torchvision_dddas.config import load_config
from torchvision_dddas.control import StartedSource
from torchvision_dddas.geometry import east_north, lonlat
from torchvision_dddas.lab.simulation import SimulatorSource, scenario_settings
from torchvision_dddas.pipeline import Pipeline, assemble_mission

FAULTS = (
    {"what": "frozen", "time_s": 2.0, "seconds": 0.5},
    {"what": "dropped", "time_s": 3.2, "seconds": 0.3},
    {"what": "ugv_lost", "time_s": 0.5, "seconds": 9.0, "vehicle": 2},
)


OFTEN = ("steering.picture_s=0.5", "steering.sampling=false")


def world(seconds=6.0, **tables):
    """Five pictures a second of a crowd and four ground vehicles with cameras that can tell people."""
    clip = {"seconds": seconds, "rate_hz": 5.0, **tables.pop("clip", {})}
    team = {"width_px": 320, "height_px": 240, **tables.pop("team", {})}
    return small(clip=clip, team=team, uav={"altitude_m": 25.0}, **tables)


def fly(overrides=(), seconds=6.0, **tables):
    """Fly a small scenario in the closed loop: its results, commands, notices and the ground vehicles' true places."""
    scenario = world(seconds, **tables)
    simulated = SimulatorSource(scenario)
    flown = SimpleNamespace(source=simulated, results=[], steered=[], noticed=[], places={})
    steer = simulated.steer

    def record(command):
        flown.steered.append(command)
        steer(command)

    simulated.steer = record  # type: ignore[method-assign]
    source, settings = StartedSource(simulated), load_config(None, [*overrides], base=scenario_settings(scenario))
    ready = assemble_mission(source, settings, "onboard", scenario.clip.located_by == "landmarks")
    flown.mission = ready.mission
    for result in Pipeline.from_assembly(ready)(source):
        flown.results.append(result)
        flown.noticed += [(notice.frame, notice.text) for notice in flown.mission.notices()]
        flown.places |= own_places(simulated)
    return flown


def own_places(source):
    return {truth.frame: truth.bodies.place_m[truth.bodies.kind == "ugv"] for truth in source.truths()}


@pytest.fixture(scope="module")
def flown():
    return fly(OFTEN, fault=FAULTS)


def test_what_is_found_reaches_the_source_as_commands(flown):
    commands = [result.command for result in flown.results]
    # One comes before there is anything to be found: how often to look.
    assert all(one is other for one, other in zip(flown.steered[1:], commands, strict=True))
    assert {order.vehicle for order in commands[-1].orders} <= {"ugv1", "ugv2", "ugv3", "ugv4"}
    # Degrees near the world's origin, not metres.
    assert np.abs(np.asarray(commands[-1].look_at) - flown.source.origin_deg).max() < 0.001


@pytest.mark.slow
def test_commands_move_the_ground_vehicles(flown):
    alone = SimulatorSource(world(fault=FAULTS))
    planned = {frame: place for _ in alone for frame, place in own_places(alone).items()}
    assert np.abs(planned[2] - flown.places[2]).max() < 1e-9
    assert np.abs(planned[30] - flown.places[30]).max() > 0.3


def test_reports_are_taken_as_they_come_and_targets_are_judged_by_what_ground_vehicles_saw(flown):
    site = flown.mission.watch.locator.site
    assert site.landmarks.frame[~site.landmarks.planned].max() == 30 and not site.landmarks.geographic
    assert site.telemetry.time_s[-1] == pytest.approx(5.8)
    assert any(by for result in flown.results for by in result.confirmed.seen_by)
    # The crowd walks eastward about the middle: what is found of it is near.
    places = np.concatenate([r.locations.positions.east_north_m for r in flown.results if r.locations is not None])
    here = east_north(lonlat(places, site.origin_deg), flown.source.origin_deg)
    assert len(places) > 20 and np.median(np.linalg.norm(here - (-1.0, 0.0), axis=1)) < 3.0


def test_crowds_are_where_ground_vehicles_see_their_people_and_steer_only_where_the_air_locates_nothing(flown):
    origin, seen = flown.mission.watch.locator.site.origin_deg, 0
    for result in flown.results:
        crowds, located = result.crowds, result.locations
        assert not np.isin(crowds.target[crowds.steers], located.positions.target).any()
        for place in east_north(lonlat(crowds.east_north_m, origin), flown.source.origin_deg):
            assert np.linalg.norm(place - (located.time_s - 3.0, 0.0)) < 3.5  # where the crowd walks, 3 m wide
            seen += 1
    assert seen


def test_what_goes_wrong_is_noticed_and_dropped_frames_are_scenes_without_targets(flown):
    said = {frame: text for frame, text in flown.noticed if "camera" in text}
    # Frames 11 to 13 show frame 10 again; reports of the lost vehicle end at frame 3.
    assert "frozen" in said[11]
    assert said[14] == "the camera works again: 3 pictures repeated the one before"
    (silent,) = [text for _, text in flown.noticed if "ugv2" in text]
    assert silent.startswith("ugv2 reports no position for 2.")
    lost = [r.tracked for r in flown.results if "could not be read" in r.tracked.cause]
    assert [f.number for f in lost] == [17, 18]


@pytest.mark.slow
def test_frames_left_out_on_purpose_leave_no_empty_scenes():
    flown = fly(("steering.sampling=true", "steering.sampling_share=2.0"), 3.0, clip={"rate_hz": 10.0})
    numbers = [r.tracked.number for r in flown.results]
    assert numbers[0] == 1 and max(np.diff(numbers)) > 1 and len(numbers) < 25
    assert not [r.tracked.cause for r in flown.results if "could not be read" in r.tracked.cause]
    assert numbers == sorted(flown.places)


@pytest.mark.slow
def test_without_ground_vehicles_telemetry_places_the_pictures_on_the_ground():
    flown = fly((), 1.0, team={"ugvs": 0}, clip={"located_by": "telemetry"})
    assert {r.locations.fix.by for r in flown.results if r.locations is not None} == {"telemetry"}
    assert flown.mission.watch.locator.site.origin_deg == flown.source.origin_deg
