"""Files of platforms: each mistake in one line."""

import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.platform_files import read_platform

CAMERA = """
[camera]
width_px = 640
height_px = 480
focal_px = 600
height_m = 1.2
heading_deg = 10
east_m = 1
north_m = 2
"""


def test_a_camera_may_be_a_table_and_paths_count_from_the_file(tmp_path):
    path = tmp_path / "ugv1.toml"
    path.write_text('clip = "a.mp4"\nstarts_s = 2\n' + CAMERA)
    found = read_platform(path)
    assert found.name == "ugv1" and found.clip == str(tmp_path / "a.mp4") and found.starts_s == 2.0
    assert (found.camera.focal_px, found.camera.place) == ((600, 600), (1, 2)) and "pitch_deg" in found.notes[0]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("clip = 'a.mp4'", "lacks camera"),
        (CAMERA, "lacks clip"),
        ("clip = 'a.mp4'\ncamra = 'b.toml'\n" + CAMERA, "did you mean camera"),
        ("clip = 3\n" + CAMERA, "clip is '3'; wanted a text"),
        ("clip = 'a.mp4'\ndetections = 'b.csv'\n" + CAMERA, "clip and detections"),
        ("detections = 'b.csv'\n" + CAMERA, "rate_hz"),
        ("detections = 'b.csv'\nrate_hz = 5\ninterval = 2\n" + CAMERA, "interval and detections"),
        ("clip = 'a.mp4'\nstarts_s = true\n" + CAMERA, "wanted a number"),
        ("clip = 'a.mp4'\ninterval = 0\n" + CAMERA, "interval"),
        ("clip = 'a.mp4'\ninterval = 2.5\n" + CAMERA, "wanted a whole number"),
        ("clip = 'a.mp4'\ntelemetry = 'b.csv'\n" + CAMERA, "is this a file for --aerial"),
        ("clip = ''\n" + CAMERA, "clip is empty"),
        ("clip = 'a.mp4'\nstarts_utc = 2026-05-01T12:00:00\n" + CAMERA, "time zone"),
        ("clip = 'a.mp4'\nposes = 'none.csv'\n" + CAMERA, "none.csv"),
        ("clip = 'a.mp4'\n" + CAMERA + "focal = 3\n", "has the unknown key focal; did you mean focal_px"),
        ("clip = 'a.mp4'\n" + CAMERA.partition("east_m")[0], "has no place"),
        ("clip = 'a.mp4'\nname = 'a;b:1'\n" + CAMERA, "without ; and :"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path, text, says):
    path = tmp_path / "ugv1.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=says) as raised:
        read_platform(path)
    assert "\n" not in str(raised.value)
