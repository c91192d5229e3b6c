"""Heights count from the ellipsoid, the sea, the take-off point or the ground: each is used as what it is, or noted."""

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.airborne import CAMERA
from tests.overflight import Overflight
from tests.upright import camera as upright_camera
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import AerialLocator, GroundLocator
from torchvision_dddas.geometry import geoid_height
from torchvision_dddas.io.ground_tables import read_landmarks
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.io.telemetry.fields import Names
from torchvision_dddas.types import Elevation, People, Telemetry, Tracks

ORIGIN = (-110.95, 32.23)
GEOID_M = float(geoid_height(np.array([ORIGIN]))[0])
GROUND_M, HIGH_M = 720.0, 60.0


def log(**heights):
    """A log over ORIGIN of a camera that looks north and 45 degrees down."""
    two = np.ones(2)
    columns = {name: value * two for name, value in heights.items() if name != "height_zero"}
    zero = heights.get("height_zero", "ground")
    return Telemetry(
        np.array([0.0, 1.0]), columns.pop("altitude_m", np.nan * two), 0 * two, np.tile(ORIGIN, (2, 1)), True,
        heading_rad=0 * two, pitch_rad=np.pi / 4 * two, roll_rad=0 * two, height_zero=zero, **columns,
    )  # fmt: skip


def level(height_m=GROUND_M, up_m=0.0):
    return Elevation(np.full((101, 101), up_m), (-500.0, -500.0), 10.0, height_m)


def place(telemetry, elevation=None, camera=CAMERA, **parameters):
    """The locator, and the position of a target in the picture's middle."""
    settings = with_parameters(Settings(), {"aerial.own_sigma": 0.0, "aerial.point": "centre", **parameters})
    locator = AerialLocator(camera, telemetry, elevation=elevation, settings=settings)
    box = np.array([[959.5 - 2, 539.5 - 2, 5.0, 5.0]])
    return locator, locator.locate(Tracks(1, np.array([1]), box, np.ones(1), np.zeros(1, int))).positions


@pytest.mark.parametrize(
    ("latitude", "longitude", "metres"),
    [
        (38.6281550, 269.7791550, -31.63),
        (-14.6212170, 305.0211140, -2.97),
        (46.8743190, 102.4487290, -43.57),
        (-23.6174460, 133.8747120, 15.87),
        (38.6254730, 359.9995000, 50.07),
        (-0.4667440, 0.0023000, 17.33),
    ],
)
def test_the_table_of_the_geoid_has_the_values_that_nga_published_with_egm96(latitude, longitude, metres):
    assert geoid_height(np.array([[longitude, latitude]]))[0] == pytest.approx(metres, abs=2.0)
    assert geoid_height(np.array([[longitude - 360, latitude]]))[0] == pytest.approx(metres, abs=2.0)


def test_the_geoid_goes_on_over_the_date_line_and_to_the_poles_and_is_unknown_where_a_place_is():
    found = geoid_height(np.array([[180.0, 10.0], [-180.0, 10.0], [0.0, 90.0], [123.0, 90.0], [np.nan, 0.0]]))
    assert found[0] == found[1] and found[2] == pytest.approx(found[3]) and np.isnan(found[4])


def test_a_log_of_heights_above_the_ellipsoid_locates_as_one_of_heights_above_the_sea():
    sea = place(log(above_sea_m=GROUND_M + HIGH_M), level())[1]
    locator, found = place(log(above_ellipsoid_m=GROUND_M + HIGH_M + GEOID_M), level())
    np.testing.assert_allclose(found.east_north_m, [[0.0, HIGH_M]], atol=0.1)
    np.testing.assert_allclose(found.east_north_m, sea.east_north_m, atol=1e-6)
    assert any("less the geoid's -2" in note and "EGM96" in note for note in locator.notes)
    assert found.above_sea_m[0] == GROUND_M and found.above_ellipsoid_m[0] == pytest.approx(GROUND_M + GEOID_M)


@pytest.mark.parametrize(
    ("heights", "words"),
    [
        ({"altitude_m": 60.0, "above_sea_m": 60.0}, "altitude_m is the same as above_sea_m throughout"),
        ({"altitude_m": 60.0, "above_ellipsoid_m": 60.0}, "altitude_m is the same as above_ellipsoid_m throughout"),
        ({"altitude_m": 1523.0}, "1523 m or more throughout: does it count from the sea or the ellipsoid"),
        ({"altitude_m": 60.0, "above_sea_m": 780.0, "above_ellipsoid_m": 780.0 - GEOID_M}, "wrong sign"),
        ({"altitude_m": 60.0, "above_sea_m": 780.0, "above_ellipsoid_m": 780.0}, "both count from the same zero"),
        ({"altitude_m": 60.0, "above_sea_m": 780.0, "above_ellipsoid_m": 900.0}, "one of them counts from elsewhere"),
    ],
)
def test_heights_that_contradict_each_other_are_named(heights, words):
    assert any(words in note for note in place(log(**heights))[0].notes)


def test_heights_that_agree_are_not_named():
    agreeing = log(altitude_m=HIGH_M, above_sea_m=GROUND_M + HIGH_M, above_ellipsoid_m=GROUND_M + HIGH_M + GEOID_M)
    locator, found = place(agreeing)
    assert not locator.notes
    assert found.above_sea_m[0] == GROUND_M and found.above_ellipsoid_m[0] == pytest.approx(GROUND_M + GEOID_M)


def test_a_take_off_point_above_the_flight_is_named():
    camera = replace(CAMERA, takeoff_above_sea_m=900.0)
    locator, _ = place(log(altitude_m=HIGH_M, above_sea_m=780.0, height_zero="takeoff"), camera=camera)
    assert any("900 m, lies above the whole flight, 780 to 780 m" in note for note in locator.notes)


def test_an_altitude_that_is_the_height_above_the_sea_is_used_as_that_where_the_ground_is_known():
    found = place(log(altitude_m=GROUND_M + HIGH_M, above_sea_m=GROUND_M + HIGH_M), level())[1]
    np.testing.assert_allclose(found.east_north_m, [[0.0, HIGH_M]], atol=0.1)


def test_the_terrains_sigma_widens_an_ellipse_by_how_far_a_metre_of_ground_moves_the_place():
    flown = log(above_sea_m=GROUND_M + HIGH_M)
    bare, wide = (place(flown, level(), **{"aerial.terrain_sigma_m": sigma})[1] for sigma in (0.0, 3.0))
    moved = place(flown, level(up_m=0.1))[1].east_north_m - bare.east_north_m
    np.testing.assert_allclose(
        wide.covariance_m2[0] - bare.covariance_m2[0], 900 * moved.T @ moved, rtol=1e-6, atol=1e-6
    )


def test_the_datums_sigma_widens_an_ellipse_by_how_far_a_metre_of_altitude_moves_the_place():
    bare, wide = (place(log(altitude_m=HIGH_M), **{"aerial.datum_sigma_m": sigma})[1] for sigma in (0.0, 3.0))
    assert wide.covariance_m2[0, 1, 1] - bare.covariance_m2[0, 1, 1] == pytest.approx(9.0, rel=1e-3)
    assert wide.covariance_m2[0, 0, 0] == pytest.approx(bare.covariance_m2[0, 0, 0], rel=1e-6)


def bumpy(east_north):
    """Landmarks of an Overflight stand on mounds and in hollows of 6 m, targets on level ground."""
    east, north = np.asarray(east_north, float).T
    return np.where(np.hypot(east, north) > 14, 6 * np.sign(east), 0.0)


@pytest.mark.parametrize("datum", ["elevation_m", "above_ellipsoid_m"])
def test_the_heights_of_landmarks_count_in_the_pose(tmp_path, datum):
    flight = Overflight(ground=bumpy, geographic=True)
    rows = flight.landmarks_csv().splitlines()
    (tmp_path / "t.csv").write_text(flight.telemetry_csv())
    flown = read_telemetry(tmp_path / "t.csv")
    geoid_m = float(geoid_height(flown.place[:1])[0]) if datum == "above_ellipsoid_m" else 0.0
    up_m = [GROUND_M + geoid_m + bumpy(flight.marks(frame)) for frame in flight.numbers()]
    cells = [f"{rows[0]},{datum}"] + [f"{r},{u:.3f}" for r, u in zip(rows[1:], np.concatenate(up_m), strict=True)]
    (tmp_path / "l.csv").write_text("\n".join(cells) + "\n")
    (tmp_path / "bare.csv").write_text("\n".join(rows) + "\n")
    middle = (flight.size[0] - 1) / 2, (flight.size[1] - 1) / 2
    camera = replace(CAMERA, size_px=flight.size, focal_px=(flight.focal_px,) * 2, centre_px=middle)
    fixes = {}
    for name in ("l.csv", "bare.csv"):
        locator = AerialLocator(camera, flown, read_landmarks(tmp_path / name), rate_hz=flight.rate_hz)
        fixes[name] = locator.fix_frame(1, locator.landmarks_at(1)).fix
    assert all(fixes["l.csv"].is_used) and fixes["l.csv"].chi2 < 1
    # Without heights the landmarks fit only with errors many times as large as stated, and the fix says so.
    told = re.search(r"errors of landmarks taken ([\d.]+) times as large", fixes["bare.csv"].cause)
    assert told is not None and float(told[1]) > 10 and not fixes["l.csv"].cause


def test_what_cannot_be_used_of_landmarks_heights_is_named(tmp_path):
    rows = Overflight().landmarks_csv().splitlines()
    (tmp_path / "l.csv").write_text("\n".join([f"{rows[0]},elevation_m", *(f"{row},800" for row in rows[1:])]) + "\n")
    landmarks, flown = read_landmarks(tmp_path / "l.csv"), log(altitude_m=HIGH_M)
    for mode in ("homography", "paper"):
        settings = with_parameters(Settings(), {"aerial.mode": mode})
        notes = AerialLocator(CAMERA, flown, landmarks, settings=settings).notes
        assert any(f"heights of landmarks are not used: aerial.mode = {mode}" in note for note in notes)
    notes = AerialLocator(CAMERA, flown, landmarks, elevation=level()).notes
    assert any("elevation_m is +80 m from the elevation's heights there" in note for note in notes)
    local = replace(landmarks, geographic=False, above_ellipsoid_m=landmarks.elevation_m)
    assert any(
        "above_ellipsoid_m of landmarks in local metres is not used" in n
        for n in AerialLocator(CAMERA, None, local).notes
    )


def test_a_camera_on_the_ground_gives_its_height_to_the_people_that_it_sees():
    near, far = (replace(upright_camera(), elevation_m=height) for height in (GROUND_M, GROUND_M + 4))
    people = People(np.array([[600.0, 400, 40, 180]]), np.ones(1), np.ones(1), np.zeros(1, bool))
    found = GroundLocator(near).locate(people).positions
    assert found.above_sea_m.tolist() == [GROUND_M] * len(found) and len(found) == 1
    assert "720.0 to 724.0 m" in GroundLocator([near, far]).notes[0]


@pytest.mark.parametrize(
    ("names", "quantity"),
    [
        ("rel_alt relative_altitude above_takeoff_m", "above_takeoff_m"),
        ("abs_alt altitude_msl above_sea_m alt_amsl above_geoid_m", "above_sea_m"),
        ("above_ellipsoid_m alt_ellipsoid ellipsoid_height hae height_wgs84 hae_m", "above_ellipsoid_m"),
        ("geoid_separation geoidal_separation undulation geoid_height", "geoid_m"),
    ],
)
def test_the_names_of_each_datum_are_known(names, quantity):
    for name in names.split():
        found = Names().find(name)
        assert found is not None and found.field.quantity == quantity, name


def test_an_own_table_may_hold_heights_above_the_ellipsoid_and_the_take_off_point(tmp_path):
    header = "time_s,longitude_deg,latitude_deg,above_ellipsoid_m,above_takeoff_m\n"
    (tmp_path / "t.csv").write_text(header + "0,-110.95,32.23,750,60\n1,-110.95,32.23,751,61\n")
    flown = read_telemetry(tmp_path / "t.csv")
    assert flown.above_ellipsoid_m.tolist() == [750, 751] and flown.altitude_m.tolist() == [60, 61]
    assert flown.height_zero == "takeoff" and "table" in flown.origin


def test_a_raster_of_the_geoid_replaces_the_table(tmp_path):
    rasterio = pytest.importorskip("rasterio")
    corner = rasterio.transform.from_origin(-112.0, 34.0, 0.25, 0.25)
    shape = {"height": 12, "width": 12, "count": 1, "dtype": "float32"}
    with rasterio.open(tmp_path / "g.tif", "w", driver="GTiff", crs="EPSG:4326", transform=corner, **shape) as file:
        file.write(np.full((1, 12, 12), -31.5, "float32"))
    parameters = {"aerial.geoid": str(tmp_path / "g.tif")}
    locator, found = place(log(above_ellipsoid_m=GROUND_M + HIGH_M - 31.5), level(), **parameters)
    np.testing.assert_allclose(found.east_north_m, [[0.0, HIGH_M]], atol=0.1)
    assert any("-31.5 m (by aerial.geoid)" in note for note in locator.notes)
    away = replace(log(above_ellipsoid_m=900.0), place=np.tile((10.0, 50.0), (2, 1)))
    with pytest.raises(InputError, match=r"g\.tif has no height from -120 to 100 m at longitude 10"):
        place(away, level(), **parameters)
    with pytest.raises(InputError, match="no such file"):
        place(log(altitude_m=HIGH_M), **{"aerial.geoid": str(tmp_path / "none.tif")})
