"""The UAV's pictures: everything where the camera says, each pixel's truth, and the same picture every time."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.lab.simulation.small import bodies_at, moment_of
from torchvision_dddas.lab.simulation import Scenario
from torchvision_dddas.lab.simulation.aerial_camera import AerialCamera
from torchvision_dddas.lab.simulation.cameras import camera_axes, motion_blur, view_from_pose
from torchvision_dddas.lab.simulation.scenario import CameraParameters, WorldParameters
from torchvision_dddas.lab.simulation.world import build_world
from torchvision_dddas.types import CameraPose, Elevation

SIDE_M = 120.0
CLEAR = dict.fromkeys(("exposure_s", "readout_s", "sharpness_px", "shot_noise", "read_noise", "drift"), 0)
PLACES = np.array([[0.3, 0.2], [-12.1, 7.7], [9.4, -8.3], [14.0, 11.0], [-9.0, -10.5]])


@pytest.fixture(scope="module")
def bare():
    """Grey ground with some relief and nothing on it."""
    parameters = WorldParameters(side_m=SIDE_M, relief_m=4, bushes_per_ha=0, trees_per_ha=0, buildings=0)
    world = build_world(parameters, seed=1)
    return replace(world, albedo=np.full_like(world.albedo, 120), surface=np.zeros_like(world.surface))


def camera_of(world, **camera):
    parameters = CameraParameters.model_validate({**CLEAR, "quality": 100, **camera})
    return AerialCamera(world, Scenario(camera=parameters, seed=5))


def on_ground(world, places):
    return np.c_[places, world.up_m(np.asarray(places, float))]


def people(places, world):
    """People of one crowd who stand at places (N, 2)."""
    return bodies_at(on_ground(world, places), target=np.ones(len(places), np.int64))


def middle(mask):
    """(u, v) of the pixels that are True."""
    return np.argwhere(mask).mean(axis=0)[::-1]


def moment(bodies, altitude=50.0, pitch=90.0, heading=25.0, roll=2.0, **how):
    """The camera looks at the origin, with its upper edge towards its heading."""
    axes = camera_axes(*np.radians([heading, pitch, roll]))
    return moment_of(bodies, CameraPose(-axes[:, 2] * altitude / np.sin(np.radians(pitch)), axes), **how)


def empty(**how):
    return moment(bodies_at(), **how)


def marked(world, places=PLACES):
    """With a round white spot at each place."""
    albedo = world.albedo.copy()
    v, u = np.mgrid[:9, :9] - 4
    for east, north in places:
        column, row = (east + SIDE_M / 2) / world.texel_m - 0.5, (SIDE_M / 2 - north) / world.texel_m - 0.5
        x, y = round(column), round(row)
        spot = np.exp(-((u - column + x) ** 2 + (v - row + y) ** 2) / 3)
        albedo[y - 4 : y + 5, x - 4 : x + 5] = (120 + 130 * spot)[..., None]
    return replace(world, albedo=albedo)


def spots(image, near):
    """Where the bright spots near pixels (N, 2) truly are."""
    found = []
    rows, columns = np.mgrid[-12:13, -12:13]
    for x, y in np.round(near).astype(int):
        patch = np.maximum(image[y - 12 : y + 13, x - 12 : x + 13, 0].astype(float) - 120, 0)
        found.append([x + (patch * columns).sum() / patch.sum(), y + (patch * rows).sum() / patch.sum()])
    return np.array(found)


@pytest.mark.parametrize(("pitch", "altitude"), [(90, 60), (45, 50)])
def test_a_point_of_the_ground_appears_where_the_camera_projects_it(bare, pitch, altitude):
    camera, now = camera_of(marked(bare)), empty(altitude=altitude, pitch=pitch)
    image, _, _ = camera.take(now)
    expected = view_from_pose(now.pose, camera.camera).project(on_ground(bare, PLACES))
    assert np.abs(spots(image, expected) - expected).max() < 0.1


def test_a_rolling_shutter_shifts_each_row_by_the_camera_s_motion(bare):
    world = marked(bare)
    moving = empty(altitude=60, velocity=(8.0, -5.0, 1.0), turn=(0.1, -0.2, 0.3))
    camera = camera_of(world, readout_s=0.03)
    steady = view_from_pose(moving.pose, camera.camera).project(on_ground(world, PLACES))
    expected = steady.copy()
    for k, point in enumerate(on_ground(world, PLACES)):
        for _ in range(4):
            lag = (expected[k, 1] / 479 - 0.5) * 0.03
            turned, _ = cv2.Rodrigues(moving.turn_rad_s * lag)
            pose = CameraPose(moving.pose.place_m + lag * moving.velocity_m_s, turned @ moving.pose.axes)
            expected[k] = view_from_pose(pose, camera.camera).project(point)
    assert np.abs(expected - steady).max() > 1
    image, _, _ = camera.take(moving)
    assert np.abs(spots(image, expected) - expected).max() < 0.1
    # Bodies are read row by row as well.
    _, _, bodies = camera.take(replace(moving, bodies=people(PLACES, world)))
    for k, pixel in enumerate(expected):
        assert np.hypot(*(middle(bodies == k + 1) - pixel)) < 0.025 * np.hypot(*(pixel - (319.5, 239.5))) + 3


def test_vibration_moves_rows_anew_in_each_picture_while_the_shutter_rolls(bare):
    world, calm = marked(bare), empty(altitude=60)
    camera = camera_of(world, readout_s=0.015, vibration_px=2)
    steady = view_from_pose(calm.pose, camera.camera).project(on_ground(world, PLACES))
    crowd = people(PLACES, world)
    _, _, unmoved = camera_of(world).take(replace(calm, bodies=crowd))
    offs = []
    for number in (1, 2):
        image, _, _ = camera.take(replace(calm, number=number))
        offs.append(spots(image, steady) - steady)
        # The truth moves with the picture.
        _, _, bodies = camera.take(replace(calm, number=number, bodies=crowd))
        shifts = [middle(bodies == k) - middle(unmoved == k) for k in crowd.number]
        assert np.abs(shifts - offs[-1]).max() < 0.6
    assert np.abs(offs[0] - offs[1]).max() > 1
    assert np.abs(offs).max() < 2 * np.sqrt(2) + 0.1
    assert np.ptp(offs[0], axis=0).max() > 1
    image, _, _ = camera_of(world, readout_s=0, vibration_px=2).take(calm)
    assert np.ptp(spots(image, steady) - steady, axis=0).max() < 0.1


@pytest.mark.parametrize(("altitude", "pitch"), [(50, 45), (150, 90)])
def test_the_mask_of_a_crowd_lies_where_its_people_are(bare, altitude, pitch):
    crowd = people(2.5 * (np.argwhere(np.ones((5, 5))) - 2), bare)
    camera, now = camera_of(bare, width_px=1280, height_px=720), moment(crowd, altitude, pitch)
    _, targets, bodies = camera.take(now)
    assert set(np.unique(targets)) == {0, 1}
    assert ((targets > 0) == (bodies > 0)).all()
    off = view_from_pose(now.pose, camera.camera).project(crowd.place_m + np.array([0, 0, 0.95]))
    off -= [middle(bodies == number) for number in crowd.number]
    assert np.abs(off.mean(axis=0)).max() < 0.6
    assert np.linalg.norm(off, axis=1).max() < 2.5


def box(world, low, high, height_m, grey=120):
    """With a building, from a south-western corner to a north-eastern one, on level ground."""
    surface, albedo = world.surface.copy(), world.albedo.copy()
    for texture, texel, value in ((surface, world.surface_texel_m, height_m), (albedo, world.texel_m, grey)):
        columns = slice(*(round((east + SIDE_M / 2) / texel) for east in (low[0], high[0])))
        rows = slice(*(round((SIDE_M / 2 - north) / texel) for north in (high[1], low[1])))
        texture[rows, columns] = value
    level = Elevation(np.zeros((3, 3)), (-SIDE_M / 2,) * 2, SIDE_M / 2)
    return replace(world, surface=surface, albedo=albedo, relief=level)


@pytest.mark.parametrize(("pitch", "seen"), [(45, {0, 2, 3}), (90, {0, 1, 2, 3})])
def test_people_behind_a_building_are_hidden_from_aslant_and_not_from_above(bare, pitch, seen):
    world = box(bare, (-6, 2), (6, 5), 5.0)
    crowd = people(np.array([[0.0, 6.0], [0.0, 1.0], [0.0, 14.0]]), world)
    _, _, bodies = camera_of(world).take(moment(crowd, 40, pitch, heading=0, roll=0))
    assert set(np.unique(bodies)) == seen


@pytest.mark.parametrize("pitch", [90, 45])
def test_the_top_of_a_building_appears_where_the_camera_projects_it(bare, pitch):
    world = box(bare, (-4, -3), (8, 3), 6.0, 240)
    camera, now = camera_of(world), empty(altitude=60, pitch=pitch)
    image, _, _ = camera.take(now)
    corners = np.array([[-4, -3, 6], [8, -3, 6], [8, 3, 6], [-4, 3, 6.0]])
    outline = view_from_pose(now.pose, camera.camera).project(corners)
    expected = cv2.fillConvexPoly(np.zeros(image.shape[:2], np.uint8), np.round(outline * 16).astype(np.int32), 1, 8, 4)
    # The walls are darker than the roof, as the sun does not shine along it.
    roof_seen = image[..., 0] > 200
    assert (roof_seen & (expected > 0)).sum() / (roof_seen | (expected > 0)).sum() > 0.85


def test_a_body_casts_a_shadow_away_from_the_sun_and_the_shadow_is_no_target(bare):
    now = moment(people(np.zeros((1, 2)), bare))
    camera = camera_of(bare, width_px=1280, height_px=720)
    (with_body, targets, _), (without, _, _) = camera.take(now), camera.take(empty())
    dark = (with_body.astype(int) - without).max(axis=2) < -20
    dark &= cv2.dilate(targets.astype(np.uint8), np.ones((3, 3))) == 0
    assert dark.sum() > 40
    away = middle(dark) - middle(targets)
    to_sun = (bare.to_sun @ now.pose.axes)[:2]
    assert away @ to_sun < -0.9 * np.linalg.norm(away) * np.linalg.norm(to_sun)


def test_a_plate_shows_its_colour_and_a_covered_one_does_not(bare):
    rover = bodies_at(on_ground(bare, [(3, 2)]), "ugv")
    hidden = replace(rover, hidden=np.ones(1, bool))
    (shown, targets, _), (covered, _, _) = (camera_of(bare).take(moment(one)) for one in (rover, hidden))
    red, none = ((image[..., 2] > 180) & (image[..., 0] < 60) for image in (shown, covered))
    assert red.sum() > 150
    assert not none.any()
    assert np.abs(middle(red) - middle(targets > 0)).max() < 0.6


@pytest.mark.parametrize(("kind", "length"), [("car", 4.4), ("ugv", 2.4)])
def test_vehicles_have_their_length_and_lie_along_their_heading(bare, kind, length):
    vehicle = bodies_at(on_ground(bare, [(0, 0)]), kind, facing_rad=np.radians([25.0]))
    _, targets, _ = camera_of(bare, width_px=1280, height_px=960).take(moment(vehicle))
    points = np.argwhere(targets > 0)[:, ::-1].astype(np.float32)
    (_, size, _), scale = cv2.minAreaRect(points), 1280 / 2 / np.tan(np.radians(30)) / 49.5
    assert max(size) / scale == pytest.approx(length, abs=0.2)
    # The upper edge of the picture, but for 2 degrees, is the heading: the vehicle stands upright in it.
    assert np.ptp(points[:, 1]) > 1.2 * np.ptp(points[:, 0])


def test_a_hill_hides_who_is_behind_it(bare):
    up = np.zeros((25, 25))
    up[12:14, :] = 12.0  # a ridge from west to east, just north of the middle
    ridge = replace(bare, relief=Elevation(up, (-SIDE_M / 2,) * 2, SIDE_M / 24))
    crowd = people(np.array([[0.0, 14.0], [0.0, -8.0]]), ridge)
    pose = CameraPose(np.array([0.0, -35.0, 22.0]), camera_axes(0.0, np.radians(30), 0.0))
    _, _, bodies = camera_of(ridge).take(moment_of(crowd, pose))
    assert set(np.unique(bodies)) == {0, 2}


def test_a_long_exposure_blurs_the_ground_along_the_flight_and_a_car_along_its_own_way(bare):
    world = marked(bare)
    sharp, blurred = (camera_of(world, width_px=1280, height_px=960, exposure_s=s) for s in (0.0, 0.04))
    # To the right of the picture at 10 m/s: 40 cm, 9 pixels.
    now = empty()
    now = replace(now, velocity_m_s=10 * now.pose.axes[:, 0])
    clear, smeared = (np.abs(np.diff(camera.take(now)[0][..., 0].astype(int), axis=1)) for camera in (sharp, blurred))
    assert smeared.max() < 0.5 * clear.max()
    east = {"velocity_m_s": np.array([[20.0, 0.0]]), "facing_rad": np.array([np.pi / 2])}
    still = moment(bodies_at(on_ground(world, [(0, 0)]), "car", **east))
    (a, mask_a, _), (b, mask_b, _) = sharp.take(still), blurred.take(still)
    assert np.array_equal(mask_a, mask_b)
    changed, own = np.argwhere((a != b).any(axis=2)), np.argwhere(mask_a > 0)
    # Half of the way of 80 cm beyond either end, and no change of the ground further off.
    assert np.ptp(changed, axis=0).max() == pytest.approx(np.ptp(own, axis=0).max() + 0.8 * 22, abs=8)


def test_bodies_in_the_shade_of_a_building_are_darker_and_cast_no_shadow(bare):
    shaded = box(bare, (-8, -3), (8, 3), 8.0)
    place = np.array([0.0, 3.5]) - 2.0 * shaded.to_sun[:2] / np.linalg.norm(shaded.to_sun[:2])
    light, shadow = [], []
    for world in (shaded, replace(bare, relief=shaded.relief)):
        camera = camera_of(world)
        image, mask, _ = camera.take(moment(people(place[None], world)))
        ground, _, _ = camera.take(empty())
        light.append(image[mask > 0].mean())
        around = cv2.dilate((mask > 0).astype(np.uint8), np.ones((3, 3))) > 0
        shadow.append(((image.astype(int) - ground).max(axis=2) < -20)[~around].sum())
    assert light[0] < 0.7 * light[1]
    assert shadow[0] == 0
    assert shadow[1] > 10


def spread(picture):
    """Middle (u, v) and variances of the light."""
    light = picture[..., 0].astype(float) / picture[..., 0].sum()
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    at = np.array([(light * u).sum(), (light * v).sum()])
    return at, np.array([(light * (u - at[0]) ** 2).sum(), (light * (v - at[1]) ** 2).sum()])


ACROSS = np.zeros((3, 3, 2), np.float32)
ACROSS[..., 0] = [0.0, 10.0, 20.0]


@pytest.mark.parametrize(
    ("way", "middle_way"),
    [((12.0, 0.0), (12.0, 0.0)), ((0.0, -7.5), (0.0, -7.5)), ((9.0, 5.0), (9.0, 5.0)), (ACROSS, (10.0, 0.0))],
)
def test_motion_blur_draws_out_by_the_length_of_the_way_there_and_moves_nothing(way, middle_way):
    dot = np.zeros((81, 121, 3), np.uint8)
    dot[38:43, 58:63] = 250
    (before, own), (after, now) = spread(dot), spread(motion_blur(dot, np.broadcast_to(np.float32(way), (3, 3, 2))))
    assert np.abs(after - before).max() < (0.6 if way is ACROSS else 0.1)
    assert now - own == pytest.approx(np.square(middle_way) / 12, abs=1.25 if way is ACROSS else 0.6)


def waves(world, time_s):
    given = {"camera": CLEAR | {"quality": 100}, "seed": 5, "world": {"shore_m": 5.0}}
    scenario = Scenario.model_validate(given)
    picture, *_ = AerialCamera(world, scenario).take(replace(empty(heading=0.0, roll=0.0), time_s=time_s))
    return picture.astype(int)


def test_waves_travel_and_the_ground_beside_them_stays(bare):
    before, after = waves(bare, 1.0), waves(bare, 1.4)
    changed = np.abs(after - before).max(axis=2)
    assert np.median(changed[-60:]) > 4  # the picture's lower edge is 20 m south
    assert changed[:200].max() == 0


def test_the_own_shadow_lies_where_the_sun_is_behind_the_vehicle(bare):
    def take(size_m):
        given = {"camera": CLEAR | {"quality": 100}, "seed": 5, "uav": {"size_m": size_m}}
        scenario = Scenario.model_validate(given)
        return AerialCamera(bare, scenario).take(above)[0].astype(int)

    above = empty(altitude=15.0, pitch=45.0, heading=320.0, roll=0.0)
    dark = (take(0.0) - take(0.8)).max(axis=2)
    place = above.pose.place_m - above.pose.place_m[2] / bare.to_sun[2] * bare.to_sun
    view = view_from_pose(above.pose, AerialCamera(bare, Scenario.model_validate({"camera": CLEAR})).camera)
    wanted = view.project(np.array([[*place[:2], bare.up_m(place[None, :2])[0]]]))[0]
    assert dark.max() > 40
    assert np.hypot(*(middle(dark > 0.5 * dark.max()) - wanted)) < 8


def test_a_thermal_camera_shows_people_bright_and_casts_no_shadow(bare):
    crowd = people(PLACES, bare)
    picture, mask, _ = camera_of(bare, thermal=True).take(moment(crowd))
    assert picture[mask > 0].mean() > 170
    beside = picture[cv2.dilate((mask > 0).astype(np.uint8), np.ones((5, 5))) == 0]
    assert beside.min() > 60 and beside.max() < 90 and (picture[..., 0] == picture[..., 2]).all()
