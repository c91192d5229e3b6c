"""The safety rules of commanding: each rule by itself, and together for any sequence of inputs."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import lonlat
from torchvision_dddas.live.command_safety import (
    ACK_S,
    APART_M,
    DECISION_S,
    DRY_RUN,
    EVERY_S,
    LINK_S,
    MOST_MISSES,
    NUMBERS,
    POSITION_S,
    TOO_SOON,
    UNANSWERED,
    CommandSafety,
    Fence,
    Kind,
    Limits,
    Proposal,
    parse_band,
    read_fence,
)

HOME = (-110.95, 31.6)
RADIUS_M, BAND = 100.0, (30.0, 120.0)
COPTER, GUIDED, LOITER = (2, 3), 4, 5


def at(east: float, north: float) -> tuple[float, float]:
    longitude, latitude = lonlat(np.array([[east, north]], float), HOME)[0].tolist()
    return longitude, latitude


def fence() -> Fence:
    return Fence(circle=(*HOME, RADIUS_M))


class Flight:
    """A vehicle that reports, and the safety rules that hear it."""

    def __init__(self, allow: bool = True, system: int = 0) -> None:
        self.safety = CommandSafety(Limits(allow, fence(), BAND, system))
        self.now_s, self.time_ms = 1000.0, 0
        self._ticked_s = self.now_s

    def beat(self, mode: int = GUIDED, guided: bool = True, armed: bool = True, system: int = 1, kind=COPTER) -> None:
        self.safety.hear_vehicle(self.now_s, system, kind, mode, guided, armed)

    def place(self, east: float = 0.0, north: float = 0.0, up: float = 50.0, system: int = 1) -> None:
        self.tick()
        self.safety.hear_position(self.now_s, system, self.time_ms, at(east, north), up)

    def tick(self) -> None:
        """Move the vehicle's clock to now, at least by a tenth of a second."""
        self.time_ms += max(100, round(1000 * (self.now_s - self._ticked_s)))
        self._ticked_s = self.now_s

    def fly(self, seconds: float = 2.0) -> None:
        """Go on reporting once a second."""
        end_s = self.now_s + seconds
        while self.now_s < end_s - 1e-9:
            self.now_s += 1.0
            self.beat()
            self.place()

    def ask(self, kind: Kind = "reposition", east: float = 10.0, north: float = 0.0, up: float = 60.0) -> str:
        return self.safety.permit(Proposal(kind, at(east, north), self.now_s, up), self.now_s)

    def answer(self, kind: Kind = "reposition", result: int = 0) -> str:
        return self.safety.hear_answer(self.now_s, NUMBERS[kind], result)


@pytest.fixture
def flight() -> Flight:
    it = Flight()
    it.fly()
    return it


def test_a_vehicle_that_was_handed_over_is_commanded(flight: Flight) -> None:
    assert flight.ask() == ""
    assert flight.answer() == ""
    assert flight.ask("roi") == ""


def test_without_permission_all_rules_hold_and_nothing_leaves() -> None:
    flight = Flight(allow=False)
    flight.fly()
    assert flight.ask() == DRY_RUN
    assert flight.ask(east=500.0) == "the way leads outside the geofence"
    flight.beat(mode=LOITER, guided=False)
    assert flight.ask() == "the pilot changed the mode from 4 to 5"


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ({"east": 101.0}, "the way leads outside the geofence"),
        ({"up": 29.9}, "the goal is outside the altitude band"),
        ({"up": 120.1}, "the goal is outside the altitude band"),
        ({"up": math.nan}, "the goal is outside the altitude band"),
        ({"east": math.nan}, "the place is unknown"),
    ],
)
def test_a_goal_beyond_the_limits_is_refused_and_the_next_good_one_is_not(flight: Flight, how, reason: str) -> None:
    assert flight.ask(**how) == reason
    assert flight.ask() == ""


@pytest.mark.parametrize(
    ("where", "reason"),
    [
        ({"east": 150.0}, "the vehicle is outside the geofence"),
        ({"up": 5.0}, "the vehicle is outside the altitude band"),
    ],
)
def test_nothing_leaves_while_the_vehicle_is_beyond_the_limits(flight: Flight, where, reason: str) -> None:
    flight.place(**where)
    assert flight.ask() == reason
    assert flight.ask("roi") == reason
    flight.place()
    assert flight.ask() == ""


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ({"mode": LOITER, "guided": False}, "the vehicle is not armed in guided mode"),
        ({"armed": False}, "the vehicle is not armed in guided mode"),
    ],
)
def test_a_vehicle_that_was_not_handed_over_is_waited_for(how, reason: str) -> None:
    flight = Flight()
    flight.beat(**how)
    flight.place()
    flight.now_s += 100.0  # silence before the vehicle is handed over ends nothing
    flight.beat(**how)
    flight.place()
    assert flight.ask() == reason
    flight.fly()
    assert flight.ask() == ""


def test_two_vehicles_with_the_same_number_end_commanding_by_their_clocks(flight: Flight) -> None:
    other = Flight()
    other.safety, other.now_s, flight.time_ms = flight.safety, flight.now_s, 600_000
    flight.place()
    other.place(east=5.0)
    assert flight.safety.ended.startswith("the clock of system 1 runs back")


def test_positions_that_were_swapped_on_the_way_end_nothing(flight: Flight) -> None:
    flight.place()
    flight.time_ms -= 200
    flight.place()
    assert flight.ask() == ""


def test_no_vehicle_and_no_position_permit_nothing() -> None:
    flight = Flight()
    assert flight.ask() == "no vehicle is heard"
    flight.beat()
    assert flight.ask() == "the vehicle reports no position"
    flight.safety.hear_position(flight.now_s, 1, 5, (0.0, 0.0), 50.0)  # what a receiver without a fix reports
    assert flight.ask() == "the vehicle reports no position"


ENDINGS = {
    "mode": (lambda f: f.beat(mode=LOITER, guided=False), "the pilot changed the mode from 4 to 5"),
    "mode that is guided too": (lambda f: f.beat(mode=9), "the pilot changed the mode from 4 to 9"),
    "disarmed": (lambda f: f.beat(armed=False), "the vehicle was disarmed"),
    "other vehicle": (lambda f: f.beat(kind=(1, 3)), "another vehicle reports as system 1"),
    "second vehicle": (lambda f: f.beat(system=2), "two vehicles, 1 and 2, are heard; give ?system=N"),
    "station steers": (lambda f: f.safety.hear_station(f.now_s, 255, True), "system 255 steers the vehicle"),
    "two stations": (
        lambda f: [f.safety.hear_station(f.now_s, system, False) for system in (255, 254)],
        "several stations command: 254, 255",
    ),
}


@pytest.mark.parametrize("name", ENDINGS)
def test_an_ending_condition_ends_commanding_for_good(flight: Flight, name: str) -> None:
    happen, reason = ENDINGS[name]
    assert flight.ask() == ""
    flight.answer()
    happen(flight)
    assert flight.safety.ended == reason
    flight.fly(20.0)  # all is well again, but only a new run commands again
    assert flight.ask() == reason
    assert flight.ask("roi") == reason


def test_silence_ends_commanding_at_once(flight: Flight) -> None:
    flight.now_s += LINK_S + 0.1
    assert flight.ask() == "the link is lost: no heartbeat of system 1 for 3 s"
    flight.fly()
    assert flight.ask() == "the link is lost: no heartbeat of system 1 for 3 s"


def test_a_gap_between_heartbeats_ends_commanding_even_if_nothing_was_asked(flight: Flight) -> None:
    flight.now_s += LINK_S + 0.1
    flight.beat()
    assert flight.safety.ended == "the link is lost: no heartbeat of system 1 for 3 s"


def test_a_position_that_stands_still_in_time_is_stale(flight: Flight) -> None:
    for _ in range(25):
        flight.now_s += 0.1
        flight.beat()
        flight.safety.hear_position(flight.now_s, 1, flight.time_ms, at(0, 0), 50.0)  # the same report again
    assert flight.safety.ended == "the position of system 1 is older than 2 s"


def test_positions_that_come_later_and_later_end_commanding() -> None:
    flight = Flight()
    flight.fly()
    assert flight.ask() == ""
    for _ in range(30):  # the link takes half of what the vehicle sends
        flight.now_s += 0.5
        flight.beat()
        flight.time_ms += 250
        flight.safety.hear_position(flight.now_s, 1, flight.time_ms, at(0, 0), 50.0)
    assert flight.safety.ended == "the position of system 1 is older than 2 s"


def test_a_given_system_is_the_only_one_that_counts() -> None:
    flight = Flight(system=7)
    flight.fly()
    assert flight.ask() == "system 7 is not heard, but 1 is"
    flight.beat(system=7)
    flight.place(system=7)
    assert flight.ask() == ""
    flight.beat(system=1, mode=LOITER, guided=False)
    assert flight.safety.ended == ""


def test_a_single_station_may_choose_targets(flight: Flight) -> None:
    for _ in range(3):
        flight.safety.hear_station(flight.now_s, 255, False)
    assert flight.ask() == ""


def test_a_station_may_steer_before_the_vehicle_is_handed_over() -> None:
    flight = Flight()
    flight.beat(mode=LOITER, guided=False)
    flight.safety.hear_station(flight.now_s, 255, True)  # for example the change to guided mode itself
    flight.fly()
    assert flight.ask() == ""


def test_commands_of_a_kind_keep_their_distance_and_wait_for_the_answer(flight: Flight) -> None:
    assert flight.ask() == ""
    assert flight.ask() == TOO_SOON
    flight.fly(1.0)
    assert flight.ask() == UNANSWERED
    assert flight.ask("roi") == ""
    flight.answer()
    assert flight.ask() == ""


def test_three_commands_without_an_answer_end_commanding(flight: Flight) -> None:
    for _ in range(MOST_MISSES):
        assert flight.ask() == ""
        flight.fly(2.0)
    assert flight.safety.ended == "the vehicle did not acknowledge 3 commands within 1.5 s each"


def test_an_answer_forgives_earlier_silence(flight: Flight) -> None:
    for _ in range(4):
        assert flight.ask() == ""
        flight.fly(2.0)
        assert flight.ask() == ""
        flight.answer()
        flight.fly(1.0)
    assert flight.safety.ended == ""


def test_an_unsupported_kind_is_not_sent_again_and_others_are(flight: Flight) -> None:
    assert flight.ask("roi") == ""
    assert flight.answer("roi", 3) == "the vehicle refuses roi, MAV_RESULT 3; not sent again"
    flight.fly(2.0)
    assert flight.ask("roi") == "the vehicle does not take roi"
    assert flight.ask() == ""


def test_a_kind_that_is_refused_three_times_is_not_sent_again(flight: Flight) -> None:
    for time in range(3):
        assert flight.ask() == ""
        words = flight.answer(result=2)
        assert words.endswith("not sent again") == (time == 2)
        flight.fly(2.0)
    assert flight.ask() == "the vehicle does not take reposition"


def test_answers_to_commands_of_others_are_ignored(flight: Flight) -> None:
    assert flight.safety.hear_answer(flight.now_s, 400, 4) == ""
    assert flight.answer(result=4) == ""
    assert flight.ask() == ""


def test_an_old_decision_does_not_leave(flight: Flight) -> None:
    old = Proposal("reposition", at(1, 1), flight.now_s - DECISION_S - 0.1, 60.0)
    assert flight.safety.permit(old, flight.now_s) == "the decision is older than 3 s"


def test_pictures_from_elsewhere_end_commanding(flight: Flight) -> None:
    near = Proposal("roi", at(1, 1), flight.now_s, camera_deg=at(0, APART_M - 10))
    assert flight.safety.permit(near, flight.now_s) == ""
    far = Proposal("reposition", at(1, 1), flight.now_s, 60.0, at(0, APART_M + 10))
    assert flight.safety.permit(far, flight.now_s) == "the pictures are taken more than 200 m away from system 1"
    assert flight.ask() == flight.safety.ended


def test_a_camera_whose_place_is_unknown_permits_nothing(flight: Flight) -> None:
    unknown = Proposal("roi", at(1, 1), flight.now_s, camera_deg=(math.nan, math.nan))
    assert flight.safety.permit(unknown, flight.now_s) == "the place of the camera is unknown"
    assert not flight.safety.ended


def test_only_four_commands_exist_and_none_arms_or_changes_the_mode() -> None:
    assert sorted(NUMBERS.values()) == [192, 195, 1000, 1001]


def test_limits_that_are_not_given_permit_a_dry_run_alone() -> None:
    for limits in (Limits(True, None, BAND), Limits(True, fence(), None)):
        flight = Flight()
        flight.safety = CommandSafety(limits)
        flight.fly()
        assert flight.ask() == "no geofence or no altitude band is given"
        flight.safety = CommandSafety(replace(limits, allow=False))
        flight.fly()
        assert flight.ask() == DRY_RUN


# --------------------------------------------------------------------------------------------------------------------
# Any sequence of inputs.

SPANS = st.sampled_from([0.0, 0.05, 0.4, 0.9, 1.1, 1.6, 2.1, 3.5])
PLACES = st.tuples(st.sampled_from([0.0, 40.0, 99.0, 101.0, 300.0]), st.sampled_from([0.0, 60.0]))
HEIGHTS = st.sampled_from([5.0, 30.0, 50.0, 119.0, 121.0, math.nan])
SYSTEMS = st.sampled_from([1, 1, 1, 1, 2])
HONEST = st.sampled_from([True, True, True, True, True, False])
KINDS = st.sampled_from(list(NUMBERS))
CAMERAS = st.sampled_from([0.0, 0.0, 0.0, 0.0, math.nan, 900.0])
INPUTS = st.one_of(
    st.tuples(st.just("beat"), HONEST, HONEST, SYSTEMS),
    st.tuples(st.just("place"), PLACES, HEIGHTS, SYSTEMS, HONEST),
    st.tuples(st.just("station"), st.sampled_from([254, 255, 255, 255]), HONEST),
    st.tuples(st.just("answer"), KINDS, st.sampled_from([0, 0, 0, 2, 3, 5])),
    st.tuples(st.just("ask"), KINDS, PLACES, HEIGHTS, st.sampled_from([0.0, 0.0, 1.0, 4.0]), CAMERAS),
    st.tuples(st.just("report")),
    st.tuples(st.just("report")),
)


@dataclass
class Oracle:
    """What must hold, written down apart from the code: facts in order of time, looked at when a command leaves."""

    is_over: bool = False
    handed_over: bool = False
    beat_s: float = -math.inf
    placed_s: float = -math.inf
    place_m: tuple[float, float] = (math.nan, math.nan)
    up_m: float = math.nan
    stations: set[int] = field(default_factory=set)
    sent: list[tuple[float, str]] = field(default_factory=list)

    def pass_to(self, now_s: float) -> None:
        late = now_s - self.beat_s > LINK_S or (math.isfinite(self.placed_s) and now_s - self.placed_s > POSITION_S)
        self.is_over |= self.handed_over and late


def away(place_m: tuple[float, float]) -> float:
    return math.hypot(*place_m)


SEQUENCES = {
    "steps": st.lists(st.tuples(SPANS, INPUTS), max_size=60),
    "allow": HONEST,
    "given_system": st.sampled_from([0, 1]),
}


@settings(max_examples=80, deadline=None)
@given(**SEQUENCES)
def test_whatever_happens_nothing_leaves_against_a_rule(steps, allow: bool, given_system: int) -> None:
    play(steps, allow, given_system)


@pytest.mark.slow
@settings(max_examples=1000, deadline=None)
@given(**SEQUENCES)
def test_whatever_happens_for_long_nothing_leaves_against_a_rule(steps, allow: bool, given_system: int) -> None:
    play(steps, allow, given_system)


def play(steps, allow: bool, given_system: int) -> Oracle:
    """Play a sequence, and check each command that leaves against the oracle."""
    flight, oracle = Flight(allow, given_system), Oracle()
    for span_s, (what, *how) in [(0.0, ("report",)), (0.5, ("report",)), *steps]:
        flight.now_s += span_s
        now_s = flight.now_s
        oracle.pass_to(now_s)
        if what in ("beat", "report"):
            guided, armed, system = how or (True, True, 1)
            flight.beat(GUIDED if guided else LOITER, guided, armed, system)
            if system == 1:
                oracle.is_over |= oracle.handed_over and not (guided and armed)
                oracle.handed_over |= guided and armed
                oracle.beat_s = now_s
            elif not given_system:
                oracle.is_over = True
        if what in ("place", "report"):
            place_m, up, system, is_new = how or ((0.0, 0.0), 50.0, 1, True)
            if is_new:
                flight.tick()
            flight.safety.hear_position(now_s, system, flight.time_ms, at(*place_m), up)
            if system == 1 and math.isfinite(up) and is_new:
                oracle.place_m, oracle.up_m, oracle.placed_s = place_m, up, now_s
        elif what == "station":
            flight.safety.hear_station(now_s, *how)
            oracle.stations.add(how[0])
            oracle.is_over |= len(oracle.stations) > 1 or (how[1] and oracle.handed_over)
        elif what == "answer":
            flight.answer(*how)
        elif what == "ask":
            kind, place_m, up, age_s, camera_m = how
            proposal = Proposal(kind, at(*place_m), now_s - age_s, up, at(0.0, camera_m))
            reason = flight.safety.permit(proposal, now_s)
            if reason:
                continue
            assert allow
            assert oracle.handed_over and not oracle.is_over and not flight.safety.ended
            assert now_s - oracle.beat_s <= LINK_S and now_s - oracle.placed_s <= POSITION_S
            assert away(oracle.place_m) <= RADIUS_M and BAND[0] <= oracle.up_m <= BAND[1]
            assert age_s <= DECISION_S and camera_m != 900.0
            if kind == "reposition":
                assert away(place_m) <= RADIUS_M and BAND[0] <= up <= BAND[1]
            assert all(now_s - sent_s >= EVERY_S[kind] for sent_s, other in oracle.sent if other == kind)
            oracle.sent.append((now_s, kind))
        flight.safety.check(now_s)
        assert flight.safety.ended or not oracle.is_over
    return oracle


def test_the_sequences_above_let_commands_leave() -> None:
    good = [
        (0.9, ("report",)),
        (0.4, ("ask", "reposition", (40.0, 0.0), 50.0, 0.0, 0.0)),
        (0.0, ("answer", "reposition", 0)),
    ]
    assert len(play(good * 10, True, 0).sent) == 10
    ended = [*good, (0.0, ("beat", False, True, 1)), *good * 10]
    assert len(play(ended, True, 0).sent) == 1


# --------------------------------------------------------------------------------------------------------------------
# The limits as an operator gives them.


def test_a_circle_holds_what_is_nearer_than_its_radius() -> None:
    circle = fence()
    assert circle.holds(at(0, 0), at(99, 0))
    assert not circle.holds(at(0, 0), at(0, 101))
    assert not circle.holds(at(101, 0), at(0, 0))


def test_a_way_around_a_corner_of_a_polygon_is_refused(tmp_path: Path) -> None:
    hook = [at(0, 0), at(100, 0), at(100, 100), at(80, 100), at(80, 20), at(20, 20), at(20, 100), at(0, 100)]
    path = tmp_path / "fence.geojson"
    ring = ",".join(f"[{x!r},{y!r}]" for x, y in [*hook, hook[0]])
    path.write_text(f'{{"type": "Polygon", "coordinates": [[{ring}]]}}')
    found = read_fence(str(path))
    assert found.holds(at(10, 90), at(10, 10))
    assert found.holds(at(10, 10), at(90, 10))
    assert not found.holds(at(10, 90), at(90, 90))
    assert not found.holds(at(50, 50), at(10, 10))


def test_a_hole_in_a_polygon_is_outside() -> None:
    outer = np.array([at(-100, -100), at(100, -100), at(100, 100), at(-100, 100)])
    hole = np.array([at(-10, -10), at(10, -10), at(10, 10), at(-10, 10)])
    found = Fence([[outer, hole]])
    assert not found.holds(at(0, 0), at(0, 0))
    assert not found.holds(at(-50, 0), at(50, 0))
    assert found.holds(at(-50, 50), at(50, 50))


@pytest.mark.parametrize("text", ["1,2,0.1", "1,200,50", "181,0,50", "nan,0,50"])
def test_a_circle_beyond_the_earth_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"--geofence .* wanted longitude,latitude in degrees and a radius"):
        read_fence(text)


def test_a_fence_without_an_area_in_degrees_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "line.geojson"
    path.write_text('{"type": "LineString", "coordinates": [[0, 0], [1, 1]]}')
    with pytest.raises(InputError, match=r"wanted polygons in longitude and latitude"):
        read_fence(str(path))
    path.write_text('{"type": "Polygon", "unit": "m", "coordinates": [[[0, 0], [9, 0], [9, 9], [0, 0]]]}')
    with pytest.raises(InputError, match=r"wanted polygons in longitude and latitude"):
        read_fence(str(path))


def test_a_band_has_two_heights_in_order() -> None:
    assert parse_band("30,120") == (30.0, 120.0)
    for text in ("30", "120,30", "30,30", "a,b", "30,nan", "-1000,20", "1,2,3"):
        with pytest.raises(InputError, match=r"wanted LOWEST,HIGHEST in metres above home"):
            parse_band(text)


def test_acknowledgements_are_waited_for_longer_than_the_shortest_distance_of_commands() -> None:
    assert max(EVERY_S["reposition"], EVERY_S["roi"]) < ACK_S
