"""What still pictures say of themselves: EXIF and XMP."""

import math

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry import read_telemetry

Image = pytest.importorskip("PIL.Image")

XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description drone-dji:GimbalYawDegree="+111.30" '
    'drone-dji:GimbalPitchDegree="-60.00" drone-dji:GimbalRollDegree="+0.50" drone-dji:FlightYawDegree="+110.60" '
    'drone-dji:RelativeAltitude="+61.10" drone-dji:AbsoluteAltitude="+422.55" {}/></x:xmpmeta>'
)


@pytest.fixture
def photo(tmp_path):
    """Makes a JPEG of 64 x 48 px with this XMP and these entries of EXIF."""

    def make(name="a.jpg", xmp="", gps=None, taken=None, turned=1):
        exif = Image.Exif()
        exif.get_ifd(0x8825).update(gps or {})
        exif.get_ifd(0x8769).update(taken or {})
        exif[0x0112] = turned
        Image.new("RGB", (64, 48)).save(tmp_path / name, exif=exif, xmp=xmp.encode())
        return tmp_path / name

    return make


GPS = {1: "N", 2: (45.0, 2.0, 15.0), 3: "W", 4: (94.0, 20.0, 60.0), 5: b"\0", 6: 422.0}


def test_a_drones_picture_tells_its_place_its_heights_and_where_it_looks(photo):
    taken = {0x9003: "2020:06:04 22:10:30", 0x9011: "-05:00", 0xA405: 24}
    flown = read_telemetry(photo(xmp=XMP.format(""), gps=GPS, taken=taken))
    np.testing.assert_allclose(flown.place, [[-94.35, 45.0375]])
    assert (flown.altitude_m[0], flown.above_sea_m[0], flown.height_zero) == (61.1, 422.55, "takeoff")
    angles = [flown.heading_rad[0], flown.pitch_rad[0], flown.roll_rad[0]]
    np.testing.assert_allclose(np.degrees(angles), [111.3, 60.0, 0.5])
    # As for 35 mm, of equal diagonals: 64 x 48 px of a 4:3 sensor are 34.6 x 26.0 mm of film.
    assert flown.is_nominal and flown.hfov_rad[0] == pytest.approx(2 * math.atan(math.hypot(36, 24) * 0.8 / 2 / 24))
    assert flown.start_utc_s == 1591326630  # 2020-06-05T03:10:30Z


def test_a_picture_of_rtk_tells_the_error_of_its_place(photo):
    flown = read_telemetry(photo(xmp=XMP.format('drone-dji:RtkStdLon="0.3" drone-dji:RtkStdLat="0.4"'), gps=GPS))
    assert flown.position_sigma_m[0] == pytest.approx(0.5 / math.sqrt(2))
    assert np.isnan(read_telemetry(photo(xmp=XMP.format(""), gps=GPS)).position_sigma_m[0])


@pytest.mark.parametrize(("said", "sigma_m"), [("99", 99.0), ("-1", np.nan), ("0", np.nan)])
def test_a_large_error_of_a_place_counts_and_a_value_that_is_none_is_unknown(photo, said, sigma_m):
    flown = read_telemetry(photo(xmp=XMP.format(f'drone-dji:RtkStdLon="{said}" drone-dji:RtkStdLat="{said}"'), gps=GPS))
    assert flown.position_sigma_m[0] == pytest.approx(sigma_m, nan_ok=True)
    assert ("aerial.position_sigma_m is used there" in "".join(flown.notes)) == (said == "0")


def test_the_calibrated_focal_length_counts_first_and_a_cut_picture_is_named(photo):
    lens = 'drone-dji:CalibratedFocalLength="{}" drone-dji:CalibratedOpticalCenterX="320" '
    whole = lens.format(600) + 'drone-dji:CalibratedOpticalCenterY="240"'
    flown = read_telemetry(photo(xmp=XMP.format(whole), gps=GPS, taken={0xA405: 24}))
    assert flown.hfov_rad[0] == pytest.approx(2 * math.atan(320 / 600)) and not flown.is_nominal
    cut = lens.format(600) + 'drone-dji:CalibratedOpticalCenterY="180"'
    flown = read_telemetry(photo(xmp=XMP.format(cut), gps=GPS, taken={0xA405: 24}))
    assert np.isnan(flown.hfov_rad[0]) and "is cut from a picture of about 640x360" in flown.notes[0]


def test_a_picture_that_is_shown_turned_has_the_field_of_view_of_its_shorter_side(photo):
    lens = 'drone-dji:CalibratedFocalLength="600" drone-dji:CalibratedOpticalCenterX="320" '
    path = photo(xmp=XMP.format(lens + 'drone-dji:CalibratedOpticalCenterY="240"'), gps=GPS, turned=6)
    assert read_telemetry(path).hfov_rad[0] == pytest.approx(2 * math.atan(240 / 600))


@pytest.mark.parametrize("written", [lambda x: x.replace('"', "'"), str.lower])
def test_xmp_is_read_with_either_quotes_and_in_any_case(photo, written):
    assert read_telemetry(photo(xmp=written(XMP.format("")), gps=GPS)).altitude_m[0] == 61.1


def test_a_direction_from_magnetic_north_is_named_and_not_used(photo):
    flown = read_telemetry(photo(gps={**GPS, 16: "M", 17: 200.0}))
    assert np.isnan(flown.heading_rad).all() and "magnetic north" in flown.notes[0]


@pytest.mark.parametrize("said", ['AltitudeType="RtkAlt"', 'RtkFlag="50"'])
def test_heights_by_rtk_count_from_the_ellipsoid(photo, said):
    flown = read_telemetry(photo(xmp=XMP.format(f"drone-dji:{said}"), gps=GPS))
    assert flown.above_ellipsoid_m[0] == 422.55 and np.isnan(flown.above_sea_m[0])


def test_the_pictures_of_a_folder_are_a_row_each_at_the_rate_of_the_clip(photo, tmp_path):
    for k in range(3):
        photo(f"{k}.jpg", XMP.format("").replace("61.10", f"{60 + k}"), GPS)
    flown = read_telemetry(tmp_path, rate_hz=2.0)
    assert flown.time_s.tolist() == [0.0, 0.5, 1.0] and flown.altitude_m.tolist() == [60, 61, 62]
    with pytest.raises(InputError, match="give its clip, or --rate"):
        read_telemetry(tmp_path)


def test_pictures_of_a_folder_are_the_frames_of_its_clip(photo, tmp_path):
    photo("DJI_9.jpg", XMP.format(""), GPS)
    photo("DJI_10.jpg", XMP.format("").replace("61.10", "70"), GPS)
    (tmp_path / "DJI_11.jpg").write_bytes(b"nothing")
    (tmp_path / "._DJI_9.jpg").write_bytes(b"nothing")
    flown = read_telemetry(tmp_path, rate_hz=1.0)
    np.testing.assert_equal(flown.altitude_m, [61.1, 70.0, np.nan])
    assert any("DJI_11.jpg cannot be read" in note for note in flown.notes)


@pytest.mark.parametrize(
    ("content", "says"), [(b"\xff\xd8\xff\xe0nothing", "cannot be read as a picture"), (None, "holds a place")]
)
def test_a_picture_that_tells_nothing_is_one_line(photo, tmp_path, content, says):
    path = photo()
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=says):
        read_telemetry(path)


def test_a_folder_without_pictures_is_one_line(tmp_path):
    with pytest.raises(InputError, match="holds no images"):
        read_telemetry(tmp_path)
