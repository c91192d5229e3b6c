"""Cameras from TOML, poses from CSV: what they mean, and one line for each mistake."""

import math

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import poses_at
from torchvision_dddas.io.camera_files import read_camera, read_camera_keys, read_poses

LEAST = "focal_px = 1000\nwidth_px = 640\nheight_px = 480\n"


@pytest.fixture
def toml(tmp_path):
    def write(text):
        path = tmp_path / "north.toml"
        path.write_text(text)
        return path

    return write


@pytest.fixture
def poses(tmp_path):
    def write(text):
        path = tmp_path / "poses.csv"
        path.write_text(text)
        return path

    return write


def test_the_least_that_a_camera_needs(toml):
    found = read_camera(toml(LEAST))
    assert (found.name, found.size_px, found.focal_px) == ("north", (640, 480), (1000.0, 1000.0))
    assert (found.centre_px, found.place, found.geographic) == ((319.5, 239.5), (0.0, 0.0), False)
    assert math.isnan(found.height_m) and found.heading_rad == found.pitch_rad == found.k1 == 0


def test_every_key_reaches_the_camera(toml):
    text = """
    name = "Rover 2"
    hfov_deg = 90
    focal_v_px = 330
    width_px = 640
    height_px = 480
    centre_px = [310, 250]
    height_m = 1.2
    pitch_deg = 10
    roll_deg = -1
    heading_deg = 90
    longitude_deg = -110.95
    latitude_deg = 32.23
    k1 = -0.1
    k2 = 0.01
    focal_sigma = 0.02
    height_sigma_m = 0.1
    pitch_sigma_deg = 1
    heading_sigma_deg = 5
    position_sigma_m = 0.5
    """
    found = read_camera(toml(text))
    assert found.name == "Rover 2"
    assert found.focal_px == pytest.approx((320, 330))
    assert (found.centre_px, found.place, found.geographic) == ((310, 250), (-110.95, 32.23), True)
    angles = (found.pitch_rad, found.roll_rad, found.heading_rad, found.pitch_sigma_rad, found.heading_sigma_rad)
    assert np.degrees(angles) == pytest.approx([10, -1, 90, 1, 5])
    assert (found.height_m, found.k1, found.k2) == (1.2, -0.1, 0.01)
    assert (found.focal_sigma, found.height_sigma_m, found.position_sigma_m) == (0.02, 0.1, 0.5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("width_px = 640\nheight_px = 480", "has no focal length.*dddas calibrate"),
        (LEAST + "hfov_deg = 60", "both focal_px and hfov_deg; give one"),
        ("focal_px = 1000", "lacks width_px, height_px"),
        (LEAST + "focal = 3", "has the key focal, which no camera has; did you mean focal_px"),
        (LEAST + "height_m = -1", "height_m is -1; wanted a number from 0.01 to 1000"),
        (LEAST + 'pitch_deg = "down"', "pitch_deg is 'down'; wanted a number from -89 to 89"),
        (LEAST + "pitch_deg = nan", "pitch_deg is nan; wanted a number"),
        (LEAST + "heading_deg = true", "heading_deg is True; wanted a number"),
        (LEAST + "latitude_deg = 3", "latitude_deg alone; wanted longitude_deg and latitude_deg"),
        (LEAST + "latitude_deg = 3\nlongitude_deg = 4\neast_m = 1\nnorth_m = 1", "in degrees or in metres"),
        (LEAST + "centre_px = [1, 2, 3]", r"centre_px is \[1, 2, 3\]; wanted \[u, v\]"),
        (LEAST + "centre_px = [true, 3]", "centre_px is .*; wanted"),
        (LEAST + "name = 3", "name is 3; wanted a text in quotes"),
        (LEAST.replace("640", "640.5"), "width_px is 640.5; wanted a whole number"),
        (LEAST + "k1 = 0x" + "f" * 9999, "k1 is far too large; wanted a number from -10 to 10"),
        (LEAST + "k1 = " + "9" * 9999, "is not valid TOML: Exceeds the limit"),
        (LEAST + "name = " + "[" * 5000, "its brackets are nested too deeply"),
        ("focal_px == 3", "is not valid TOML"),
    ],
)
def test_a_mistake_in_a_camera_is_named(toml, text, words):
    with pytest.raises(InputError, match=words) as caught:
        read_camera(toml(text))
    assert "north.toml" in str(caught.value) and "\n" not in str(caught.value)


def test_the_keys_of_a_camera_without_a_focal_length_can_be_read(toml):
    assert read_camera_keys(toml("width_px = 640")) == {"width_px": 640}
    with pytest.raises(InputError, match="heading_deg is 500; wanted a number"):
        read_camera_keys(toml("width_px = 640\nheading_deg = 500"))


def test_a_camera_without_poses_stands_still(toml):
    cam = read_camera(toml(LEAST + "east_m = 3\nnorth_m = 4\nheading_deg = 90\npitch_deg = 5"))
    same, found = poses_at(cam, None, np.array([1, 7, 7]))
    assert same == cam
    assert np.array_equal(found.place, [[3, 4]] * 3)
    assert np.allclose(found.heading_rad, np.pi / 2) and np.allclose(found.pitch_rad, np.radians(5))


def test_poses_go_straight_on_between_samples_and_turn_the_shorter_way(toml, poses):
    cam = read_camera(toml(LEAST + "pitch_deg = 5"))
    table = read_poses(poses("frame,east_m,north_m,heading_deg\n1,0,0,350\n\n5,8,-4,10\n"))
    _, found = poses_at(cam, table, np.array([1, 2, 3, 5]))
    assert np.allclose(found.place, [[0, 0], [2, -1], [4, -2], [8, -4]])
    assert np.allclose(np.degrees(found.heading_rad) % 360, [350, 355, 0, 10])
    assert np.allclose(found.pitch_rad, np.radians(5))


def test_poses_go_on_over_180_degrees_of_longitude(toml, poses):
    table = read_poses(poses("frame,longitude_deg,latitude_deg\n1,179.9999,-17\n3,-179.9997,-17\n"))
    _, found = poses_at(read_camera(toml(LEAST)), table, np.array([1, 2, 3]))
    assert np.allclose(found.place[:, 0], [179.9999, -179.9999, -179.9997])


def test_poses_by_time_need_a_rate(toml, poses):
    cam = read_camera(toml(LEAST))
    table = read_poses(poses("time_s,longitude_deg,latitude_deg\n0,10,50\n1,10.001,50\n"))
    moved, found = poses_at(cam, table, np.array([1, 6, 11]), rate_hz=10)
    assert moved.geographic and np.allclose(found.place[:, 0], [10, 10.0005, 10.001])
    with pytest.raises(InputError, match="by time_s; say with --rate how many frames a second"):
        poses_at(cam, table, np.array([1]))


def test_poses_that_do_not_cover_the_frames_are_said(toml, poses):
    table = read_poses(poses("frame,heading_deg\n1,0\n40,10\n"))
    with pytest.raises(InputError, match=r"cover frames 1 to 40; 2 of 3 rows .* the first at frame 41"):
        poses_at(read_camera(toml(LEAST)), table, np.array([40, 41, 50]))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("east_m,north_m\n1,2\n", "wanted frame or time_s among them"),
        ("frame,altitude\n1,2\n", "wanted any of longitude_deg"),
        ("frame,east_m\n1,2\n", "wanted east_m and north_m together"),
        ("frame,east_m,north_m,longitude_deg,latitude_deg\n1,2,3,4,5\n", "in degrees or in metres"),
        ("frame,heading_deg\n", "a header but no rows"),
        ("frame,heading_deg\n1,2\n1,3\n", "line 3: frame goes from 1 to 1; wanted each after"),
        ("frame,heading_deg\n1,north\n", "line 2: heading_deg is 'north'; wanted a number from -360 to 360"),
        ("frame,pitch_deg\n1\n", "line 2: pitch_deg is missing: the line ends before it"),
        ("frame,heading_deg,heading_deg\n1,2,3\n", "heading_deg is named twice"),
        ("", "its columns are none"),
    ],
)
def test_a_mistake_in_poses_is_named(poses, text, words):
    with pytest.raises(InputError, match=words) as caught:
        read_poses(poses(text))
    assert "poses.csv" in str(caught.value)
