"""How far a log's clock is off its clip's, by the turns that both show, and velocities in spite of that."""

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.geo import AerialLocator, Targets
from torchvision_dddas.geo.aerial_targets import TargetSpeeds
from torchvision_dddas.geo.clock_offset import describe_clock_offset, find_clock_offset, logged_turns
from torchvision_dddas.geometry.projection import axes_of, project
from torchvision_dddas.types import Camera, CameraPose, Telemetry

CAMERA = Camera("uav", (640, 480), (554.0, 554.0), (319.5, 239.5))


def wander(time_s, seed=0, pace_s=2.0):
    """(N, 3) rad, a camera that turns to and fro at no period, about three axes."""
    rng = np.random.default_rng(seed)
    waves = np.radians(rng.normal(0, 2.0, (12, 3)))
    periods, phases = rng.uniform(pace_s, 6 * pace_s, (12, 1)), rng.uniform(0, 2 * np.pi, (12, 3))
    return (waves[:, :, None] * np.sin(2 * np.pi * time_s / periods[:, :, None] + phases[:, :, None])).sum(axis=0).T


def observe(offset_s, turns=wander, length_s=20.0, log_hz=10.0, noise_deg=0.2, scale=1.0, seed=0, kept_s=0.0):
    """The arguments of `find_clock_offset`: frames at 20 Hz; a log with noise that keeps for a while."""
    rng = np.random.default_rng(seed)
    time_s, log_s = np.arange(0, length_s, 0.05), np.arange(-3, length_s + 3, 1 / log_hz) + rng.uniform(0, 1 / log_hz)
    noise = rng.normal(0, np.radians(noise_deg), (len(log_s), 3))
    keep = np.exp(-1 / log_hz / kept_s) if kept_s else 0.0
    for k in range(1, len(noise)):
        noise[k] = keep * noise[k - 1] + np.sqrt(1 - keep**2) * noise[k]
    seen, told = scale * turns(time_s), turns(log_s) + noise
    first = np.full((1, 3), np.nan)
    steps = np.diff(seen, axis=0) + rng.normal(0, 2e-5, (len(seen) - 1, 3))
    return time_s, np.r_[first, steps], log_s - offset_s, np.r_[first, np.diff(told, axis=0)]


def one_turn(time_s):
    return np.outer(1 / (1 + np.exp(-(time_s - 10.0) / 0.4)), [0.0, 0.1, 1.0])


@pytest.mark.parametrize("offset_s", [-4.3, 0.0, 0.067, 2.5])
@pytest.mark.parametrize(
    "how",
    [
        {},
        {"log_hz": 20.0},
        {"log_hz": 1.0, "length_s": 40.0},
        {"noise_deg": 1.0},
        {"kept_s": 1.0},
        {"scale": 0.7},  # a focal length that is guessed
        {"turns": one_turn},
    ],
)
def test_the_offset_of_a_flight_that_turns_is_found_within_its_sigma(offset_s, how):
    found = find_clock_offset(*observe(offset_s, **how))
    assert found is not None
    assert abs(found[0] - offset_s) < 3.5 * found[1] < 0.3


@pytest.mark.parametrize("how", [{"noise_deg": 0.5}, {"kept_s": 1.0, "noise_deg": 0.5}])
def test_two_thirds_of_the_offsets_are_within_one_sigma(how):
    off = []
    for seed in range(24):
        turns = lambda time_s, seed=seed: wander(time_s, seed)  # noqa: E731
        offset_s, sigma_s = find_clock_offset(*observe(0.0, turns, seed=seed, length_s=12.0, **how)) or (0.0, 1.0)
        off.append(abs(offset_s) / sigma_s)
    assert 0.5 <= np.mean(np.array(off) < 1) <= 0.92 and max(off) < 3.5


@pytest.mark.parametrize(
    "turns",
    [
        lambda time_s: np.zeros((len(time_s), 3)),
        lambda time_s: np.outer(time_s, [0.01, 0.0, 0.1]),
        lambda time_s: np.outer(np.sin(2 * np.pi * time_s / 3.0), [0.05, 0.02, 0.08]),
    ],
    ids=["straight", "a steady turn", "a period"],
)
@pytest.mark.parametrize("offset_s", [0.0, 1.0])
@pytest.mark.parametrize("kept_s", [0.0, 3.0])
def test_nothing_is_said_where_no_offset_stands_out(turns, offset_s, kept_s):
    assert find_clock_offset(*observe(offset_s, turns, noise_deg=0.3, kept_s=kept_s)) is None


def test_turns_that_are_not_the_cameras_give_no_offset():
    time_s, steps, log_s, _ = observe(0.0)
    other = wander(log_s, seed=5)
    assert find_clock_offset(time_s, steps, log_s, np.diff(other, axis=0, prepend=np.nan * other[:1])) is None


def test_a_log_without_time_or_of_a_moment_gives_no_offset():
    time_s, steps, log_s, told = observe(0.0)
    for few in (slice(0, 0), slice(0, 1), slice(0, 5)):
        assert find_clock_offset(time_s, steps, log_s[few], told[few]) is None
        assert find_clock_offset(time_s[few], steps[few], log_s, told) is None


def fly(length_s=12.0, rate_hz=10.0, late_s=0.0):
    """A log of a camera that looks obliquely from a moving vehicle, and its true pixel homographies.

    late_s: how much later the camera turns in the pictures than in the log.
    """
    time_s = np.arange(0, length_s, 1 / rate_hz)
    heading, pitch, roll = (0.5 + wander(time_s, 3) * [3, 1, 1] + [0, 0.5, -0.5]).T
    place = np.c_[3.0 * time_s, 40 + np.sin(time_s / 3)]
    height = 60 + 2 * np.sin(time_s / 5)
    telemetry = Telemetry(
        time_s - late_s, height, 3 + 0 * time_s, place, False,
        heading_rad=heading % (2 * np.pi), pitch_rad=pitch, roll_rad=roll,
    )  # fmt: skip
    corners = np.array([[-30.0, 60], [30, 60], [30, 140], [-30, 140], [0, 100]])
    poses = [
        CameraPose(np.array([*place[k], height[k]]), axes_of(heading[k], pitch[k], roll[k])) for k in range(len(time_s))
    ]
    motions = [np.full((3, 3), np.nan)]
    for before, now in pairwise(poses):
        ground = before.place_m + np.c_[corners @ np.array([[0.5, 0], [0, 0.5]]), np.zeros(5)]
        ground[:, 2] = 0.0
        seen = [project(ground, pose, CAMERA) for pose in (before, now)]
        motions.append(cv2.findHomography(seen[0], seen[1])[0])
    return telemetry, list(zip(time_s.tolist(), motions, strict=True))


def test_the_turns_of_a_log_are_those_of_the_registrations_of_level_ground():
    telemetry, seen = fly()
    turns = logged_turns(telemetry)
    (fu, fv), (u, v) = CAMERA.focal_px, CAMERA.centre_px
    for turn, (_, motion) in list(zip(turns, seen, strict=True))[1:]:
        middle = motion @ [u, v, 1]
        assert middle[:2] / middle[2] == pytest.approx([u - turn[1] * fu, v + turn[0] * fv], abs=0.05)
        pixels = np.array([[fu, 0, u], [0, fv, v], [0, 0, 1]], float)
        flat = np.linalg.inv(pixels) @ motion @ pixels
        flat /= flat[2, 2]
        assert (flat[0, 1] - flat[1, 0]) / 2 == pytest.approx(turn[2], abs=1e-4)
    # Of ground at an unknown depth the camera's own turn remains.
    deep = logged_turns(replace(telemetry, altitude_m=np.full(len(telemetry), np.nan)))
    assert np.isfinite(deep[1:]).all() and np.abs(deep[1:] - turns[1:]).max() > 1e-4


def test_a_note_offers_the_value_to_set_on_top_of_the_one_in_force():
    telemetry, seen = fly(late_s=0.62)
    locator = AerialLocator(
        CAMERA,
        telemetry,
        None,
        elevation=None,
        settings=with_parameters(Settings(), {"aerial.clock_offset_s": 10.0}),
        rate_hz=10.0,
    )
    said = describe_clock_offset(locator, seen)
    assert "the camera turns 0.62" in said and "later in the pictures" in said
    assert float(said.split("aerial.clock_offset_s=")[1]) == pytest.approx(10.62, abs=0.01)
    aligned, seen = fly()
    assert describe_clock_offset(AerialLocator(CAMERA, aligned, rate_hz=10.0), seen) == ""
    # A course or a nose turns at another time than the camera.
    nose = replace(telemetry, heading_rad=np.full(len(telemetry), np.nan), vehicle_heading_rad=telemetry.heading_rad)
    assert describe_clock_offset(AerialLocator(CAMERA, nose, rate_hz=10.0), seen) == ""


@pytest.mark.parametrize("late_s", [0.0, 0.4])
def test_a_targets_velocity_by_telemetry_alone_does_not_follow_the_errors_of_a_late_log(late_s):
    telemetry, seen = fly(late_s=late_s)
    true, _ = fly()
    rng, way, start = np.random.default_rng(0), np.array([8.0, 3.0]), np.zeros(3)
    locators = [AerialLocator(CAMERA, telemetry, rate_hz=10.0) for _ in range(2)]
    velocities: list[list[np.ndarray]] = [[], []]
    for k, (_, motion) in enumerate(seen):
        angles = (float(column[k]) for column in (true.heading_rad, true.pitch_rad, true.roll_rad))
        pose = CameraPose(np.array([*true.place[k], true.altitude_m[k]]), axes_of(*angles))
        start = pose.place_m + pose.axes[:, 2] * pose.place_m[2] / -pose.axes[2, 2] if k == 0 else start
        at = project(np.array([[*(start[:2] + way * k / 10), 0.0]]), pose, CAMERA) + rng.normal(0, 0.3, (1, 2))
        targets = Targets(np.c_[at - 4.5, [[10.0, 10.0]]], np.ones(1, np.int64), np.ones(1, bool), np.ones(1))
        for locator, found, known in zip(locators, velocities, (motion, None), strict=True):
            fixed = locator.fix_frame(k + 1, locator.landmarks_at(k + 1))
            found.append(locator.locate_targets(fixed, targets, motion=known).velocity_m_s)
    with_pictures, without = (np.linalg.norm(np.concatenate(found[40:]) - way, axis=1) for found in velocities)
    # The direction is that of the log, which is late.
    assert np.nanmax(with_pictures) < (4.0 if late_s else 0.3)
    assert not late_s or np.nanmedian(without) > 5 * np.nanmedian(with_pictures)


def test_a_registration_that_is_not_known_leaves_targets_where_they_were():
    speeds, unknown = TargetSpeeds(), np.full((3, 3), np.nan)
    for k in range(20):
        speeds.carry(unknown, lambda pixels, up_m: np.full((len(pixels), 2), np.nan), True)
        place = np.array([[2.0 * k / 10, 0.0]])
        found = speeds.update(k / 10, np.ones(1, np.int64), place, 1e-4 * np.eye(2)[None], np.zeros((1, 3)))
    assert found[0] == pytest.approx([2.0, 0.0], abs=0.05)
