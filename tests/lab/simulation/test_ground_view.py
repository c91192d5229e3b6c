"""What a ground vehicle's camera shows: the truth beside it, what hides what, and what it reports of itself."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.lab.simulation.small import bodies_at, moment_of
from torchvision_dddas.lab.simulation import Scenario
from torchvision_dddas.lab.simulation.ground_camera import GroundCamera
from torchvision_dddas.lab.simulation.scenario import GpsParameters, TeamParameters, WorldParameters
from torchvision_dddas.lab.simulation.world import build_world

BARE = WorldParameters(side_m=80, texel_m=0.1, relief_m=0, bushes_per_ha=0, trees_per_ha=0, buildings=0)
SMALL = Scenario(seed=3, world=BARE, team=TeamParameters(width_px=320, height_px=240), gps=GpsParameters(error95_m=3.5))


@pytest.fixture(scope="module")
def bare():
    return build_world(BARE, 3)


def moment(*places, kind="person", **how):
    """One vehicle at the origin that looks north; bodies at (east, north) walk to the east."""
    kinds = ["ugv"] + [kind] * len(places)
    n = len(kinds)
    at = np.array([(0.0, 0.0, 0.0), *((*place, 0.0) for place in places)])
    walking = {"velocity_m_s": np.tile((1.2, 0.0), (n, 1)), "facing_rad": np.full(n, np.pi / 2)}
    return moment_of(bodies_at(at, kinds, phase=np.linspace(0, 1, n), **walking), **how)


def look(world, now):
    """Picture, mask and view, and by number the box of each person, as if nothing hid it, and the share that shows."""
    image, mask, view, outlines = GroundCamera(world, SMALL).look(now, 0)
    people = {}
    for number, limbs in outlines.items():
        low, high = limbs.min(axis=(0, 1)), limbs.max(axis=(0, 1))
        whole = np.zeros(mask.shape, np.uint8)
        for limb in np.round(limbs).astype(np.int32):
            cv2.fillConvexPoly(whole, limb, 1)
        people[number] = *(low + 0.5), *(high - low), (mask == number).sum() / max(whole.sum(), 1)
    return image.astype(int), mask, view, people


def test_a_picture_comes_with_the_camera_that_its_vehicle_reports_and_a_silent_one_takes_none(bare):
    picture = GroundCamera(bare, SMALL).take(moment((0, 8)), 0)
    assert picture is not None
    camera = picture.camera
    assert (picture.vehicle, picture.frame, picture.image.shape) == ("ugv1", 1, (240, 320, 3))
    assert (camera.size_px, camera.geographic, camera.place) == ((320, 240), True, (-110.95, 31.6))
    assert (camera.heading_rad, camera.pitch_rad, camera.height_m) == (0.02, 0.0, 1.3)
    assert camera.position_sigma_m == pytest.approx(3.5 / 2.4477)
    assert 2 * np.degrees(np.arctan(160 / camera.focal_px[0])) == pytest.approx(56)
    silent = moment((0, 8), reported_lonlat_deg=np.full((1, 2), np.nan))
    assert GroundCamera(bare, SMALL).take(silent, 0) is None


def test_someone_stands_where_the_camera_s_geometry_says(bare):
    _, mask, view, people = look(bare, moment((1.5, 10)))
    ((number, (x, y, width, height, _)),) = people.items()
    focal_px = GroundCamera(bare, SMALL).focal_px
    assert number == 2
    assert x + width / 2 - 0.5 == pytest.approx(159.5 + focal_px * 0.15, abs=4)
    assert height == pytest.approx(focal_px * 0.175, rel=0.06)
    assert y + height - 0.5 == pytest.approx(view.project(np.array([1.5, 10, 0]))[1], abs=2)
    rows, columns = np.nonzero(mask == 2)
    assert (rows.min(), rows.max()) == (pytest.approx(y, abs=1.5), pytest.approx(y + height - 1, abs=1.5))
    assert columns.min() == pytest.approx(x, abs=1.5)


def test_the_nearer_of_two_hides_the_farther(bare):
    _, _, _, people = look(bare, moment((0, 12), (0, 6)))
    assert people[2][-1] < 0.35
    assert people[3][-1] > 0.95


@pytest.mark.parametrize("place", [(0, -8), (8, 2)])
def test_people_beside_or_behind_the_camera_are_not_in_the_picture(bare, place):
    (seen, mask, _, _), (empty, _, _, _) = look(bare, moment(place)), look(bare, moment())
    assert not mask.any()
    # Their shadow may reach into it.
    assert np.abs(seen[:120] - empty[:120]).max() <= 1


@pytest.mark.parametrize(("kind", "length", "height"), [("car", 4.4, 1.42), ("ugv", 2.4, 1.27)])
def test_a_vehicle_is_as_large_as_its_distance_says_even_where_it_is_cut_off(bare, kind, length, height):
    _, mask, _, _ = look(bare, moment((0, 12), kind=kind))
    rows, columns = np.nonzero(mask == 2)
    focal_px = GroundCamera(bare, SMALL).focal_px
    assert np.ptp(columns) == pytest.approx(focal_px * length / 11.2, rel=0.1)
    assert np.ptp(rows) == pytest.approx(focal_px * height / 11.2, rel=0.2)
    _, mask, _, _ = look(bare, moment((0.5, 1.0), kind=kind))
    assert (mask == 2).mean() > 0.15


def test_the_same_moment_gives_the_same_picture_whatever_was_taken_before(bare):
    first, second = GroundCamera(bare, SMALL), GroundCamera(bare, SMALL)
    first.look(moment((2, 9), (0, 5), number=4), 0)
    a, b = (camera.look(moment((0, 7), number=5), 0)[0] for camera in (first, second))
    assert np.array_equal(a, b)


def test_a_hill_hides_who_stands_behind_it(bare):
    north = bare.relief.corner_m[1] + bare.relief.step_m * np.arange(len(bare.relief.up_m))
    ridge = np.broadcast_to(3.0 * np.exp(-(((north - 15) / 3) ** 2))[:, None], bare.relief.up_m.shape)
    hilly = replace(bare, relief=replace(bare.relief, up_m=ridge))
    (_, _, _, over), (_, _, _, flat) = (look(world, moment((0, 30))) for world in (hilly, bare))
    assert flat[2][-1] > over[2][-1] == 0


@pytest.mark.parametrize("grown", [{"bushes_per_ha": 300.0}, {"trees_per_ha": 100.0}, {"buildings": 20}])
def test_plants_and_buildings_stand_in_the_picture(bare, grown):
    empty, *_ = look(bare, moment())
    full, *_ = look(build_world(BARE.model_copy(update=grown), 3), moment())
    assert np.abs(full - empty).max(axis=2)[100:180].mean() > 4
