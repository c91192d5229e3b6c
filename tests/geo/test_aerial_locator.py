"""The flow from landmarks, telemetry and boxes to places: on slopes, with the rule of the source, from colours."""

from dataclasses import replace

import numpy as np
import pytest

from tests.overflight import COLOURS_TOML, Overflight, pictures
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.detection import with_logged_focal
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import AerialLocator, LandmarkWatch, build_site, resolve_camera
from torchvision_dddas.geo.aerial_targets import Targets, reference_points
from torchvision_dddas.geo.plane_homography import load_solver
from torchvision_dddas.io.camera_files import read_aerial_camera, read_camera
from torchvision_dddas.io.colour_files import read_colours
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.io.ground_tables import read_landmarks
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.types import Camera, Detections, Elevation, Frame, Registration, Scene, Telemetry, Tracks


def hill(east_north):
    """A slope with a knoll in the middle, between the landmarks."""
    east, north = np.asarray(east_north, float).T
    return 0.1 * east + 0.05 * north + 4 * np.exp(-(east**2 + north**2) / 12**2)


def raster(ground, reach=260.0):
    """The ground as an elevation about its own origin."""
    k = np.arange(-reach, reach + 1)
    heights = ground(np.stack(np.meshgrid(k, k), axis=-1).reshape(-1, 2)).reshape(len(k), len(k))
    return Elevation(heights, (-reach, -reach), 1.0, 1300.0)


@pytest.fixture
def prepared(tmp_path):
    """A locator and a table for a flight in local metres."""

    def prepare(flight, elevation=None, telemetry=True, pictured=True, **parameters):
        texts = {"l.csv": flight.landmarks_csv(pictured=pictured), "tel.csv": flight.telemetry_csv()}
        for name, text in (texts | {"c.toml": flight.camera_toml(), "t.txt": flight.tracks_txt()}).items():
            (tmp_path / name).write_text(text)
        settings = with_parameters(Settings(), parameters)
        flown = read_telemetry(tmp_path / "tel.csv") if telemetry else None
        site = replace(build_site(read_landmarks(tmp_path / "l.csv"), flown), elevation=elevation)
        camera, known, _ = resolve_camera(read_camera(tmp_path / "c.toml"), None, flown, settings)
        locator = AerialLocator.from_site(site, camera, settings, load_solver("onboard"), flight.rate_hz, known)
        return locator, read_detections(tmp_path / "t.txt")

    return prepare


def flies(locator, **telemetry):
    """Replace parts of the telemetry."""
    locator.site = replace(locator.site, telemetry=replace(locator.site.telemetry, **telemetry))
    return locator


def test_single_pixels_are_located_in_any_order_without_changing_what_follows(prepared):
    flight = Overflight(frames=20, size=(640, 360), focal_px=457.0, height_m=45.0, heading_rad=0.3, rate_hz=8.0)
    locator, table = prepared(flight)
    for frame in (15, 3):
        found = locator.locate_pixels(flight.shown(frame, flight.targets(frame)), time_s=flight.time(frame))
        away = found.east_north_m - (flight.targets(frame) - flight.marks(1)[0])
        assert np.abs(away).max() < 0.5 and np.isfinite(found.covariance_m2).all()
    again = prepared(flight)[0]
    for one, other in zip(locator.locate_table(table), again.locate_table(table), strict=True):
        np.testing.assert_array_equal(one.positions.east_north_m, other.positions.east_north_m)


def test_a_pixel_above_the_horizon_has_no_place_and_the_others_keep_their_rows():
    flat = Telemetry(
        np.array([0.0, 1.0]),
        np.array([50.0, 50.0]),
        np.zeros(2),
        place=np.zeros((2, 2)),
        geographic=False,
        heading_rad=np.zeros(2),
        pitch_rad=np.full(2, np.radians(15)),
        roll_rad=np.zeros(2),
    )
    locator = AerialLocator(Camera("uav", (640, 480), (554.0, 554.0), (319.5, 239.5)), flat)
    found = locator.locate_pixels([[320, 5], [320, 470]], time_s=0.5)
    assert np.isnan(found.east_north_m[0]).all() and np.isfinite(found.east_north_m[1]).all()
    assert found.target.tolist() == [1, 2]
    with pytest.raises(InputError, match=r"shape \(N, 2\)"):
        locator.locate_pixels(np.array([320, 5]))
    with pytest.raises(InputError, match="nothing can be located at 99 s"):
        locator.locate_pixels([[320, 470]], time_s=99.0)


def test_a_place_of_the_camera_that_is_poorly_known_hides_no_target():
    poor = Telemetry(
        np.zeros(1),
        np.full(1, 50.0),
        np.zeros(1),
        place=np.zeros((1, 2)),
        geographic=False,
        heading_rad=np.zeros(1),
        pitch_rad=np.full(1, 1.2),
        position_sigma_m=np.full(1, 40.0),
    )
    locator = AerialLocator(Camera("uav", (640, 480), (554.0, 554.0), (319.5, 239.5)), poor)
    assert locator.locate_pixels([[320, 240]], time_s=0.0).covariance_m2[0, 0, 0] > 40**2


def test_on_a_slope_seen_at_45_degrees_the_raster_turns_metres_into_decimetres(prepared):
    flight = Overflight(pitch_deg=45, ground=hill, geographic=False, gps_m=0.1, pixel=0.5)

    def error(*elevation):
        locator, table = prepared(flight, *elevation)
        found = list(locator.locate_table(table))
        off = [g.positions.east_north_m - flight.targets(g.frame)[g.positions.target - 1] for g in found]
        return np.median(np.linalg.norm(np.concatenate(off), axis=1))

    assert error() > 1.0
    assert error(raster(hill)) < 0.3


def test_heights_above_sea_will_do_where_the_ground_is_known_and_one_below_the_ground_is_unknown(prepared):
    flight = Overflight(ground=hill, geographic=False)
    locator, _ = prepared(flight, raster(hill))
    height = np.array([flight.vehicle(frame)[2] for frame in flight.numbers()])
    flies(locator, altitude_m=np.full(len(height), np.nan), above_sea_m=height + 1300.0)
    assert locator.telemetry_at(0.0).altitude_m == pytest.approx(height[0], abs=0.01)
    locator, _ = prepared(Overflight(geographic=False))
    flown = locator.site.telemetry
    flies(locator, altitude_m=np.where(flown.time_s < 0.35, -2.0, flown.altitude_m))
    assert np.isnan(locator.telemetry_at(0.0).altitude_m)
    assert locator.telemetry_at(0.8).altitude_m == pytest.approx(50.0)


def test_a_landmark_where_the_raster_has_no_height_is_not_used(prepared):
    flight, holed = Overflight(ground=hill, geographic=False), raster(hill)
    row, column = (int(v) for v in np.rint(flight.marks(1)[2][::-1] + 260))
    holed.up_m[row - 5 : row + 6, column - 5 : column + 6] = np.nan
    locator, table = prepared(flight, holed)
    assert next(iter(locator.locate_table(table))).marks.landmark.tolist() == [0, 1, 3]


def test_the_point_of_a_box_is_its_feet_its_foot_or_its_centre():
    feet = np.array([[5.0, 9.0], [np.nan, np.nan]])
    targets = Targets(np.array([[0, 0, 11, 21.0]] * 2), np.array([1, 2]), np.ones(2, bool), np.ones(2), feet)
    points, lift = reference_points(targets, Settings().aerial, posed=True)
    assert (points.tolist(), lift.tolist()) == ([[5, 9], [5, 10]], [0, 0])
    # A homography alone cannot tell what lies above the ground.
    for posed, middle in ((True, 0.85), (False, 0)):
        bodies = replace(targets, feet_px=None, bodies=True)
        assert reference_points(bodies, Settings().aerial, posed)[1].tolist() == [middle, middle]


def test_without_a_cameras_file_the_field_of_view_is_the_telemetrys_or_a_guess():
    flown = Telemetry(np.zeros(3), np.full(3, 50.0), np.zeros(3), hfov_rad=np.radians([60.0, 60.0, 61.0]))
    camera, known, notes = resolve_camera(None, (1000, 600), flown, Settings())
    assert known and not notes and camera.focal_px[0] == pytest.approx(500 / np.tan(np.radians(30)))
    camera, known, (note,) = resolve_camera(None, (1000, 600), None, Settings())
    assert not known and "using 70 degrees" in note and camera.centre_px == (499.5, 299.5)


def test_the_rule_of_the_source_uses_four_of_six_and_says_when_more(prepared):
    flight, source = Overflight(landmarks=6, geographic=False), {"landmarks.rule": "source"}
    locator, table = prepared(flight, **source)
    assert {len(g.marks) for g in locator.locate_table(table)} == {4}
    locator, table = prepared(flight, **source, **{"landmarks.poor_speed_m_s": 0.3})
    busy = list(locator.locate_table(table))
    (moved,) = [a for g in busy for a in g.adjustments]
    assert len(busy[-1].marks) == 6 and (moved.parameter, moved.new) == ("landmarks.used", 6)


def test_places_over_the_date_line_are_near_each_other(prepared):
    flight = Overflight()
    locator, _ = prepared(flight)
    marks = read_landmarks(locator.site.landmarks.path)
    place = marks.place + np.array([-69.0500, 0.0])
    place[:, 0] = (place[:, 0] + 180) % 360 - 180
    moved = build_site(replace(marks, place=place), None)
    assert np.abs(moved.landmarks.place).max() < 100


def scene(frame, picture, landmark_px):
    """With a blob at a landmark and one elsewhere."""
    mask = np.zeros(picture.shape[:2], np.uint16)
    boxes = np.array([[*np.rint(landmark_px - 13), 27, 27], [300, 30, 20, 20]])
    for value, (x, y, w, h) in enumerate(boxes.astype(int), 1):
        mask[y : y + h, x : x + w] = value
    found = Detections(boxes, np.ones(2), np.array([729.0, 400]), *np.full((2, 2), np.nan))
    step = Registration(np.eye(3), 100, 100, 0.1, 0.0)
    return Scene(Frame(frame, (frame - 1) / 10, picture), mask, found, 1, step=step)


def test_colours_lead_to_the_tables_pixels_and_a_blob_off_its_landmark_gives_way_to_the_colour(prepared, tmp_path):
    flight = Overflight(frames=4, size=(640, 360), focal_px=457.0, height_m=45, heading_rad=0.1, geographic=False)
    (tmp_path / "colours.toml").write_text(COLOURS_TOML)
    locator, _ = prepared(flight, pictured=False)
    watch = LandmarkWatch(locator, read_colours(tmp_path / "colours.toml"))
    for frame, picture in zip(flight.numbers(), pictures(flight), strict=True):
        truth = flight.shown(frame, flight.marks(frame))
        found = watch.update(scene(frame, picture, truth[0] + (9.0 * (frame == 4), 0.0)))
        np.testing.assert_allclose(found.fixed.marks.image_px, truth, atol=1.0)
        if frame < 4:
            # The landmark's blob is gone from the targets, and the mask counts on.
            assert len(found.scene.detections) == found.scene.mask.max() == 1
    assert found.sighted_by[0] == "colour"


def test_a_tables_pixels_remove_the_smallest_box_about_each_landmark_from_the_targets(prepared):
    flight = Overflight(frames=1, geographic=False)
    locator, _ = prepared(flight)
    truth = flight.shown(1, flight.marks(1))
    found = LandmarkWatch(locator, None).update(scene(1, np.zeros((1080, 1920, 3), np.uint8), truth[0]))
    assert found.sighted_by == ("table",) * len(truth)
    assert found.scene.detections.box_px.tolist() == [[300, 30, 20, 20]]


# -- Lenses ------------------------------------------------------------------------------------------------------------

DOWN_AT_50_M = (
    "{n}\n00:00:{s:02d},000 --> 00:00:{t:02d},000\n[latitude: 48.137100] [longitude: 11.575300] "
    "[rel_alt: 50.0 abs_alt: 569.8] [gb_yaw: 0.0 gb_pitch: -90.0 gb_roll: 0.0] "
    "[focal_len: 24.00] [fnum: 1.7] [dzoom_ratio: {zoom}]\n\n"
)


@pytest.fixture
def hovering(tmp_path):
    """The log of a drone that looks straight down from 50 m with a lens of 24 mm, "as for 36 mm"."""

    def write(zooms=("1.00",) * 4):
        path = tmp_path / "flight.SRT"
        rows = [DOWN_AT_50_M.format(n=k + 1, s=k, t=k + 1, zoom=zoom) for k, zoom in enumerate(zooms)]
        path.write_text("".join(rows))
        return read_telemetry(path)

    return write


def metres_right(locator, frame, pixels=100.0):
    """How far to the right of the middle a target stands that is seen so many pixels there."""
    width, height = locator.camera.size_px
    box = np.array([[width / 2 - 0.5 + pixels, height / 2 - 0.5, 1.0, 1.0]])
    seen = Tracks(frame, np.array([1]), box, np.ones(1), np.zeros(1, int))
    return locator.locate(seen).positions.east_north_m[0, 0]


@pytest.mark.parametrize("size", [(1280, 720), (720, 1280), (1080, 1080), (1440, 1080)])
def test_a_focal_length_as_for_36_mm_holds_along_the_longer_side_of_the_pictures(hovering, size):
    locator = AerialLocator(None, hovering(), size_px=size, rate_hz=1)
    focal_px = 24 / 36 * max(size)
    assert metres_right(locator, 1) == pytest.approx(100 / focal_px * 50, rel=1e-3)
    assert any(f"nominal focal length, {focal_px:.0f} px" in note and "cropping" in note for note in locator.notes)
    settings, (note,) = with_logged_focal(Settings(), hovering(), size)
    assert settings.gates.focal_px == pytest.approx(focal_px) and f"{focal_px:.0f} px" in note


def test_a_field_of_view_that_is_no_nominal_one_is_that_of_the_width():
    flown = Telemetry(np.zeros(3), np.full(3, 50.0), np.zeros(3), hfov_rad=np.full(3, np.radians(60)))
    assert flown.focal_px((720, 1280)) == pytest.approx(360 / np.tan(np.radians(30)))
    # A guess is that of the longer side; what somebody sets is what it says.
    for parameters, half in (({}, 640), ({"aerial.hfov_deg": 70.0}, 360)):
        camera, known, _ = resolve_camera(None, (720, 1280), None, with_parameters(Settings(), parameters))
        assert not known and camera.focal_px[0] == pytest.approx(half / np.tan(np.radians(35)))


def test_a_camera_file_that_names_the_lens_overrides_the_logs_nominal_focal_length(hovering, tmp_path):
    (tmp_path / "c.toml").write_text("focal_px = 1000\nwidth_px = 720\nheight_px = 1280\n")
    for camera in (
        read_aerial_camera(tmp_path / "c.toml", None),
        Camera("c", (720, 1280), (1000, 1000), (359.5, 639.5)),
    ):
        locator = AerialLocator(camera, hovering(), rate_hz=1)
        assert metres_right(locator, 1) == pytest.approx(5, rel=1e-3)
        assert any("camera c, 1000 px, is used, not the log's nominal 853 px" in note for note in locator.notes)
    # What the log says of the zoom holds also then.
    locator = AerialLocator(camera, hovering(("1.00", "1.00", "2.00", "2.00")), rate_hz=1)
    assert [metres_right(locator, frame) for frame in (1, 2, 3, 4)] == pytest.approx([5, 5, 2.5, 2.5], rel=1e-3)
    assert any("times a zoom of up to 2.00" in note for note in locator.notes)
    # A file that names no lens leaves the log's.
    (tmp_path / "c.toml").write_text("width_px = 720\nheight_px = 1280\n")
    locator = AerialLocator(read_aerial_camera(tmp_path / "c.toml", None), hovering(("1.00", "2.00")), rate_hz=1)
    assert [metres_right(locator, frame) for frame in (1, 2)] == pytest.approx([5 / 0.8533, 2.5 / 0.8533], rel=1e-3)
    assert any("853 to 1707 px by its zoom" in note for note in locator.notes)


# -- Ground ------------------------------------------------------------------------------------------------------------

TIME = np.arange(0, 20, 0.5)
RISEN = np.minimum(4.0 * TIME, 40.0)  # a start from the ground


def over(ground_m, risen=RISEN, zero="takeoff", above_sea_m=None, raster_m=None, camera=None):
    """The locator over ground of a height: a function of east, and the raster's, its heights in any unit."""
    east = 5.0 * TIME
    ground = ground_m(east)
    start = ground[0] if zero == "takeoff" else ground
    log = Telemetry(
        TIME, risen, 5 + 0 * TIME, np.c_[east, 0 * TIME], False,
        above_sea_m=start + risen if above_sea_m is None else above_sea_m,
        heading_rad=0 * TIME, pitch_rad=1.5 + 0 * TIME, height_zero=zero,
    )  # fmt: skip
    k = np.arange(-50.0, 250.0, 5.0)
    heights = np.tile((raster_m or ground_m)(k), (len(k), 1))
    base = float(heights[0, 10])
    camera = camera or Camera("uav", (640, 480), (554.0, 554.0), (319.5, 239.5))
    return AerialLocator(camera, log, None, elevation=Elevation(heights - base, (-50.0, -50.0), 5.0, base))


def hillside(east):
    return 1540.0 + 0.4 * east


def about_ground(locator):
    return [note for note in locator.notes if "the ground" in note]


@pytest.mark.parametrize("zero", ["takeoff", "ground"])
def test_an_elevation_that_agrees_with_the_log_on_the_ground_is_taken_without_a_word(zero):
    locator = over(hillside, zero=zero)
    assert about_ground(locator) == []
    # A height above the take-off point stays the same over a hill, one above the ground below follows it.
    ground = hillside(5.0 * 19.0) - 1540.0
    assert locator.telemetry_at(19.0).altitude_m == pytest.approx(40.0 + ground * (zero == "ground"), abs=0.1)


@pytest.mark.parametrize("zero", ["takeoff", "ground"])
@pytest.mark.parametrize(
    ("times", "said"),
    [
        (1 / 0.3048, "is the elevation in feet, 3.28 to the metre"),
        (0.3048, "is the log in feet, 3.28 to the metre"),
        (10.0, "is the elevation in decimetres, 10 to the metre"),
        (100.0, "is the elevation in centimetres, 100 to the metre"),
    ],
)
def test_an_elevation_in_another_unit_is_refused_and_the_ratio_is_named(zero, times, said):
    with pytest.raises(InputError, match=f"{times:.3g} times as much: {said}"):
        over(hillside, zero=zero, raster_m=lambda east: times * hillside(east))
    # GPS and a geoid do not hide it, and an offset as large does not look like it.
    with pytest.raises(InputError, match=said):
        over(hillside, zero=zero, raster_m=lambda east: times * (hillside(east) + 25.0))
    (note,) = about_ground(over(hillside, zero=zero, raster_m=lambda east: hillside(east) + 300.0))
    assert "1540 m above the sea by the log" in note if zero == "takeoff" else "by the elevation" in note
    assert "300 m apart" in note


@pytest.mark.parametrize(("log_m", "raster_m"), [(0.5, 70.0), (0.7, 70.0), (548.0, 0.0), (500.0, 0.5), (5.0, 500.0)])
def test_where_one_height_is_near_zero_no_unit_is_told_and_the_offset_is_named(log_m, raster_m):
    (note,) = about_ground(over(lambda east: log_m + 0 * east, raster_m=lambda east: raster_m + 0 * east))
    assert f"{abs(log_m - raster_m):.0f} m apart" in note


@pytest.mark.parametrize(("offset_m", "notes"), [(8.0, 0), (-8.0, 0), (12.0, 1), (-47.0, 1)])
def test_an_offset_of_more_than_ten_metres_is_named(offset_m, notes):
    found = about_ground(over(hillside, raster_m=lambda east: hillside(east) + offset_m))
    assert len(found) == notes and all(f"{abs(offset_m):.0f} m apart" in note for note in found)


def test_without_the_take_off_point_nothing_is_compared_and_the_height_counts_from_below_the_first_place():
    locator = over(hillside, risen=40.0 + 0 * TIME, raster_m=lambda east: 3.28 * hillside(east))
    (note,) = [note for note in locator.notes if "begins in the air" in note]
    assert not about_ground(locator) or about_ground(locator) == [note]
    # The height of the take-off point in the camera's file says where the altitude counts from.
    camera = Camera("uav", (640, 480), (554.0, 554.0), (319.5, 239.5), takeoff_above_sea_m=1520.0)
    low = over(hillside, risen=40.0 + 0 * TIME, camera=camera)
    assert low.telemetry_at(0.0).altitude_m == pytest.approx(20.0, abs=0.1)
    assert not [note for note in low.notes if "begins in the air" in note]


def test_a_height_whose_zero_is_not_known_is_not_compared():
    assert about_ground(over(hillside, zero="unknown", above_sea_m=RISEN, risen=np.full(len(TIME), np.nan))) == []
    assert about_ground(over(hillside, zero="ground", above_sea_m=np.full(len(TIME), np.nan))) == []


def test_a_log_covers_half_an_interval_beside_its_samples_and_no_more():
    locator = over(hillside)
    assert locator.telemetry_at(-0.2) is not None and locator.telemetry_at(19.7) is not None
    assert locator.telemetry_at(-0.3) is locator.telemetry_at(19.8) is None
