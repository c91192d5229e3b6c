"""The team of UGVs, its receivers and colours, the UAV, and the camera's sensor: within their limits and errors."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from torchvision_dddas.lab.simulation.cameras import view_from_pose
from torchvision_dddas.lab.simulation.ground_vehicles import ACCELERATION_M_S2, TURN_RAD_S, Team, marker_plates
from torchvision_dddas.lab.simulation.movement import Obstacles, Waypoints
from torchvision_dddas.lab.simulation.scenario import AircraftParameters, CameraParameters, TeamParameters
from torchvision_dddas.lab.simulation.sensors import Receivers, Sensor
from torchvision_dddas.lab.simulation.uav import Aircraft, ReportedPose, Swaying
from torchvision_dddas.types import Camera

CAMERA = Camera("air", (640, 480), (554.0, 554.0), (319.5, 239.5))


def errors_of(receivers, count, seconds):
    errors = []
    for _ in range(count):
        errors.append(receivers.error_m)
        receivers.advance(seconds)
    return np.array(errors)


def test_95_percent_of_places_are_within_the_radius_from_the_first_report_on():
    receivers = Receivers(4000, 3.5, 0.1, 60.0, 0.0, np.random.default_rng(0))
    found = np.linalg.norm(errors_of(receivers, 3, 30.0), axis=2)
    assert (found < 3.5).mean(axis=1) == pytest.approx(0.95, abs=0.012)
    assert receivers.sigma_m == pytest.approx(1.43, abs=0.005)


def test_errors_last_for_their_correlation_time_and_a_share_is_new():
    found = errors_of(Receivers(2000, 3.5, 0.2, 20.0, 0.0, np.random.default_rng(1)), 21, 1.0)[..., 0]
    alike = np.corrcoef(found)
    assert np.diag(alike, 1).mean() == pytest.approx(0.8 * np.exp(-1 / 20), abs=0.02)
    assert np.diag(alike, 20).mean() == pytest.approx(0.8 * np.exp(-1), abs=0.06)


# The team.


def team_of(discs=(), **parameters):
    places = np.array(discs, float).reshape(-1, 3)
    things: Any = SimpleNamespace(kind=("tree",) * len(places), east_north_m=places[:, :2], radius_m=places[:, 2])
    flight = AircraftParameters(way_m=((40.0, 0.0),), speed_m_s=1.5)
    return Team(TeamParameters.model_validate(parameters), flight, 200.0, Obstacles(things, 200.0), 4)


def drive(team, seconds, start_s=0.0):
    """(T, K, ...) places, courses and speeds."""
    found = []
    for step in range(round(seconds * 10)):
        team.step(start_s + (step + 1) / 10, 0.1, (), np.zeros((0, 2)))
        found.append((team.place, team.course, team.speed))
    return [np.array(column) for column in zip(*found, strict=True)]


@pytest.mark.parametrize("patrol", ["stand", "random", "gather", "along"])
def test_vehicles_move_within_their_limits_past_their_planned_waypoints(patrol):
    team = team_of(patrol=patrol, ugvs=6)
    drive(team, 3)
    planned, start = team.waypoints(3.0, 5, ()), team.place
    place, course, speed = drive(team, 40, 3.0)
    off = np.linalg.norm(planned - np.concatenate([start[None], place[9:50:10]]), axis=2)
    assert off[0].max() == 0
    assert np.sqrt((off**2).mean()) < 0.35
    assert np.diff(speed, axis=0).max() <= ACCELERATION_M_S2 * 0.1 + 1e-9
    assert np.abs(np.diff(np.unwrap(course, axis=0), axis=0)).max() <= TURN_RAD_S * 0.1 + 1e-9
    assert (speed.max() > 0.5) == (patrol != "stand")


def test_each_patrol_goes_where_it_should():
    stood, _, _ = drive(team_of(patrol="stand"), 10)
    assert np.ptp(stood, axis=0).max() < 0.1
    around, _, _ = drive(team_of(patrol="random", ring_m=14.0), 40)
    assert np.linalg.norm(around, axis=2).max() < 16.0
    assert np.ptp(around, axis=0).min() > 5.0
    gathered, _, speed = drive(team_of(patrol="gather", ring_m=30.0, patrol_m_s=1.0), 30)
    assert np.linalg.norm(gathered[-1], axis=1).max() < 5.0
    assert speed.max(axis=0) == pytest.approx(3.0, rel=0.05)
    assert speed[-30:].max() < 1.1
    along, _, _ = drive(team_of(patrol="along"), 20)
    assert (along[-1] - along[0]).mean(axis=0) == pytest.approx((30.0, 0.0), abs=1.5)


def test_an_order_is_obeyed_up_to_its_goal_and_holds():
    team = team_of(patrol="random")
    team.order(1, np.array([25.0, 30.0]), 2.0, np.array([0.0, 0.0]))
    place, _, speed = drive(team, 40)
    assert np.linalg.norm(place[-100:, 1] - (25.0, 30.0), axis=1).max() < 0.5
    assert speed[-1, 1] == 0
    assert speed[:, 1].max() == pytest.approx(2.0, rel=0.02)
    assert np.cos(team.heading[1] - np.arctan2(-25.0, -30.0)) > 0.999


def test_vehicles_go_round_one_another_and_round_what_stands():
    team = team_of(discs=((0.0, 0.0, 2.0), (4.0, 6.0, 1.5)), patrol="stand")
    goals = -team.place
    for k, goal in enumerate(goals):
        team.order(k, goal, 2.0, None)
    places, _, _ = drive(team, 90)
    assert np.linalg.norm(places, axis=2).min() > 2.4
    apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=3) + 10 * np.eye(4)
    assert apart.min() > 1.7
    assert np.linalg.norm(places[-1] - goals, axis=1).max() < 0.5  # all have come through


def in_ranges(hsv, colours):
    """(N, K) which colours are in which range."""
    hue, rest, low, high = hsv[:, None, 0], hsv[:, None, 1:], colours.low, colours.high
    above, below = hue >= low[:, 0], hue <= high[:, 0]
    inside = np.where(low[:, 0] > high[:, 0], above | below, above & below)
    return inside & ((rest >= low[:, 1:]) & (rest <= high[:, 1:])).all(axis=2)


@pytest.mark.parametrize("count", [0, 1, 12])
def test_colour_ranges_of_plates_do_not_overlap(count):
    names, bgr, colours = marker_plates(count)
    assert len(names) == len(bgr) == len(colours) == count
    every = np.stack(np.meshgrid(np.arange(180), [200], [200], indexing="ij"), axis=-1).reshape(-1, 3)
    assert in_ranges(every, colours).sum(axis=1).max(initial=0) <= 1


@pytest.mark.parametrize("light", [0.45, 0.8, 1.1])
def test_plates_keep_their_colours_in_shade_noise_and_compression(light):
    rng = np.random.default_rng(0)
    _, bgr, colours = marker_plates(12)
    for k in range(12):
        picture = np.full((48, 48, 3), (105.0, 130.0, 150.0))
        picture[16:32, 16:32] = bgr[k] * light
        noisy = (picture + rng.normal(0, 5, picture.shape)).clip(0, 255).astype(np.uint8)
        coded = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
        hsv = cv2.cvtColor(np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2HSV).reshape(-1, 3)
        found = in_ranges(hsv, colours).reshape(48, 48, 12)
        assert found[17:31, 17:31, k].mean() > 0.9
        assert np.delete(found[16:32, 16:32], k, axis=2).any(axis=2).mean() < 0.1


# The UAV.


def hilly(places):
    return 3 * np.sin(places[:, 0] / 40) + 2 * np.cos(places[:, 1] / 30)


def craft(up_m=lambda places: np.zeros(len(places)), wind_m_s=0.0, shake_deg=0.0, **parameters):
    given = {"wind_m_s": wind_m_s, "shake_deg": shake_deg, **parameters}
    return Aircraft(AircraftParameters.model_validate(given), 200.0, up_m, 0)


def fly(aircraft, seconds, step_s=0.1, start_s=0.0):
    """Poses, and velocities and turns (T, 3)."""
    found = []
    for step in range(round(seconds / step_s)):
        aircraft.step(start_s + (step + 1) * step_s, step_s)
        found.append(aircraft.pose())
    poses, velocity, turn = zip(*found, strict=True)
    return poses, np.array(velocity), np.array(turn)


@pytest.mark.parametrize("pitch_deg", [90.0, 45.0])
def test_the_point_of_the_way_is_in_the_middle_of_the_picture(pitch_deg):
    aircraft = craft(pitch_deg=pitch_deg, heading_deg=30.0, start_m=(5.0, -3.0), way_m=((65.0, -3.0),))
    poses, _, _ = fly(aircraft, 20)
    for second, pose in enumerate(poses[9::10]):
        point = np.array([5.0 + 2.0 * (second + 1), -3.0, 0.0])
        assert view_from_pose(pose, CAMERA).project(point) == pytest.approx(CAMERA.centre_px, abs=0.5)
        heading, pitch, roll = np.degrees(pose.angles_rad)
        assert pitch == pytest.approx(pitch_deg, abs=0.1)
        assert pitch_deg == 90 or (heading, roll) == pytest.approx((30.0, 0.0), abs=0.1)
        assert pose.place_m[2] == pytest.approx(50.0, abs=0.1)


def test_over_hills_it_keeps_its_height_above_ground():
    poses, _, _ = fly(craft(hilly, way_m=((150.0, 30.0),), speed_m_s=4.0), 40)
    for pose in poses[::10]:
        assert pose.place_m[2] - hilly(pose.place_m[None, :2])[0] == pytest.approx(50.0, abs=1.0)


@pytest.mark.parametrize("steered", [False, True])
def test_rates_of_the_pose_are_its_derivatives(steered):
    aircraft = craft(hilly, 2.0, 0.3, pitch_deg=60.0, way_m=((30.0, 0.0), (30.0, 30.0)))
    step = 0.004
    fly(aircraft, 2.0)
    if steered:
        aircraft.steer(np.array([40.0, 40.0]), np.array([80.0, 20.0]), 70.0)
        fly(aircraft, 1.0, 0.1, 2.0)
    poses, velocity, turn = fly(aircraft, 4.0, step, 3.0)
    places, axes = np.array([pose.place_m for pose in poses]), np.array([pose.axes for pose in poses])
    measured = (places[2:] - places[:-2]) / (2 * step)
    assert np.sqrt(((measured - velocity[1:-1]) ** 2).mean()) < 0.03
    change = (axes[2:] - axes[:-2]) / (2 * step) @ axes[1:-1].transpose(0, 2, 1)
    spun = np.stack([change[:, 2, 1], change[:, 0, 2], change[:, 1, 0]], axis=1)
    # What is pushed at random has rates that are true and rough: on average they agree.
    assert np.sqrt(((spun - turn[1:-1]) ** 2).mean()) < 0.1 * np.sqrt((turn**2).mean())
    assert np.linalg.norm(turn, axis=1).max() < np.radians(60)


def test_gusts_and_shaking_have_their_standard_deviation_and_last_for_their_time():
    swaying = Swaying(np.full(3000, 0.5), 0.8, np.random.default_rng(0))
    before = swaying.value.copy()
    for _ in range(8):
        swaying.step(0.1)
    assert (before.std(), swaying.value.std()) == pytest.approx((0.5, 0.5), rel=0.05)
    assert swaying.rate.std() == pytest.approx(0.5 / 0.8, rel=0.05)
    # Matern 3/2: (1 + t / tau) exp(-t / tau).
    assert np.corrcoef(before, swaying.value)[0, 1] == pytest.approx(2 * np.exp(-1), abs=0.03)


def test_steered_it_reaches_the_place_the_height_and_the_sight_asked_for():
    aircraft = craft(way_m=((30.0, 0.0),), maximum_m_s=8.0)
    fly(aircraft, 3.0)
    goal, seen = np.array([-40.0, 25.0]), np.array([-40.0, 75.0])
    aircraft.steer(goal, seen, 80.0)
    poses, velocity, turn = fly(aircraft, 60, 0.1, 3.0)
    assert poses[-1].place_m == pytest.approx((*goal, 80.0), abs=0.3)
    view = view_from_pose(poses[-1], CAMERA)
    assert view.project(np.array([*seen, 0.0])) == pytest.approx(CAMERA.centre_px, abs=1.0)
    assert 7.0 < np.linalg.norm(velocity, axis=1).max() <= 8.0 + 1e-6
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() <= 3.0 * 0.1 + 1e-6
    assert np.linalg.norm(turn, axis=1).max() <= np.radians(60)


def test_its_telemetry_errs_lastingly_by_its_parameters():
    given = {"angle_error_deg": 1.0, "heading_error_deg": 3.0, "altitude_error": 0.02, "place_error95_m": 3.5}
    reports = [ReportedPose(AircraftParameters.model_validate(given), seed) for seed in range(800)]
    found = np.array([[report.errors(0.1) for _ in range(2)] for report in reports])
    sigma = np.array([np.radians(1), np.radians(1), np.radians(3), 0.02, 1.43, 1.43])
    assert found[:, 0].std(axis=0) == pytest.approx(sigma, rel=0.1)
    assert (np.abs(found[:, 1] - found[:, 0]).mean(axis=0) < 0.25 * sigma).all()


def test_a_way_goes_there_and_back_at_its_speed():
    way = Waypoints(np.array([[0.0, 0], [10, 0], [10, 0], [10, 5]]), 2.0)
    places, velocities = zip(*(way.at(time) for time in (4.0, 6.0, 9.0, 13.0, 16.0)), strict=True)
    np.testing.assert_allclose(places, [(8, 0), (10, 2), (10, 2), (4, 0), (2, 0)], atol=1e-9)
    np.testing.assert_allclose(velocities, [(2, 0), (0, 2), (0, -2), (-2, 0), (2, 0)], atol=1e-9)
    assert Waypoints(np.zeros((1, 2)), 2.0).at(3.0)[1] == pytest.approx((0, 0))


# The camera's sensor.


def sensor(seed=0, stream=0, **parameters):
    clear = dict.fromkeys(("sharpness_px", "shot_noise", "read_noise", "drift"), 0)
    return Sensor(CameraParameters.model_validate({**clear, "quality": 100, **parameters}), (320, 240), seed, stream)


def grey(value):
    return np.full((240, 320, 3), value, np.uint8)


@pytest.mark.parametrize("value", [40, 160])
def test_the_variance_of_the_noise_grows_with_the_light(value):
    noisy = sensor(shot_noise=0.15, read_noise=2.0).expose(grey(value), 1, 0.0)
    assert noisy.astype(float).var() == pytest.approx(0.15 * value + 4 + 1 / 12, rel=0.03)
    assert noisy.mean() == pytest.approx(value, abs=0.1)


def test_exposure_drifts_slowly_and_no_further_than_asked():
    camera = sensor(drift=0.1)
    gain = np.array([camera.gain(t) for t in np.arange(0, 300, 0.1)])
    assert np.abs(gain - 1).max() <= 0.1
    assert np.ptp(gain) > 0.1
    assert np.abs(np.diff(gain)).max() < 0.01


def test_noise_depends_on_seed_stream_and_number_and_on_nothing_before_it():
    parameters = {"shot_noise": 0.2, "read_noise": 1.0, "drift": 0.05, "quality": 90, "sharpness_px": 0.6}
    first, second = sensor(3, **parameters), sensor(3, **parameters)
    first.expose(grey(90), 1, 0.1)
    expected = second.expose(grey(90), 2, 0.2)
    assert np.array_equal(first.expose(grey(90), 2, 0.2), expected)
    for other, number in ((sensor(4, **parameters), 2), (sensor(3, stream=1, **parameters), 2), (second, 3)):
        assert np.corrcoef(other.expose(grey(90), number, 0.2).ravel(), expected.ravel())[0, 1] < 0.02
