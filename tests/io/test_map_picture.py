"""The map picture of a run: targets, landmarks, photo, camera, and signs of ground vehicles."""

from dataclasses import replace

import numpy as np
import pytest

from tests.io.ground import DOWN, NAMES, positions, tracks
from torchvision_dddas.geometry.projection import axes_of, rays
from torchvision_dddas.io.maps.map_picture import (
    EVENTS,
    FINE,
    LEFT,
    TOP,
    WIDTH,
    CameraPath,
    Signs,
    extent,
    frame_around,
    map_picture,
    round_step,
    view_of,
)
from torchvision_dddas.types import Camera, CameraPose, Fix, Ortho

CAMERA = Camera("uav", (1920, 1080), (1400.0, 1400.0), (959.5, 539.5))
NONE = tracks([])


def walk(offset=(0.0, 0.0), frames=range(1, 31)):
    """A target that goes south-east, a metre each way a frame."""
    return tracks([positions(k, [np.array([k - 1, 1 - k]) + offset], [[4, 0], [0, 1]], None) for k in frames])


def landmarks(*places):
    return tracks([positions(1, places, origin=None, target=range(len(places)))])


def frame_of(targets, marks=NONE):
    return frame_around(extent(targets, marks, CameraPath(), Signs()))


def pixel(frame, east_north):
    return (frame.pixels(np.array(east_north)) / FINE + (LEFT, TOP)).round().astype(int)


def is_coloured(picture, frame, east_north, reach=3):
    """Whether there are pixels about a place that are no shade of grey."""
    x, y = pixel(frame, east_north)
    part = picture[y - reach : y + reach + 1, x - reach : x + reach + 1]
    return bool((np.ptp(part.astype(int), axis=2) > 40).any())


def test_a_target_and_its_landmarks_lie_where_their_metres_are():
    picture = map_picture(walk(), landmarks([-40, -60], [60, 20]), NAMES)
    assert picture.dtype == np.uint8 and picture.shape[1] == WIDTH
    frame = frame_around(np.array([[-40, -60], [60, 20]]))
    assert all(is_coloured(picture, frame, at) for at in ([29, -29], [0, 0], [15, -15], [-40, -60], [60, 20]))
    assert not is_coloured(picture, frame, [-15, 10], 9)


def test_the_ellipse_has_its_size_in_metres():
    still = tracks([positions(1, [[0, 0]], [[100, 0], [0, 25]], None)])
    frame = frame_around(np.array([[-50, -30], [50, 30]]))
    picture = map_picture(still, landmarks([-50, -30], [50, 30]), NAMES).astype(int)
    x, y = pixel(frame, [0, 0])
    same = np.abs(picture - picture[y, x]).max(axis=2) < 30
    along, up = np.flatnonzero(same[y]), np.flatnonzero(same[:, x])
    assert np.ptp(along) * frame.metres_a_pixel == pytest.approx(2 * 24.48, abs=0.5)
    assert np.ptp(up) * frame.metres_a_pixel == pytest.approx(2 * 12.24, abs=0.5)


def test_the_last_ellipse_of_a_target_is_not_cut_off_unless_it_reaches_far_beyond_all_places():
    def size_m(sigma_m):
        still = tracks([positions(1, [[0, 0], [40, 0]], np.diag([1, sigma_m**2]), None)])
        return float(np.subtract(*frame_of(still).box_m[3::-2]))

    assert 2 * 2.44 * 20 < size_m(20) < 3 * 2.44 * 20 and size_m(100) < 100


def test_north_is_up_all_places_are_inside_and_steps_of_the_grid_are_round():
    places = np.array([[0, 0], [30, 0], [0, 300.0]])
    frame = frame_around(places)
    at = frame.pixels(places) / FINE
    assert at[1, 0] > at[0, 0] and at[2, 1] < at[0, 1]
    assert ((at > 0) & (at < (frame.width, frame.height))).all()
    for span in (0.3, 9.0, 40.0, 777.0, 1e5):
        step = round_step(span, 12)
        assert f"{step:.0e}"[0] in "125" and 4 <= span / step <= 12.001


def test_places_far_from_all_others_do_not_stretch_the_map():
    unknown = np.full((2, 2), np.nan)
    near = [positions(k + 1, [[k, -k]], unknown, None) for k in range(90)]
    lost = positions(31, [[50_000, 0]], unknown, None)
    alone, together = map_picture(tracks(near), NONE), map_picture(tracks([*near, lost]), NONE)
    # Only the label of the last place, and the count below, differ.
    assert alone.shape == together.shape and (alone != together).any(axis=2).mean() < 0.01


def test_a_track_is_broken_where_the_target_was_not_located():
    broken = walk(frames=[*range(1, 41), *range(61, 101)])
    picture, frame = map_picture(broken, NONE), frame_of(broken)
    assert is_coloured(picture, frame, [20, -20]) and not is_coloured(picture, frame, [49, -49])


def test_a_photo_lies_under_the_map_where_its_metres_are():
    """Half a metre a pixel, a green square of 10 m whose middle is 20 m east and 10 m north."""
    image = np.full((200, 240, 3), 255, np.uint8)
    u, v = int((20 + 60) / 0.5), int((50 - 10) / 0.5)
    image[v - 10 : v + 11, u - 10 : u + 11] = (0, 255, 0)
    photo = Ortho(image, np.array([[0.5, 0, -60.0], [0, -0.5, 50.0]]))
    picture = map_picture(walk((-20, 0)), landmarks([40, 30]), NAMES, photo=photo)
    frame = frame_of(walk((-20, 0)), landmarks([40, 30]))
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
    picture = map_picture(walk(), landmarks([-60, 60]), NAMES, photo=photo)
    x, y = pixel(frame_of(walk(), landmarks([-60, 60])), [13, 33])
    assert picture[y - 8 : y + 8, x - 8 : x + 8].std() < 5


def test_the_camera_is_drawn_unless_it_was_far_away():
    plain = map_picture(walk(), NONE)
    assert (map_picture(walk(), NONE, camera=CameraPath(np.array([[0, -10], [5, -10.0]]))) != plain).any()
    assert map_picture(walk(), NONE, camera=CameraPath(np.array([[5000, 0.0]]))).shape == plain.shape


@pytest.mark.parametrize("lens", [(0.0, 0.0), (-0.1, 0.02)])
def test_the_view_is_where_the_rays_of_the_border_meet_the_ground(lens):
    camera = replace(CAMERA, k1=lens[0], k2=lens[1])
    pose = CameraPose(np.array([3.0, 4.0, 60.0]), axes_of(0.4, 1.1, 0.1), 1.02)
    corners = rays(np.array([[0, 0], [1919, 0], [1919, 1079], [0, 1079.0]]), pose, camera)
    wanted = pose.place_m[:2] - corners[:, :2] * (60 / corners[:, 2:])
    assert np.allclose(view_of(Fix(1, "pose", pose), camera)[::8], wanted, atol=0.05)


def test_a_view_above_the_horizon_ends_where_rays_come_down_at_three_degrees():
    pose = CameraPose(np.array([0.0, 0.0, 10.0]), axes_of(0.0, 0.1, 0.0))
    found = view_of(Fix(1, "pose", pose), CAMERA)
    assert 150 < np.hypot(*found.T).max() < 10 / np.sin(np.radians(3)) + 1


def test_the_view_of_a_homography_is_its_border_on_the_ground():
    image_from_ground = np.array([[20, 0, 960], [0, -20, 540], [0, 0, 1.0]])
    fix = Fix(1, "homography", image_from_ground=image_from_ground)
    found = view_of(fix, CAMERA)
    assert np.allclose(found[0], (-48, 27)) and np.allclose(found[16], (47.95, -26.95))
    assert view_of(fix, replace(CAMERA, k1=-0.1))[0, 0] < found[0, 0] - 1  # a barrel shows more than a straight lens
    horizon = np.array([[20, 0, 960], [0, -20, 540], [0, -0.1, 1.0]])
    for unknown in (horizon, np.zeros((3, 3)), None):
        assert len(view_of(replace(fix, image_from_ground=unknown), CAMERA)) == 0


CROWD = positions(1, np.random.default_rng(1).normal(0, 1, (150, 2)), None, None)
UNSURE = positions(1, [[7, 7]], np.full((2, 2), np.nan))


@pytest.mark.parametrize("found", [NONE, walk(frames=[1]), tracks([UNSURE]), tracks([CROWD])])
def test_a_map_of_little_or_nothing_or_of_a_crowd_is_drawn(found):
    assert map_picture(found, NONE).shape[1] == WIDTH
    camera = CameraPath(np.zeros((1, 2)), DOWN[:, :2])
    assert map_picture(found, landmarks([0, 0]), ("Żółw 🐢",), camera).shape[1] == WIDTH


# --------------------------------------------------------------------------------------------------------------------
# Signs of ground vehicles.


def with_signs(*verdicts, looks=()):
    """The map of a target that walks from west to east, above the legend, int."""
    signs = Signs()
    for place, kind in verdicts:
        signs.add_event(kind, np.array(place))
    for from_m, at_m in looks:
        signs.add_look("ugv1", np.array(from_m), np.array(at_m))
    east = tracks([positions(k, [(k, 0.0)]) for k in range(40)])
    return map_picture(east, NONE, signs=signs)[:-100].astype(int)


def test_the_map_shows_where_a_target_was_human_and_where_not():
    def count(picture, kind):
        return int((np.abs(picture - EVENTS[kind][2]).max(axis=2) < 12).sum())

    bare, human = with_signs(), with_signs(([10.0, 0], "human"))
    both = with_signs(([10.0, 0], "human"), ([30.0, 0], "not_human"))
    assert count(human, "human") > count(bare, "human") + 60
    assert count(human, "not_human") == count(bare, "not_human") < count(both, "not_human") - 60


def test_a_wedge_opens_from_the_vehicle_towards_what_it_saw():
    changed = (np.abs(with_signs(looks=[([10.0, 4.0], [10.0, 0.0])]) - with_signs()) > 8).any(axis=2)
    rows, columns = np.nonzero(changed)
    widths = [np.ptp(columns[rows == row]) for row in (rows.min() + 3, rows.max() - 3)]
    assert len(rows) > 100 and widths[1] > 2 * widths[0]
    far = with_signs(([1e7, -1e7], "human"), looks=[([-1e7, 1e7], [0.0, 0.0])])
    assert far.shape == with_signs().shape


def test_looks_from_one_place_are_one_those_from_nowhere_none_and_memory_is_bounded():
    signs = Signs()
    for k in range(100):
        signs.add_look("ugv1", np.array([0.01 * k, 0.0]), np.zeros(2))
    signs.add_look("ugv2", np.full(2, np.nan), np.zeros(2))
    assert len(signs.looks) == 1
    for k in range(3000):
        signs.add_event("human", np.zeros(2))
        signs.add_look("ugv1", np.array([10.0 * k, 0.0]), np.zeros(2))
    assert len(signs.events) < 1000 and len(signs.looks) < 1000
