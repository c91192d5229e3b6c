"""The team, its receivers and colours, and the UAV: where they go, and how true what they say is."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from torchvision_dddas.simulation import AircraftParameters, TeamParameters
from torchvision_dddas.simulation.cameras import view_from_pose
from torchvision_dddas.simulation.ground_vehicles import ACCELERATION_M_S2, TURN_RAD_S, Team, marker_plates
from torchvision_dddas.simulation.movement import Obstacles, Waypoints
from torchvision_dddas.simulation.sensors import Receivers
from torchvision_dddas.simulation.uav import Aircraft, ReportedPose, Swaying
from torchvision_dddas.types import Camera

NOBODY = np.zeros((0, 2))
CAMERA = Camera("air", (640, 480), (554.0, 554.0), (319.5, 239.5))


def level(places: np.ndarray) -> np.ndarray:
    return np.zeros(len(places))


def hilly(places: np.ndarray) -> np.ndarray:
    return np.asarray(3 * np.sin(places[:, 0] / 40) + 2 * np.cos(places[:, 1] / 30))


# --- receivers


def errors_of(receivers: Receivers, count: int, seconds: float) -> np.ndarray:
    found = []
    for _ in range(count):
        found.append(receivers.error_m)
        receivers.advance(seconds)
    return np.array(found)


def test_95_percent_of_places_are_within_the_radius_from_the_first_report_on() -> None:
    receivers = Receivers(4000, 3.5, 0.1, 60.0, 0.0, np.random.default_rng(0))
    found = np.linalg.norm(errors_of(receivers, 3, 30.0), axis=2)
    assert (found < 3.5).mean(axis=1) == pytest.approx(0.95, abs=0.012)
    assert receivers.sigma_m == pytest.approx(1.43, abs=0.005)


def test_errors_last_as_long_as_they_are_said_to_and_a_share_is_new() -> None:
    found = errors_of(Receivers(2000, 3.5, 0.2, 20.0, 0.0, np.random.default_rng(1)), 21, 1.0)[..., 0]

    def alike(lag: int) -> float:
        return float(np.mean([np.corrcoef(found[k], found[k + lag])[0, 1] for k in range(len(found) - lag)]))

    assert alike(1) == pytest.approx(0.8 * np.exp(-1 / 20), abs=0.02)
    assert alike(20) == pytest.approx(0.8 * np.exp(-1), abs=0.06)


# --- the team


def team_of(discs: tuple[tuple[float, float, float], ...] = (), seed: int = 4, **parameters: object) -> Team:
    places = np.array(discs, float).reshape(-1, 3)
    things: Any = SimpleNamespace(kind=("tree",) * len(places), east_north_m=places[:, :2], radius_m=places[:, 2])
    flight = AircraftParameters(way_m=((40.0, 0.0),), speed_m_s=1.5)
    return Team(TeamParameters.model_validate(parameters), flight, 200.0, Obstacles(things, 200.0), seed)


def drive(team: Team, seconds: float, people: np.ndarray = NOBODY) -> dict[str, np.ndarray]:
    found: dict[str, list[np.ndarray]] = {"place": [], "course": [], "speed": []}
    for step in range(round(seconds * 10)):
        team.step((step + 1) / 10, 0.1, (), people)
        for name, values in found.items():
            values.append(getattr(team, name).copy())
    return {name: np.array(values) for name, values in found.items()}


@pytest.mark.parametrize("patrol", ["random", "gather", "along"])
def test_vehicles_speed_up_and_turn_no_faster_than_they_can(patrol: str) -> None:
    found = drive(team_of(patrol=patrol, ugvs=6), 40)
    assert np.diff(found["speed"], axis=0).max() <= ACCELERATION_M_S2 * 0.1 + 1e-9
    turned = np.diff(np.unwrap(found["course"], axis=0), axis=0)
    assert np.abs(turned).max() <= TURN_RAD_S * 0.1 + 1e-9
    assert found["speed"].max() > 0.5


def test_each_patrol_goes_where_it_is_said_to() -> None:
    stood = drive(team_of(patrol="stand"), 10)["place"]
    assert np.ptp(stood, axis=0).max() < 0.1
    around = drive(team_of(patrol="random", ring_m=14.0), 60)["place"]
    assert np.linalg.norm(around, axis=2).max() < 16.0
    assert np.ptp(around, axis=0).min() > 5.0
    gathered = drive(team_of(patrol="gather", ring_m=30.0, patrol_m_s=1.0), 30)
    assert np.linalg.norm(gathered["place"][-1], axis=1).max() < 5.0
    fast, slow = gathered["speed"].max(axis=0), gathered["speed"][-30:].max(axis=0)
    assert fast == pytest.approx(3.0, rel=0.05)
    assert slow.max() < 1.1
    along = drive(team_of(patrol="along"), 20)["place"]
    assert (along[-1] - along[0]).mean(axis=0) == pytest.approx((30.0, 0.0), abs=1.5)


def test_an_order_is_obeyed_up_to_its_goal_and_holds() -> None:
    team = team_of(patrol="random")
    team.order(1, np.array([25.0, 30.0]), 2.0, np.array([0.0, 0.0]))
    found = drive(team, 40)
    assert np.linalg.norm(found["place"][-100:, 1] - (25.0, 30.0), axis=1).max() < 0.5
    assert found["speed"][-1, 1] == 0
    assert found["speed"][:, 1].max() == pytest.approx(2.0, rel=0.02)
    assert np.cos(team.heading[1] - np.arctan2(-25.0, -30.0)) > 0.999


def test_vehicles_go_round_one_another_and_round_what_stands() -> None:
    team = team_of(discs=((0.0, 0.0, 2.0), (4.0, 6.0, 1.5)), ugvs=4, patrol="stand")
    for k, place in enumerate(team.place.copy()):
        team.order(k, -place, 2.0, None)
    places = drive(team, 90)["place"]
    assert np.linalg.norm(places, axis=2).min() > 2.4
    apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=3) + 10 * np.eye(4)
    assert apart.min() > 1.7
    assert np.linalg.norm(places[-1] - team._ordered, axis=1).max() < 0.5  # all have come through


@pytest.mark.parametrize("patrol", ["stand", "random", "gather", "along"])
def test_planned_waypoints_are_where_the_vehicles_come_by(patrol: str) -> None:
    team = team_of(patrol=patrol)
    drive(team, 3)
    planned = team.waypoints(3.0, 5, ())
    now = team.place
    places = [now]
    for step in range(50):
        team.step(3.0 + (step + 1) / 10, 0.1, (), NOBODY)
        if step % 10 == 9:
            places.append(team.place)
    off = np.linalg.norm(planned - places, axis=2)
    assert off[0].max() == 0
    assert np.sqrt((off**2).mean()) < 0.35


@pytest.mark.parametrize("count", [0, 1, 4, 12])
def test_colours_of_plates_are_each_in_their_own_range_alone(count: int) -> None:
    names, bgr, colours = marker_plates(count)
    assert len(names) == len(bgr) == len(colours) == count
    if count:
        hsv = cv2.cvtColor(np.round(bgr).astype(np.uint8)[None], cv2.COLOR_BGR2HSV)[0]
        assert (of_ranges(hsv, colours.low, colours.high) == np.eye(count, dtype=bool)).all()
    every = np.stack(np.meshgrid(np.arange(180), [200], [200], indexing="ij"), axis=-1).reshape(-1, 3)
    assert of_ranges(every, colours.low, colours.high).sum(axis=1).max(initial=0) <= 1


def of_ranges(hsv: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(N, K) which colours are in which range."""
    hue, rest = hsv[:, None, 0], hsv[:, None, 1:]
    over = low[:, 0] > high[:, 0]
    inside = np.where(over, (hue >= low[:, 0]) | (hue <= high[:, 0]), (hue >= low[:, 0]) & (hue <= high[:, 0]))
    return inside & ((rest >= low[:, 1:]) & (rest <= high[:, 1:])).all(axis=2)


@pytest.mark.parametrize("light", [0.45, 0.8, 1.1])
def test_plates_keep_their_colours_in_shade_noise_and_compression(light: float) -> None:
    rng = np.random.default_rng(0)
    _, bgr, colours = marker_plates(12)
    for k in range(12):
        picture = np.full((48, 48, 3), (105.0, 130.0, 150.0))
        picture[16:32, 16:32] = bgr[k] * light
        noisy = (picture + rng.normal(0, 5, picture.shape)).clip(0, 255).astype(np.uint8)
        coded = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
        seen = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)
        hsv = cv2.cvtColor(seen, cv2.COLOR_BGR2HSV).reshape(-1, 3)
        found = of_ranges(hsv, colours.low, colours.high).reshape(48, 48, 12)
        assert found[17:31, 17:31, k].mean() > 0.9
        others = np.delete(found[16:32, 16:32], k, axis=2)
        assert others.any(axis=2).mean() < 0.1


# --- the UAV


def fly(aircraft: Aircraft, seconds: float, step_s: float = 0.1, start_s: float = 0.0) -> list[tuple]:
    found = []
    for step in range(round(seconds / step_s)):
        aircraft.step(start_s + (step + 1) * step_s, step_s)
        found.append(aircraft.pose())
    return found


def craft(half_m: float = 200.0, up_m: object = level, seed: int = 0, **parameters: object) -> Aircraft:
    return Aircraft(AircraftParameters.model_validate(parameters), half_m, up_m, seed)  # type: ignore[arg-type]


def calm(half_m: float = 200.0, up_m: object = level, **parameters: object) -> Aircraft:
    return craft(half_m, up_m, 0, **({"wind_m_s": 0.0, "shake_deg": 0.0} | parameters))


@pytest.mark.parametrize("pitch_deg", [90.0, 60.0, 45.0])
def test_the_point_of_the_way_is_in_the_middle_of_the_picture(pitch_deg: float) -> None:
    aircraft = calm(pitch_deg=pitch_deg, heading_deg=30.0, start_m=(5.0, -3.0), way_m=((65.0, -3.0),))
    for second, (pose, _, _) in enumerate(fly(aircraft, 20, 0.1)[9::10]):
        point = np.array([[5.0 + 2.0 * (second + 1), -3.0, 0.0]])
        assert view_from_pose(pose, CAMERA).project(point)[0] == pytest.approx(CAMERA.centre_px, abs=0.5)
        heading, pitch, roll = np.degrees(pose.angles_rad)
        assert pitch == pytest.approx(pitch_deg, abs=0.1)
        if pitch_deg < 90:
            assert (heading, roll) == pytest.approx((30.0, 0.0), abs=0.1)
        assert pose.place_m[2] == pytest.approx(50.0, abs=0.1)


def test_over_hills_it_keeps_its_height_above_ground() -> None:
    aircraft = calm(up_m=hilly, way_m=((150.0, 30.0),), speed_m_s=4.0)
    for pose, _, _ in fly(aircraft, 40)[::10]:
        assert pose.place_m[2] - hilly(pose.place_m[None, :2])[0] == pytest.approx(50.0, abs=1.0)


@pytest.mark.parametrize("steered", [False, True])
def test_rates_of_the_pose_are_its_derivatives(steered: bool) -> None:
    aircraft = craft(up_m=hilly, pitch_deg=60.0, way_m=((30.0, 0.0), (30.0, 30.0)), wind_m_s=2.0, shake_deg=0.3)
    step = 0.004
    fly(aircraft, 2.0)
    if steered:
        aircraft.steer(np.array([40.0, 40.0]), np.array([80.0, 20.0]), 70.0)
        fly(aircraft, 1.0, 0.1, 2.0)
    found = fly(aircraft, 4.0, step, 3.0)
    places = np.array([pose.place_m for pose, _, _ in found])
    axes = np.array([pose.axes for pose, _, _ in found])
    velocity = np.array([one for _, one, _ in found])
    turn = np.array([one for _, _, one in found])
    measured = (places[2:] - places[:-2]) / (2 * step)
    assert np.sqrt(((measured - velocity[1:-1]) ** 2).mean()) < 0.03
    change = (axes[2:] - axes[:-2]) / (2 * step) @ axes[1:-1].transpose(0, 2, 1)
    spun = np.stack([change[:, 2, 1], change[:, 0, 2], change[:, 1, 0]], axis=1)
    # What is pushed at random has rates that are true and rough: on average they agree.
    assert np.sqrt(((spun - turn[1:-1]) ** 2).mean()) < 0.1 * np.sqrt((turn**2).mean())
    assert np.linalg.norm(turn, axis=1).max() < np.radians(60)


def test_gusts_and_shaking_are_as_large_as_they_are_said_to_be() -> None:
    swaying = Swaying(np.full(3000, 0.5), 0.8, np.random.default_rng(0))
    assert swaying.value.std() == pytest.approx(0.5, rel=0.05)
    before = swaying.value.copy()
    for _ in range(8):
        swaying.step(0.1)
    assert swaying.value.std() == pytest.approx(0.5, rel=0.05)
    assert swaying.rate.std() == pytest.approx(0.5 / 0.8, rel=0.05)
    # Matern 3/2: (1 + t / tau) exp(-t / tau).
    assert np.corrcoef(before, swaying.value)[0, 1] == pytest.approx(2 * np.exp(-1), abs=0.03)


def test_steered_it_reaches_the_place_the_height_and_the_sight_asked_for() -> None:
    aircraft = calm(way_m=((30.0, 0.0),), maximum_m_s=8.0)
    fly(aircraft, 3.0)
    goal, seen = np.array([-40.0, 25.0]), np.array([-40.0, 75.0])
    aircraft.steer(goal, seen, 80.0)
    found = fly(aircraft, 60, 0.1, 3.0)
    pose = found[-1][0]
    assert pose.place_m == pytest.approx((*goal, 80.0), abs=0.3)
    assert view_from_pose(pose, CAMERA).project(np.array([[*seen, 0.0]]))[0] == pytest.approx(CAMERA.centre_px, abs=1.0)
    speed = np.linalg.norm([one for _, one, _ in found], axis=1)
    assert speed.max() <= 8.0 + 1e-6
    assert speed.max() > 7.0
    gained = np.linalg.norm(np.diff([one for _, one, _ in found], axis=0), axis=1)
    assert gained.max() <= 3.0 * 0.1 + 1e-6
    assert np.linalg.norm([one for _, _, one in found], axis=1).max() <= np.radians(60)


def test_its_telemetry_errs_lastingly_by_what_the_knobs_say() -> None:
    parameters = AircraftParameters(
        angle_error_deg=1.0, heading_error_deg=3.0, altitude_error=0.02, place_error95_m=3.5
    )
    errors = []
    for seed in range(800):
        telemetry = ReportedPose(parameters, seed)
        errors.append([telemetry.errors(0.1) for _ in range(2)])
    found = np.array(errors)
    sigma = np.array([np.radians(1), np.radians(1), np.radians(3), 0.02, 1.43, 1.43])
    assert found[:, 0].std(axis=0) == pytest.approx(sigma, rel=0.1)
    assert (np.abs(found[:, 1] - found[:, 0]).mean(axis=0) < 0.25 * sigma).all()


def test_a_way_goes_there_and_back_at_its_speed() -> None:
    way = Waypoints(np.array([[0.0, 0], [10, 0], [10, 0], [10, 5]]), 2.0)
    for time, place, velocity in (
        (0.0, (0, 0), (2, 0)),
        (4.0, (8, 0), (2, 0)),
        (6.0, (10, 2), (0, 2)),
        (9.0, (10, 2), (0, -2)),
        (13.0, (4, 0), (-2, 0)),
        (16.0, (2, 0), (2, 0)),
    ):
        at, going = way.at(time)
        assert at == pytest.approx(place)
        assert going == pytest.approx(velocity)
    assert Waypoints(np.zeros((1, 2)), 2.0).at(3.0)[1] == pytest.approx((0, 0))
