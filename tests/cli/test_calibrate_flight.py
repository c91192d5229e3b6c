"""`dddas calibrate-flight`: the configuration that it writes, and one line for each mistake."""

import re

import numpy as np
import pytest

from tests.airborne import CAMERA
from tests.cli.conftest import bad
from tests.geo.test_flight_calibration import estimate, looks, turned_looks
from torchvision_dddas.cli.calibrate_flight import describe_errors
from torchvision_dddas.config import AerialParameters, load_config

LOOKS = looks(20)
HEAD = "frame,landmark,u_px,v_px,east_m,north_m,sigma_m"
POINTS = [
    f"{look.frame},P{k},{pixel[0]:.3f},{pixel[1]:.3f},{place[0]:.4f},{place[1]:.4f},0.05"
    for look in LOOKS
    for k, pixel, place in zip(look.marks.landmark, look.marks.image_px, look.marks.east_north_m, strict=True)
]


@pytest.fixture
def calibrate(dddas, file, tmp_path):
    """Run the command on the files of a flight; out: the file to write."""
    log = ["time_s,east_m,north_m,altitude_m,heading_deg,pitch_deg,roll_deg"]
    for look in LOOKS:
        row = look.time_s, *look.prior.pose.place_m, *np.degrees(look.prior.pose.angles_rad)
        log.append(",".join(f"{value:.6f}" for value in row))
    camera = "focal_px = {}\nwidth_px = {}\nheight_px = {}\n".format(CAMERA.focal_px[0], *CAMERA.size_px)

    def run(*more, head=HEAD, points=POINTS, out=tmp_path / "flight.toml"):
        names = file("p.csv", "\n".join([head, *points])), file("t.csv", "\n".join(log)), file("c.toml", camera)
        words = [names[0], "--telemetry", names[1], "--camera", names[2], "--rate", 1 / 60, "--out", out]
        return dddas("calibrate-flight", *words, *more)

    return run


def test_the_errors_of_a_log_become_a_configuration(calibrate, tmp_path):
    result = calibrate()
    assert result.exit_code == 0, result.output
    assert "60 points in 20 pictures" in result.stdout and "heading deg" in result.stdout
    aerial = load_config(tmp_path / "flight.toml").aerial
    assert aerial.heading_offset_deg == pytest.approx(4.0, abs=1.0)
    assert 0.8 < aerial.heading_sigma_deg < 2.5 and aerial.tilt_sigma_deg < 0.9
    again = calibrate("--config", tmp_path / "flight.toml", out=tmp_path / "again.toml")
    assert re.search(r"heading deg +[+-]0\.0", again.stdout)


@pytest.mark.parametrize(("offset_deg", "way"), [(1.0, "lower"), (-1.0, "higher")])
def test_a_camera_that_looks_lower_or_higher_than_its_log_is_noted(offset_deg, way):
    errors = estimate(turned_looks([-offset_deg, 0.0], (40.0, 60.0)))
    text = "\n".join(describe_errors(errors, errors.settings(AerialParameters())))
    assert re.search(rf"the camera looks [01]\.\d deg {way} than the log says; aerial.pitch_offset_deg corrects", text)


def test_what_is_missing_is_said_in_one_line(calibrate, tmp_path):
    assert "at least 6 pictures with points are needed" in bad(calibrate(points=POINTS[:6]))
    bare = [",".join(np.delete(row.split(","), [2, 3])) for row in POINTS]
    assert "no row has u_px,v_px" in bad(calibrate(head=HEAD.replace("u_px,v_px,", ""), points=bare))
    late = [row.replace(",", "9999,", 1) for row in POINTS]
    assert "the telemetry has no data for this time" in bad(calibrate(points=late))
    assert "p.csv is a file that this run writes" in bad(calibrate(out=tmp_path / "p.csv"))


def test_points_without_sigma_are_noted(calibrate):
    result = calibrate(head=HEAD.removesuffix(",sigma_m"), points=[row.rpartition(",")[0] for row in POINTS])
    assert "points without sigma_m get the standard deviation 1.43 m" in result.stdout
