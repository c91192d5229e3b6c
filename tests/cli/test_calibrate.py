"""`dddas calibrate`: the camera that it writes, and one line for each mistake."""

import numpy as np
import pytest

from tests.upright import boxes, camera
from torchvision_dddas.io.camera_files import read_camera

PERSON = ("--body-height", 1.8, "--distance", 9)


def test_a_person_at_a_known_distance_gives_the_focal_length(dddas, tmp_path):
    out = tmp_path / "camera.toml"
    result = dddas("calibrate", *PERSON, "--pixels", 200, "--size", "640x480", "--out", out)
    assert result.exit_code == 0, result.output
    assert result.stdout == f"focal length 1000.0 ± 30.0 px from 1 measurement\n{out}: the camera\n"
    found = read_camera(out)
    assert (found.focal_px, found.size_px) == ((1000.0, 1000.0), (640, 480))
    assert found.focal_sigma == pytest.approx(0.03)


def test_without_out_the_camera_alone_is_on_stdout(dddas, file):
    result = dddas("calibrate", *PERSON, "--pixels", 200, "--pixels", 202)
    assert result.exit_code == 0 and result.stdout.splitlines()[0] == "focal_px = 1005.0"
    assert "focal length 1005.0" in result.stderr
    table = file("t.txt", "1,-1,10,10,50,200,1\n2,-1,12,10,50,200,1\n")
    assert "focal length 1000.0" in dddas("calibrate", table, *PERSON).stderr  # the boxes of one person


def test_many_distances_and_an_outlier(dddas, file, tmp_path):
    text = "distance_m,height_px\n3,600\n6,300\n9,200\n12,90\n18,100\n"
    result = dddas("calibrate", file("m.csv", text), "--body-height", 1.8, "--out", tmp_path / "camera.toml")
    assert "1 of 5 left out as outliers, the first 90 px at 12 m" in result.stdout
    assert "width_px and height_px are still missing (--size)" in result.stdout
    assert "focal_px = 1000.0" in (tmp_path / "camera.toml").read_text()


def test_people_all_over_the_picture_tell_how_the_camera_stands(dddas, file, tmp_path):
    rng = np.random.default_rng(0)
    people = np.stack([rng.uniform(-3, 3, 60), rng.uniform(8, 25, 60)], axis=1)
    seen = enumerate(boxes(people, 1.75, camera(height_m=3.0, pitch_rad=0.1)), 1)
    table = file("t.txt", "\n".join("{},-1,{:.3f},{:.3f},{:.3f},{:.3f},1".format(n, *box) for n, box in seen))
    known = file("known.toml", "focal_px = 1000\nwidth_px = 1280\nheight_px = 960\nheading_deg = 30\n")
    out = tmp_path / "camera.toml"
    result = dddas("calibrate", table, "--camera", known, "--body-height", 1.75, "--out", out)
    assert result.exit_code == 0, result.output
    found = read_camera(out)
    placed = (found.height_m, found.pitch_rad, found.heading_rad)
    assert placed == pytest.approx((3.0, 0.1, np.radians(30)), abs=1e-3)


def test_a_camera_without_focal_length_is_completed(dddas, file, tmp_path):
    place = "longitude_deg = -110.1234567\nlatitude_deg = 32\n"
    known = file("known.toml", f'name = "a \\"rover\\" \\U0001F600\\u007F"\nwidth_px = 640\nheight_px = 480\n{place}')
    out = tmp_path / "camera.toml"
    assert dddas("calibrate", *PERSON, "--pixels", 200, "--camera", known, "--out", out).exit_code == 0
    found = read_camera(out)
    assert (found.name, found.focal_px[0], found.place) == ('a "rover" \U0001f600\x7f', 1000.0, (-110.1234567, 32.0))
