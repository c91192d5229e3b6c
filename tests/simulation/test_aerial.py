"""The UAV's pictures: everything where the camera says, each pixel's truth, and the same picture every time."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from torchvision_dddas.simulation import CameraParameters, Scenario, World, WorldParameters, build_world
from torchvision_dddas.simulation.aerial_camera import AerialCamera
from torchvision_dddas.simulation.agents import Moment
from torchvision_dddas.simulation.cameras import camera_axes, view_from_pose
from torchvision_dddas.types import Bodies, CameraPose, Elevation

SIDE_M = 120.0
CLEAR = {
    "exposure_s": 0,
    "readout_s": 0,
    "sharpness_px": 0,
    "shot_noise": 0,
    "read_noise": 0,
    "drift": 0,
    "quality": 100,
}


@pytest.fixture(scope="module")
def bare() -> World:
    """Grey ground with some relief and nothing on it."""
    parameters = WorldParameters(side_m=SIDE_M, relief_m=4, bushes_per_ha=0, trees_per_ha=0, buildings=0)
    world = build_world(parameters, seed=1)
    return replace(world, albedo=np.full_like(world.albedo, 120), surface=np.zeros_like(world.surface))


def scenario(**camera: float) -> Scenario:
    return Scenario(camera=CameraParameters.model_validate({**CLEAR, **camera}), seed=5)


def people(places: np.ndarray, world: World, target: np.ndarray | int = 1, facing: float = 0.4) -> Bodies:
    """People who stand at places (N, 2)."""
    n = len(places)
    feet = np.c_[places, world.up_m(np.asarray(places, float))]
    return Bodies(
        np.arange(1, n + 1), np.full(n, "person"), np.broadcast_to(target, n).astype(np.int64), feet,
        np.zeros((n, 2)), np.full(n, facing), np.full(n, 1.75), np.zeros(n), np.full((n, 3), 200.0),
        np.full((n, 3), np.nan), np.zeros(n, bool),
    )  # fmt: skip


def vehicle(kind: str, place: tuple[float, float], world: World, hidden: bool = False) -> Bodies:
    plate = (0.0, 0.0, 255.0) if kind == "ugv" else (np.nan,) * 3
    return replace(
        people(np.array([place]), world), kind=np.array([kind]), plate=np.array([plate]), hidden=np.array([hidden]),
        colour=np.full((1, 3), 90.0),
    )  # fmt: skip


def moment(world: World, bodies: Bodies, altitude=50.0, pitch=90.0, number=1, velocity=(0, 0, 0), turn=(0, 0, 0)):
    """The camera looks at the origin, with its upper edge towards 25 degrees."""
    turned = camera_axes(np.radians(25), np.radians(pitch), np.radians(2))
    place = -turned[:, 2] * altitude / np.sin(np.radians(pitch))
    return Moment(
        number, number / 10, bodies, CameraPose(place, turned), np.array(velocity, float), np.array(turn, float), None,
        (), np.zeros(0), np.zeros((0, 2)), np.zeros(0),
    )  # fmt: skip


def nobody(world: World) -> Bodies:
    return people(np.zeros((0, 2)), world)


def marked(world: World, places: np.ndarray) -> World:
    """With a round white spot at each place."""
    albedo = world.albedo.copy()
    v, u = np.mgrid[:9, :9] - 4
    for east, north in places:
        column, row = (east + SIDE_M / 2) / world.texel_m - 0.5, (SIDE_M / 2 - north) / world.texel_m - 0.5
        x, y = round(column), round(row)
        spot = np.exp(-((u - column + x) ** 2 + (v - row + y) ** 2) / 3)
        albedo[y - 4 : y + 5, x - 4 : x + 5] = (120 + 130 * spot)[..., None]
    return replace(world, albedo=albedo)


def spots(image: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Where the bright spots near pixels (N, 2) truly are."""
    found = []
    for u, v in near:
        x, y = round(float(u)), round(float(v))
        patch = np.maximum(image[y - 12 : y + 13, x - 12 : x + 13, 0].astype(float) - 120, 0)
        rows, columns = np.mgrid[-12:13, -12:13]
        found.append([x + (patch * columns).sum() / patch.sum(), y + (patch * rows).sum() / patch.sum()])
    return np.array(found)


PLACES = np.array([[0.3, 0.2], [-12.1, 7.7], [9.4, -8.3], [14.0, 11.0], [-9.0, -10.5]])


@pytest.mark.parametrize(("pitch", "altitude"), [(90, 60), (60, 55), (45, 50)])
def test_a_point_of_the_ground_appears_where_the_camera_projects_it(bare, pitch, altitude):
    camera = AerialCamera(marked(bare, PLACES), scenario())
    now = moment(bare, nobody(bare), altitude, pitch)
    image, _, _ = camera.take(now)
    expected = view_from_pose(now.pose, camera.camera).project(np.c_[PLACES, bare.up_m(PLACES)])
    assert np.abs(spots(image, expected) - expected).max() < 0.1


def test_a_rolling_shutter_shifts_each_row_by_what_the_camera_did_until_it_was_read(bare):
    world = marked(bare, PLACES)
    still = moment(world, nobody(world), 60)
    moving = moment(world, nobody(world), 60, velocity=(8.0, -5.0, 1.0), turn=(0.1, -0.2, 0.3))
    camera = AerialCamera(world, scenario(readout_s=0.03))
    view = view_from_pose(still.pose, camera.camera)
    points = np.c_[PLACES, world.up_m(PLACES)]
    expected = []
    for point in points:
        row = view.project(point[None])[0, 1]
        for _ in range(4):
            lag = (row / 479 - 0.5) * 0.03
            turned, _ = cv2.Rodrigues(moving.turn_rad_s * lag)
            pose = CameraPose(moving.pose.place_m + lag * moving.velocity_m_s, turned @ moving.pose.axes)
            pixel = view_from_pose(pose, camera.camera).project(point[None])[0]
            row = pixel[1]
        expected.append(pixel)
    assert np.abs(np.array(expected) - view.project(points)).max() > 1
    image, _, _ = camera.take(moving)
    assert np.abs(spots(image, np.array(expected)) - expected).max() < 0.1
    # Bodies are read row by row as well.
    _, _, bodies = camera.take(replace(moving, bodies=people(PLACES, world)))
    for k, pixel in enumerate(expected):
        v, u = np.nonzero(bodies == k + 1)
        assert np.hypot(u.mean() - pixel[0], v.mean() - pixel[1]) < 0.5 * np.hypot(*(pixel - (319.5, 239.5))) * 0.05 + 3


def test_vibration_moves_rows_aside_anew_in_each_picture_and_only_while_the_shutter_rolls(bare):
    world = marked(bare, PLACES)
    camera = AerialCamera(world, scenario(readout_s=0.015, vibration_px=2))
    calm = moment(world, nobody(world), 60)
    steady = view_from_pose(calm.pose, camera.camera).project(np.c_[PLACES, world.up_m(PLACES)])
    offs = []
    for number in (1, 2):
        image, _, _ = camera.take(replace(calm, number=number))
        offs.append(spots(image, steady) - steady)
        # The truth moves with the picture.
        _, _, bodies = camera.take(replace(calm, number=number, bodies=people(PLACES, world)))
        _, _, unmoved = AerialCamera(world, scenario()).take(replace(calm, bodies=people(PLACES, world)))
        for k in range(len(PLACES)):
            shown, meant = (np.argwhere(mask == k + 1).mean(axis=0)[::-1] for mask in (bodies, unmoved))
            assert np.abs(shown - meant - offs[-1][k]).max() < 0.6
    assert np.abs(offs[0] - offs[1]).max() > 1
    assert np.abs(offs).max() < 2 * np.sqrt(2) + 0.1
    assert np.ptp(offs[0], axis=0).max() > 1
    global_shutter = AerialCamera(world, scenario(readout_s=0, vibration_px=2))
    image, _, _ = global_shutter.take(calm)
    plain = spots(image, steady) - steady
    assert np.abs(plain - plain[0]).max() < 0.1


@pytest.mark.parametrize(("altitude", "pitch"), [(50, 90), (50, 45), (150, 90)])
def test_the_mask_of_a_crowd_lies_where_its_people_are(bare, altitude, pitch):
    grid = np.stack(np.meshgrid(np.arange(-2, 3), np.arange(-2, 3)), axis=-1).reshape(-1, 2)
    crowd = people(2.5 * grid, bare)
    camera = AerialCamera(bare, scenario(width_px=1280, height_px=720))
    now = moment(bare, crowd, altitude, pitch)
    _, targets, bodies = camera.take(now)
    assert set(np.unique(targets)) == {0, 1}
    assert ((targets > 0) == (bodies > 0)).all()
    middle = view_from_pose(now.pose, camera.camera).project(crowd.place_m + np.array([0, 0, 0.95]))
    seen = np.array([np.argwhere(bodies == number).mean(axis=0)[::-1] for number in crowd.number])
    assert np.abs((seen - middle).mean(axis=0)).max() < 0.6
    assert np.linalg.norm(seen - middle, axis=1).max() < 2.5


def box(world: World, low: tuple[float, float], high: tuple[float, float], height_m: float) -> World:
    """With a building, from a south-western corner to a north-eastern one."""
    surface = world.surface.copy()
    texel = world.surface_texel_m
    columns = slice(*(round((east + SIDE_M / 2) / texel) for east in (low[0], high[0])))
    rows = slice(*(round((SIDE_M / 2 - north) / texel) for north in (high[1], low[1])))
    surface[rows, columns] = height_m
    return replace(world, surface=surface, relief=Elevation(np.zeros((3, 3)), (-SIDE_M / 2,) * 2, SIDE_M / 2))


def test_people_behind_a_building_are_hidden_and_those_in_front_of_it_are_not(bare):
    world = box(bare, (-6, 2), (6, 5), 5.0)
    # The camera looks north: behind is where it cannot see.
    crowd = people(np.array([[0.0, 6.0], [0.0, 1.0], [0.0, 14.0]]), world)
    now = moment(world, crowd, 40, 45)
    turned = camera_axes(0.0, np.radians(45), 0.0)
    now = replace(now, pose=CameraPose(-turned[:, 2] * 40 * np.sqrt(2), turned))
    _, _, bodies = AerialCamera(world, scenario()).take(now)
    assert set(np.unique(bodies)) == {0, 2, 3}
    down = replace(now, pose=CameraPose(np.array([0, 0, 40.0]), camera_axes(0.0, np.pi / 2, 0.0)))
    _, _, bodies = AerialCamera(world, scenario()).take(down)
    assert set(np.unique(bodies)) == {0, 1, 2, 3}


@pytest.mark.parametrize("pitch", [90, 60, 45])
def test_the_top_of_a_building_appears_where_the_camera_projects_it(bare, pitch):
    world = box(bare, (-4, -3), (8, 3), 6.0)
    albedo = world.albedo.copy()
    texel = world.texel_m
    roof = slice(round((SIDE_M / 2 - 3) / texel), round((SIDE_M / 2 + 3) / texel))
    albedo[roof, round((SIDE_M / 2 - 4) / texel) : round((SIDE_M / 2 + 8) / texel)] = 240
    world = replace(world, albedo=albedo)
    camera = AerialCamera(world, scenario())
    now = moment(world, nobody(world), 60, pitch)
    image, _, _ = camera.take(now)
    corners = np.array([[-4, -3, 6], [8, -3, 6], [8, 3, 6], [-4, 3, 6.0]])
    outline = view_from_pose(now.pose, camera.camera).project(corners)
    expected = cv2.fillConvexPoly(np.zeros(image.shape[:2], np.uint8), np.round(outline * 16).astype(np.int32), 1, 8, 4)
    # The walls are darker than the roof, as the sun does not shine along it.
    roof_seen = image[..., 0] > 200
    both, either = (roof_seen & (expected > 0)).sum(), (roof_seen | (expected > 0)).sum()
    assert both / either > 0.85


def test_a_body_casts_a_shadow_away_from_the_sun_and_the_shadow_is_no_target(bare):
    here = people(np.array([[0.0, 0.0]]), bare)
    camera = AerialCamera(bare, scenario(width_px=1280, height_px=720))
    with_body, targets, _ = camera.take(moment(bare, here))
    without, _, _ = camera.take(moment(bare, nobody(bare)))
    dark = (with_body.astype(int) - without).max(axis=2) < -20
    dark &= cv2.dilate(targets.astype(np.uint8), np.ones((3, 3))) == 0
    assert dark.sum() > 40
    v, u = np.nonzero(dark)
    to_sun = bare.to_sun @ moment(bare, here).pose.axes
    mask_v, mask_u = np.nonzero(targets)
    away = np.array([u.mean() - mask_u.mean(), v.mean() - mask_v.mean()])
    assert away @ to_sun[:2] < -0.9 * np.linalg.norm(away) * np.linalg.norm(to_sun[:2])


def test_a_plate_shows_its_colour_and_a_covered_one_does_not(bare):
    camera = AerialCamera(bare, scenario())
    open_, targets, _ = camera.take(moment(bare, vehicle("ugv", (3, 2), bare)))
    covered, _, _ = camera.take(moment(bare, vehicle("ugv", (3, 2), bare, hidden=True)))
    red = [(image[..., 2] > 180) & (image[..., 0] < 60) for image in (open_, covered)]
    assert red[0].sum() > 150
    assert not red[1].any()
    # The plate is in the middle of its vehicle.
    middles = [np.argwhere(mask).mean(axis=0) for mask in (red[0], targets > 0)]
    assert np.abs(middles[0] - middles[1]).max() < 0.6


@pytest.mark.parametrize("kind", ["car", "ugv"])
def test_vehicles_have_their_length_and_lie_along_their_heading(bare, kind):
    camera = AerialCamera(bare, scenario(width_px=1280, height_px=960))
    here = replace(vehicle(kind, (0, 0), bare), facing_rad=np.radians([25.0]))
    _, targets, _ = camera.take(moment(bare, here))
    points = np.argwhere(targets > 0)[:, ::-1].astype(np.float32)
    (_, size, _), scale = cv2.minAreaRect(points), 1280 / 2 / np.tan(np.radians(30)) / 49.5
    length = {"car": 4.4, "ugv": 2.4}[kind]
    assert max(size) / scale == pytest.approx(length, abs=0.2)
    # The upper edge of the picture, but for 2 degrees, is the heading: the vehicle stands upright in it.
    assert np.ptp(points[:, 1]) > 1.2 * np.ptp(points[:, 0])


def test_a_picture_depends_on_the_seed_and_its_moment_alone(bare):
    world = build_world(WorldParameters(side_m=SIDE_M), seed=2)
    parameters = Scenario(seed=7)
    crowd = people(np.array([[0.0, 1.0], [2.0, 2.0]]), world)
    first, second = AerialCamera(world, parameters), AerialCamera(world, parameters)
    for number in (1, 2, 3):
        first.take(moment(world, crowd, number=number))
    ours, theirs = (camera.take(moment(world, crowd, number=4)) for camera in (first, second))
    assert all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True))
    other, _, _ = AerialCamera(world, Scenario(seed=8)).take(moment(world, crowd, number=4))
    assert not np.array_equal(other, ours[0])


def test_nothing_is_left_to_see_where_a_hill_lies_between(bare):
    up = np.zeros((25, 25))
    up[12:14, :] = 12.0  # a ridge from west to east, just north of the middle
    ridge = replace(bare, relief=Elevation(up, (-SIDE_M / 2,) * 2, SIDE_M / 24))
    crowd = people(np.array([[0.0, 14.0], [0.0, -8.0]]), ridge)
    turned = camera_axes(0.0, np.radians(30), 0.0)
    now = replace(moment(ridge, crowd), pose=CameraPose(np.array([0.0, -35.0, 22.0]), turned))
    _, _, bodies = AerialCamera(ridge, scenario()).take(now)
    assert set(np.unique(bodies)) == {0, 2}


def test_a_long_exposure_blurs_the_ground_along_the_flight_and_a_car_along_its_own_way(bare):
    world = marked(bare, PLACES)
    sharp, blurred = (AerialCamera(world, scenario(width_px=1280, height_px=960, exposure_s=s)) for s in (0.0, 0.04))
    # To the right of the picture at 10 m/s: 40 cm, 9 pixels.
    now = moment(world, nobody(world))
    now = replace(now, velocity_m_s=10 * now.pose.axes[:, 0])
    clear, drawn_out = sharp.take(now)[0], blurred.take(now)[0]
    steep = [
        np.abs(np.diff(image[..., 0].astype(int), axis=axis)).max() for image in (clear, drawn_out) for axis in (0, 1)
    ]
    assert steep[3] < 0.5 * steep[1]
    car = replace(vehicle("car", (0, 0), world), velocity_m_s=np.array([[20.0, 0.0]]), facing_rad=np.array([np.pi / 2]))
    still = moment(world, car)
    (a, mask_a, _), (b, mask_b, _) = sharp.take(still), blurred.take(still)
    assert np.array_equal(mask_a, mask_b)
    changed = np.argwhere((a != b).any(axis=2))
    own = np.argwhere(mask_a > 0)
    # Half of the way of 80 cm beyond either end, and no change of the ground further off.
    assert np.ptp(changed, axis=0).max() == pytest.approx(np.ptp(own, axis=0).max() + 0.8 * 22, abs=8)


def test_bodies_in_the_shade_of_a_building_are_darker_and_cast_no_shadow(bare):
    world = box(bare, (-8, -3), (8, 3), 8.0)
    north_west = -world.to_sun[:2] / np.linalg.norm(world.to_sun[:2])
    place = np.array([0.0, 3.5]) + 2.0 * north_west
    means = []
    for ground in (world, replace(bare, relief=world.relief)):
        camera = AerialCamera(ground, scenario())
        image, mask, _ = camera.take(moment(ground, people(place[None], ground)))
        empty, _, _ = camera.take(moment(ground, nobody(ground)))
        means.append(image[mask > 0].mean())
        around = cv2.dilate((mask > 0).astype(np.uint8), np.ones((3, 3))) > 0
        means.append(((image.astype(int) - empty).max(axis=2) < -20)[~around].sum())
    assert means[0] < 0.7 * means[2]
    assert means[1] == 0
    assert means[3] > 10
