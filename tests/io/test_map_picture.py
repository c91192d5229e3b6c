"""The map picture of a run: targets, landmarks, photo, camera, and signs of ground vehicles."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.io.ground import DOWN, NAMES, positions, tracks
from torchvision_dddas.geo.projection import axes_of, rays
from torchvision_dddas.io.maps.ground_tracks import Gathered
from torchvision_dddas.io.maps.map_picture import (
    FINE,
    LEFT,
    TOP,
    VERDICTS,
    WIDTH,
    CameraPath,
    Signs,
    frame_around,
    map_picture,
    round_step,
    view_of,
)
from torchvision_dddas.types import Camera, CameraPose, Fix, Ortho

CAMERA = Camera("uav", (1920, 1080), (1400.0, 1400.0), (959.5, 539.5))
NONE = tracks([])


def walk(count=30, offset=(0.0, 0.0), target=None):
    return tracks(
        [positions(k + 1, [np.array([k, -k]) + offset], [[4, 0], [0, 1]], None, target) for k in range(count)]
    )


def pixel(frame, east_north):
    return (frame.pixels(np.array(east_north)) / FINE + (LEFT, TOP)).round().astype(int)


def coloured(picture):
    """Pixels that are no shade of grey."""
    return np.ptp(picture.astype(int), axis=2) > 40


def test_a_target_lies_where_its_metres_are():
    found, marks = walk(), tracks([positions(1, [[-40, -60], [60, 20]], origin=None, target=[0, 1])])
    picture = map_picture(found, marks, NAMES)
    assert picture.dtype == np.uint8 and picture.shape[1] == WIDTH
    frame = frame_around(np.array([[-40, -60], [60, 20]]))
    for east_north in ([29, -29], [0, 0], [15, -15], [-40, -60], [60, 20]):
        x, y = pixel(frame, east_north)
        assert coloured(picture[y - 2 : y + 3, x - 2 : x + 3]).any(), east_north
    x, y = pixel(frame, [-15, 10])
    assert not coloured(picture[y - 9 : y + 10, x - 9 : x + 10]).any()


def test_the_ellipse_has_its_size_in_metres():
    still = tracks([positions(1, [[0, 0]], [[100, 0], [0, 25]], None)])
    marks = tracks([positions(1, [[-50, -30], [50, 30]], origin=None, target=[0, 1])])
    frame = frame_around(np.array([[-50, -30], [50, 30]]))
    picture = map_picture(still, marks, NAMES)
    x, y = pixel(frame, [0, 0])
    colour = picture[y, x].astype(int)
    same = np.abs(picture.astype(int) - colour).max(axis=2) < 30
    along, up = np.flatnonzero(same[y]), np.flatnonzero(same[:, x])
    assert np.ptp(along) * frame.metres_a_pixel == pytest.approx(2 * 24.48, abs=0.5)
    assert np.ptp(up) * frame.metres_a_pixel == pytest.approx(2 * 12.24, abs=0.5)


def test_north_is_up_and_all_places_are_inside():
    places = np.array([[0, 0], [30, 0], [0, 300.0]])
    frame = frame_around(places)
    at = frame.pixels(places) / FINE
    assert at[1, 0] > at[0, 0] and at[2, 1] < at[0, 1]
    assert ((at > 0) & (at < (frame.width, frame.height))).all()


@pytest.mark.parametrize("span", [0.3, 9.0, 40.0, 777.0, 1e5])
def test_steps_of_a_grid_are_round_and_not_too_many(span):
    step = round_step(span, 12)
    assert f"{step:.0e}"[0] in "125" and 4 <= span / step <= 12.001


def test_places_far_from_all_others_do_not_stretch_the_map():
    lost = positions(31, [[50_000, 0]], None, None)
    near = [positions(k + 1, [[k, -k]], None, None) for k in range(90)]
    alone, together = map_picture(tracks(near), NONE), map_picture(tracks([*near, lost]), NONE)
    assert alone.shape == together.shape
    # Only the label of the last place, and the count below, differ.
    assert (alone != together).any(axis=2).mean() < 0.01


def test_a_track_is_broken_where_the_target_was_not_located():
    frames = [positions(k + 1, [[k, 0]], None, None) for k in range(100) if not 40 <= k < 60]
    picture = map_picture(tracks(frames), NONE)
    frame = frame_around(np.array([[0, 0], [99, 0.0]]))
    x, y = pixel(frame, [49, 0])
    assert not coloured(picture[y - 4 : y + 5, x - 4 : x + 5]).any()
    x, y = pixel(frame, [20, 0])
    assert coloured(picture[y - 4 : y + 5, x - 4 : x + 5]).any()


def test_a_photo_lies_under_the_map_where_its_metres_are():
    """Half a metre a pixel, a green square of 10 m whose middle is 20 m east and 10 m north."""
    image = np.full((200, 240, 3), 255, np.uint8)
    photo = Ortho(image, np.array([[0.5, 0, -60.0], [0, -0.5, 50.0]]))
    u, v = int((20 + 60) / 0.5), int((50 - 10) / 0.5)
    image[v - 10 : v + 11, u - 10 : u + 11] = (0, 255, 0)
    found = walk(offset=(-20, 0))
    picture = map_picture(found, tracks([positions(1, [[40, 30]], origin=None, target=[0])]), NAMES, photo=photo)
    frame = frame_around(np.array([[-20, -29], [40, 30.0]]))
    green = (picture[..., 1] > 200) & (picture[..., 0] < 120) & (picture[..., 2] < 120)
    x, y = pixel(frame, [20, 10])
    reach = round(10 / frame.metres_a_pixel)
    rows, columns = np.nonzero(green[y - reach : y + reach + 1, x - reach : x + reach + 1])
    assert abs(columns.mean() - reach) < 2 and abs(rows.mean() - reach) < 2
    assert np.ptp(columns) * frame.metres_a_pixel == pytest.approx(10.5, abs=1)


def test_a_photo_finer_than_the_map_is_averaged():
    image = np.zeros((4000, 4000, 3), np.uint8)
    image[::2, ::2] = image[1::2, 1::2] = 255
    photo = Ortho(image, np.array([[0.05, 0, -100.0], [0, -0.05, 100.0]]))
    picture = map_picture(walk(), tracks([positions(1, [[-60, 60]], origin=None, target=[0])]), NAMES, photo=photo)
    frame = frame_around(np.array([[-60, 60], [29, -29.0]]))
    x, y = pixel(frame, [13, 33])
    assert picture[y - 8 : y + 8, x - 8 : x + 8].std() < 5


def test_the_camera_is_drawn_unless_it_was_far_away():
    near = map_picture(walk(), NONE, camera=CameraPath(np.array([[0, -10], [5, -10.0]])))
    assert (near != map_picture(walk(), NONE)).any()
    far = map_picture(walk(), NONE, camera=CameraPath(np.array([[5000, 0.0]])))
    assert far.shape == map_picture(walk(), NONE).shape


@pytest.mark.parametrize("lens", [(0.0, 0.0), (-0.1, 0.02)])
def test_the_view_is_where_the_rays_of_the_border_meet_the_ground(lens):
    camera = Camera("uav", (1920, 1080), (1400.0, 1400.0), (959.5, 539.5), k1=lens[0], k2=lens[1])
    pose = CameraPose(np.array([3.0, 4.0, 60.0]), axes_of(0.4, 1.1, 0.1), 1.02)
    found = view_of(Fix(1, "pose", pose), camera)
    corners = rays(np.array([[0, 0], [1919, 0], [1919, 1079], [0, 1079.0]]), pose, camera)
    wanted = pose.place_m[:2] - corners[:, :2] * (60 / corners[:, 2:])
    assert np.allclose(found[::8], wanted, atol=0.05)


def test_a_view_above_the_horizon_ends_where_rays_come_down_at_three_degrees():
    pose = CameraPose(np.array([0.0, 0.0, 10.0]), axes_of(0.0, 0.1, 0.0))
    found = view_of(Fix(1, "pose", pose), CAMERA)
    assert 150 < np.hypot(*found.T).max() < 10 / np.sin(np.radians(3)) + 1


def test_the_view_of_a_homography_is_its_border_on_the_ground():
    image_from_ground = np.array([[20, 0, 960], [0, -20, 540], [0, 0, 1.0]])
    found = view_of(Fix(1, "homography", image_from_ground=image_from_ground), CAMERA)
    assert np.allclose(found[0], (-48, 27)) and np.allclose(found[16], (47.95, -26.95))
    bent = view_of(Fix(1, "homography", image_from_ground=image_from_ground), replace(CAMERA, k1=-0.1))
    assert bent[0, 0] < found[0, 0] - 1  # a barrel shows more than a straight lens
    horizon = np.array([[20, 0, 960], [0, -20, 540], [0, -0.1, 1.0]])
    assert len(view_of(Fix(1, "homography", image_from_ground=horizon), CAMERA)) == 0
    assert len(view_of(Fix(1, "homography", image_from_ground=np.zeros((3, 3))), CAMERA)) == 0
    assert len(view_of(Fix(1, ""), CAMERA)) == 0


@pytest.mark.parametrize("found", [NONE, walk(1), tracks([positions(1, [[7, 7]], np.full((2, 2), np.nan), None)])])
def test_a_map_of_little_or_nothing_is_drawn(found):
    picture = map_picture(found, NONE)
    assert picture.shape[1] == WIDTH and cv2.imencode(".png", picture)[0]


def test_names_beyond_ascii_and_crowds_do_not_break_it():
    rng = np.random.default_rng(1)
    crowd = tracks([positions(1, rng.normal(0, 1, (150, 2)), None, None)])
    marks = tracks([positions(1, [[0, 0]], origin=None, target=[0])])
    assert map_picture(crowd, marks, ("Żółw 🐢",), CameraPath(np.zeros((1, 2)), DOWN[:, :2])).shape[1] == WIDTH


def shown(signs):
    """A map of a target that walks from west to east, with signs."""
    walk = tracks([positions(k, [(k, 0.0)]) for k in range(40)])
    return map_picture(walk, Gathered().tracks(True), signs=signs)


def near(picture, colour):
    """Pixels of a colour above the legend."""
    return int((np.abs(picture[:-100].astype(int) - colour).max(axis=2) < 12).sum())


def test_the_map_shows_where_a_target_was_told_human_and_where_not():
    signs = Signs()
    bare = shown(Signs())
    signs.add_verdict(1, "human", np.array([10.0, 0]))
    human = shown(signs)
    assert near(human, VERDICTS["human"]) > near(bare, VERDICTS["human"]) + 60
    assert near(human, VERDICTS["not_human"]) == near(bare, VERDICTS["not_human"])
    signs.add_verdict(1, "not_human", np.array([30.0, 0]))
    assert near(shown(signs), VERDICTS["not_human"]) > near(bare, VERDICTS["not_human"]) + 60


def test_a_wedge_opens_from_the_vehicle_towards_what_it_saw():
    signs = Signs()
    bare = shown(Signs())
    signs.add_look("ugv1", np.array([10.0, 4.0]), np.array([10.0, 0.0]))
    changed = (np.abs(shown(signs)[:-100].astype(int) - bare[:-100]) > 8).any(axis=2)
    rows, columns = np.nonzero(changed)
    widths = [np.ptp(columns[rows == row]) for row in (rows.min() + 3, rows.max() - 3)]
    assert len(rows) > 100 and widths[1] > 2 * widths[0]


def test_looks_from_all_but_one_place_are_one_and_those_from_nowhere_none():
    signs = Signs()
    for k in range(100):
        signs.add_look("ugv1", np.array([0.01 * k, 0.0]), np.zeros(2))
    signs.add_look("ugv2", np.full(2, np.nan), np.zeros(2))
    assert len(signs.looks) == 1


def test_signs_far_outside_the_map_do_no_harm():
    signs = Signs()
    signs.add_verdict(1, "human", np.array([1e7, -1e7]))
    signs.add_look("ugv1", np.array([-1e7, 1e7]), np.zeros(2))
    assert shown(signs).shape[1] == 1400


def test_memory_is_bounded_however_much_is_told():
    signs = Signs()
    for k in range(3000):
        signs.add_verdict(k, "human", np.zeros(2))
        signs.add_look("ugv1", np.array([10.0 * k, 0.0]), np.zeros(2))
    assert len(signs.verdicts) < 1000 and len(signs.looks) < 1000
