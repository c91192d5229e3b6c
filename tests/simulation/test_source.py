"""A simulated run as a clip: what every source offers, and what its vehicles say meanwhile."""

import subprocess
import sys

import numpy as np
import pytest

from tests.simulation.small import as_file, small
from torchvision_dddas import geometry, open_video
from torchvision_dddas.errors import InputError
from torchvision_dddas.simulation import SimulatorSource
from torchvision_dddas.simulation.simulator import KEPT
from torchvision_dddas.types import Command, Order


@pytest.fixture(scope="module")
def source():
    return SimulatorSource(small(fault=({"what": "dropped", "time_s": 0.5, "seconds": 0.15},)), "small")


def read(source, until):
    """The frames up to a number."""
    frames = []
    for frame in source:
        frames.append(frame)
        if frame.number >= until:
            break
    return frames


def test_it_is_a_source_whose_dropped_frames_are_missing_numbers(source):
    frames = list(source)
    assert [f.number for f in frames] == [n for n in range(1, 21) if n not in (6, 7)]
    assert (source.name, source.count, source.exact, source.rate_hz, source.size) == (
        "small",
        20,
        True,
        10.0,
        (160, 120),
    )
    assert source.last == 20
    assert [str(p) for p in source.problems] == [f"frame {n} was dropped by the camera" for n in (6, 7)]


def test_every_iteration_starts_anew(source):
    first = read(source, 4)
    reports, flown = source.landmarks(), source.telemetry()
    again = read(source, 4)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.image, b.image)
    np.testing.assert_array_equal(source.landmarks().place, reports.place)
    np.testing.assert_array_equal(source.telemetry().place, flown.place)
    assert source.problems == []


def test_every_kth_frame_is_the_same_as_among_all(source):
    some = {f.number: f.image for f in source.every(3)}
    assert list(some) == [1, 4, 10, 13, 16, 19]
    for frame in source:
        if frame.number in some:
            np.testing.assert_array_equal(frame.image, some[frame.number])


def test_reports_are_true_to_the_world_where_receivers_are_exact(source):
    frames = read(source, 4)
    bodies = source.truths()[-1].bodies
    landmarks = source.landmarks()
    now = (landmarks.frame == frames[-1].number) & ~landmarks.planned
    said = geometry.east_north(landmarks.place[now], source.origin_deg)
    np.testing.assert_allclose(said, bodies.place_m[bodies.kind == "ugv", :2], atol=0.02)
    assert landmarks.geographic
    assert [landmarks.names[k] for k in landmarks.landmark[now]] == list(source.colours.names)


def test_telemetry_says_where_the_uav_is_as_well_as_its_receiver_knows(source):
    read(source, 4)
    flown, pose = source.telemetry(), source.truths()[-1].pose
    assert flown.geographic
    said = geometry.east_north(flown.place[-1:], source.origin_deg)[0]
    assert np.hypot(*(said - pose.place_m[:2])) < 6
    assert flown.altitude_m[-1] == pytest.approx(30, rel=0.2)
    assert np.degrees(flown.pitch_rad[-1]) == pytest.approx(90, abs=5)


def test_of_two_plans_for_one_frame_the_newer_counts(source):
    list(source)
    landmarks = source.landmarks()
    plans = [(k, f) for k, f, p in zip(landmarks.landmark, landmarks.frame, landmarks.planned, strict=True) if p]
    assert plans
    assert len(plans) == len(set(plans))
    assert (np.diff(landmarks.frame) >= 0).all()


def test_a_command_leaves_frames_out_and_says_so(source):
    seen = []
    for frame in source:
        seen.append((frame.number, frame.skipped))
        if frame.number == 2:
            source.steer(Command(every=3))
        if frame.number == 14:
            source.steer(Command())
    # 6 and 7 were dropped by the camera; 5, 8, 11 were looked at.
    assert seen == [
        (1, 0),
        (2, 0),
        (5, 2),
        (8, 2),
        (11, 2),
        (14, 2),
        (15, 0),
        (16, 0),
        (17, 0),
        (18, 0),
        (19, 0),
        (20, 0),
    ]


def test_an_order_for_a_picture_gives_one_and_no_more(source):
    pictures = []
    for frame in source:
        pictures.append([p.vehicle for p in source.pictures()])
        if frame.number == 2:
            here = source.landmarks().place[:2]
            orders = (Order("ugv1", here[0], 0.0, picture=True), Order("ugv3", here[1], 0.0))
            source.steer(Command(orders=orders))
        if frame.number == 5:
            break
    assert pictures == [[], [], ["ugv1"], [], []]


def test_truths_come_once_for_every_frame_dropped_ones_too(source):
    list(source)
    assert [t.frame for t in source.truths()] == list(range(1, 21))
    assert source.truths() == []
    assert KEPT > 20


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return as_file(tmp_path_factory.mktemp("scenarios") / "tiny.toml", small())


def test_open_source_takes_a_scenarios_name_or_file(path):
    source = open_video(f"sim:{path}")
    assert isinstance(source, SimulatorSource)
    assert source.name == "tiny"
    with pytest.raises(InputError, match="no scenario is named 'nowhere'; there are border100"):
        open_video("sim:nowhere")
    with pytest.raises(InputError, match="leave --rate out"):
        open_video(f"sim:{path}", rate_hz=5)


def test_a_scenario_that_the_world_refuses_is_named(tmp_path):
    path = as_file(
        tmp_path / "low.toml", small(uav={"altitude_m": 2.0, "way_m": ((25.0, 25.0),)}, world={"trees_per_ha": 500.0})
    )
    with pytest.raises(InputError, match=r"low.toml: uav.altitude_m = 2 is too low"):
        open_video(f"sim:{path}")


def test_a_raster_that_cannot_be_read_is_named(tmp_path):
    pytest.importorskip("rasterio")
    (tmp_path / "hills.tif").write_bytes(b"no raster")
    path = as_file(tmp_path / "odd.toml", small(world={"elevation": "hills.tif"}))
    with pytest.raises(InputError, match=r"hills.tif cannot be read as a raster"):
        open_video(f"sim:{path}")


def test_it_needs_no_torch(path):
    script = f"""
import sys
sys.modules["torch"] = None
from torchvision_dddas import open_video
frame = next(iter(open_video("sim:{path}")))
print(frame.number, "kornia" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout.split() == ["1", "False"], done.stderr
