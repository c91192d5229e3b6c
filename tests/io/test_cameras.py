"""Cameras and colours from TOML, poses and measurements from CSV: what they mean, and one line for each mistake."""

import math

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import poses_at
from torchvision_dddas.io.camera_files import (
    describe_missing,
    has_measurements,
    read_camera,
    read_camera_keys,
    read_measurements,
    read_poses,
)
from torchvision_dddas.io.colour_files import find_overlaps, format_colours, read_colours
from torchvision_dddas.types import Colours

LEAST = "focal_px = 1000\nwidth_px = 640\nheight_px = 480\n"


@pytest.fixture
def write(tmp_path):
    def write(text, name="north.toml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def test_the_least_that_a_camera_needs(write):
    camera = read_camera(write(LEAST))
    assert (camera.name, camera.size_px, camera.focal_px) == ("north", (640, 480), (1000.0, 1000.0))
    assert (camera.centre_px, camera.place, camera.geographic) == ((319.5, 239.5), (0.0, 0.0), False)
    assert math.isnan(camera.height_m) and camera.heading_rad == camera.pitch_rad == camera.k1 == 0
    assert read_camera_keys(write("width_px = 640")) == {"width_px": 640}
    assert describe_missing(write("width_px = 640")).endswith(
        " has no height_m: distances from the foot row are unknown; no pitch_deg: a level camera is assumed; "
        "no heading_deg: north is assumed; no place: 0, 0 is assumed"
    )


def test_every_key_reaches_the_camera(write):
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
    p1 = 0.001
    p2 = -0.002
    k3 = 0.03
    focal_sigma = 0.02
    height_sigma_m = 0.1
    pitch_sigma_deg = 1
    heading_sigma_deg = 5
    position_sigma_m = 0.5
    """
    camera = read_camera(write(text))
    assert camera.name == "Rover 2" and camera.focal_px == pytest.approx((320, 330))
    assert (camera.centre_px, camera.place, camera.geographic) == ((310, 250), (-110.95, 32.23), True)
    angles = (camera.pitch_rad, camera.roll_rad, camera.heading_rad, camera.pitch_sigma_rad, camera.heading_sigma_rad)
    assert np.degrees(angles) == pytest.approx([10, -1, 90, 1, 5])
    assert (camera.height_m, *camera.distortion) == (1.2, -0.1, 0.01, 0.001, -0.002, 0.03)
    assert (camera.focal_sigma, camera.height_sigma_m, camera.position_sigma_m) == (0.02, 0.1, 0.5)
    assert describe_missing(write(text)) == ""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("width_px = 640\nheight_px = 480", "has no focal length (focal_px). `dddas calibrate` finds it"),
        (LEAST + "hfov_deg = 60", "both focal_px and hfov_deg; give one"),
        ("focal_px = 1000", "lacks width_px, height_px"),
        (LEAST + "focal = 3", "has the unknown key focal; did you mean focal_px"),
        (LEAST + "height_m = -1", "height_m is -1; wanted a number from 0.01 to 1000"),
        (LEAST + 'pitch_deg = "down"', "pitch_deg is 'down'; wanted a number from -89 to 89"),
        (LEAST + "heading_deg = true", "heading_deg is True; wanted a number"),
        (LEAST + "latitude_deg = 3", "latitude_deg alone; give longitude_deg and latitude_deg"),
        (LEAST + "latitude_deg = 3\nlongitude_deg = 4\neast_m = 1\nnorth_m = 1", "in degrees or in metres"),
        (LEAST + "centre_px = [1, 2, 3]", "centre_px is [1, 2, 3]; wanted [u, v]"),
        (LEAST + "name = 3", "name is 3; wanted a text in quotes"),
        (LEAST.replace("640", "640.5"), "width_px is 640.5; wanted a whole number"),
        (LEAST + "k1 = 0x" + "f" * 9999, "k1 is far too large; wanted a number from -10 to 10"),
        (LEAST + "k1 = " + "9" * 9999, "is not valid TOML: Exceeds the limit"),
        (LEAST + "name = " + "[" * 5000, "its brackets are nested too deeply"),
        ("focal_px == 3", "is not valid TOML"),
    ],
)
def test_a_mistake_in_a_camera_is_one_clear_line(refused, text, words):
    assert words in refused(read_camera, text, "north.toml")


# -- Poses and measurements --------------------------------------------------------------------------------------------


def test_a_camera_without_poses_stands_still(write):
    camera = read_camera(write(LEAST + "east_m = 3\nnorth_m = 4\nheading_deg = 90\npitch_deg = 5"))
    same, poses = poses_at(camera, None, np.array([1, 7, 7]))
    assert same == camera and np.array_equal(poses.place, [[3, 4]] * 3)
    assert np.allclose(poses.heading_rad, np.pi / 2) and np.allclose(poses.pitch_rad, np.radians(5))


def test_poses_go_straight_on_between_samples_and_turn_the_shorter_way(write):
    camera = read_camera(write(LEAST + "pitch_deg = 5"))
    table = read_poses(write("frame,east_m,north_m,heading_deg\n1,0,0,350\n\n5,8,-4,10\n", "p.csv"))
    _, poses = poses_at(camera, table, np.array([1, 2, 3, 5]))
    assert np.allclose(poses.place, [[0, 0], [2, -1], [4, -2], [8, -4]])
    assert np.allclose(np.degrees(poses.heading_rad) % 360, [350, 355, 0, 10])
    assert np.allclose(poses.pitch_rad, np.radians(5))
    table = read_poses(write("frame,longitude_deg,latitude_deg\n1,179.9999,-17\n3,-179.9997,-17\n", "p.csv"))
    _, poses = poses_at(camera, table, np.array([1, 2, 3]))
    assert np.allclose(poses.place[:, 0], [179.9999, -179.9999, -179.9997])


def test_poses_need_a_rate_where_they_are_by_time_and_must_cover_the_frames(write):
    camera = read_camera(write(LEAST))
    table = read_poses(write("time_s,longitude_deg,latitude_deg\n0,10,50\n1,10.001,50\n", "p.csv"))
    moved, poses = poses_at(camera, table, np.array([1, 6, 11]), rate_hz=10)
    assert moved.geographic and np.allclose(poses.place[:, 0], [10, 10.0005, 10.001])
    with pytest.raises(InputError, match="by time_s; give the number of frames a second with --rate"):
        poses_at(camera, table, np.array([1]))
    table = read_poses(write("frame,heading_deg\n1,0\n40,10\n", "p.csv"))
    with pytest.raises(InputError, match=r"cover frames 1 to 40; 2 of 3 rows .* the first at frame 41"):
        poses_at(camera, table, np.array([40, 41, 50]))


def test_measurements_are_known_by_their_columns(write):
    path = write("height_px, distance_m ,note\n180,10,x\n91,20,\n", "m.csv")
    assert has_measurements(path) and not has_measurements(path.parent)
    assert [column.tolist() for column in read_measurements(path)] == [[10, 20], [180, 91]]


@pytest.mark.parametrize(
    ("read", "text", "words"),
    [
        (read_poses, "east_m,north_m\n1,2\n", "wanted frame or time_s among them"),
        (read_poses, "frame,altitude\n1,2\n", "wanted any of longitude_deg"),
        (read_poses, "frame,east_m\n1,2\n", "wanted east_m and north_m together"),
        (read_poses, "frame,east_m,north_m,longitude_deg,latitude_deg\n1,2,3,4,5\n", "in degrees or in metres"),
        (read_poses, "frame,heading_deg\n", "a header but no rows"),
        (read_poses, "frame,heading_deg\n1,2\n1,3\n", "line 3: frame goes from 1 to 1; wanted rising values"),
        (read_poses, "frame,heading_deg\n1,north\n", "line 2: heading_deg is 'north'; wanted a number from -360"),
        (read_poses, "frame,pitch_deg\n1\n", "line 2: pitch_deg is missing: the line ends before it"),
        (read_poses, "frame,heading_deg,heading_deg\n1,2,3\n", "heading_deg is named twice"),
        (read_poses, "", "its columns are none"),
        (read_measurements, "distance_m,height_px\n", "a header but no rows"),
        (read_measurements, "distance_m,height_px\n0,5\n", "line 2: distance_m is '0'; wanted a number above 0"),
    ],
)
def test_a_mistake_in_a_table_is_one_clear_line(refused, read, text, words):
    assert words in refused(read, text)


# -- Colours -----------------------------------------------------------------------------------------------------------


def test_colours_are_read_in_order_and_what_is_written_is_read_again(write):
    ranges = np.array([[172, 90, 60], [20, 0, 0], [60, 1, 1]]), np.array([[8, 255, 255], [40, 255, 255], [90, 200, 9]])
    written = Colours(("red", "rover 2", 'the "big" one'), *ranges)
    found = read_colours(write(format_colours(written)))
    assert found.names == written.names
    assert (found.low == written.low).all() and (found.high == written.high).all()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "names no colour"),
        ("[red", "is not valid TOML"),
        ("red = 3", "red lacks low or high"),
        ("[red]\nlow = [1, 2, 3]", "red lacks low or high"),
        ("[red]\nlow = [1, 2, 3]\nhigh = [2, 3, 4]\nhue = 1", "red has the unknown key hue"),
        ("[red]\nlow = [1, 2]\nhigh = [2, 3, 4]", "red.low is [1, 2]; wanted [hue, saturation, value]"),
        ("[red]\nlow = [1, 2, 3]\nhigh = [190, 3, 4]", "red.high is [190, 3, 4]; wanted"),
        ("[red]\nlow = [1.5, 2, 3]\nhigh = [9, 3, 4]", "red.low is [1.5, 2, 3]; wanted"),
        ("[red]\nlow = [1, 9, 3]\nhigh = [2, 3, 4]", "red's lowest saturation 9 is above its highest 3"),
        (
            "[red]\nlow = [170, 0, 0]\nhigh = [5, 255, 255]\n[orange]\nlow = [5, 0, 0]\nhigh = [15, 255, 255]",
            "red and orange overlap",
        ),
    ],
)
def test_a_mistake_in_colours_is_one_clear_line(refused, text, words):
    line = refused(read_colours, text, "colours.toml")
    assert words in line and line.startswith("colours ")


def test_ranges_overlap_only_where_hue_saturation_and_value_all_do():
    low = np.array([[170, 100, 0], [0, 0, 0], [176, 100, 200], [11, 0, 0]])
    high = np.array([[5, 255, 199], [10, 99, 255], [179, 255, 255], [20, 99, 255]])
    assert find_overlaps(low, high) == []
    high[1] = (10, 100, 255)
    assert find_overlaps(low, high) == [(0, 1)]
    # A hue of 180 is that of 0.
    assert find_overlaps(np.array([[175, 0, 0], [0, 0, 0]]), np.array([[180, 9, 9], [3, 9, 9]])) == [(0, 1)]
