"""What a ground vehicle's camera shows: the truth beside it, what hides what, and what it says of itself."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from torchvision_dddas.simulation import GpsParameters, Scenario, TeamParameters, World, WorldParameters, build_world
from torchvision_dddas.simulation.agents import Moment
from torchvision_dddas.simulation.ground_camera import GroundCamera
from torchvision_dddas.types import Bodies, CameraPose

BARE = WorldParameters(side_m=80, texel_m=0.1, relief_m=0, bushes_per_ha=0, trees_per_ha=0, buildings=0)
SMALL = Scenario(seed=3, world=BARE, team=TeamParameters(width_px=320, height_px=240), gps=GpsParameters(error95_m=3.5))


@pytest.fixture(scope="module")
def bare() -> World:
    return build_world(BARE, 3)


def moment(*people: tuple[float, float], kinds: str = "person", number: int = 1, up: float = 0.0) -> Moment:
    """One vehicle at the origin that looks north; bodies at (east, north)."""
    kind = np.array(["ugv"] + [kinds] * len(people))
    n = len(kind)
    place = np.array([(0.0, 0.0, 0.0), *((*one, up) for one in people)])
    plate = np.full((n, 3), np.nan)
    plate[kind == "ugv"] = (0, 0, 230)
    bodies = Bodies(
        np.arange(1, n + 1), kind, np.arange(1, n + 1), place, np.tile((1.2, 0.0), (n, 1)), np.full(n, np.pi / 2),
        np.full(n, 1.75), np.linspace(0, 1, n), np.tile((150.0, 60, 40), (n, 1)), plate, np.zeros(n, bool),
    )  # fmt: skip
    pose = CameraPose(np.array([0, 0, 50.0]), np.eye(3))
    said = np.array([[-110.95, 31.6]])
    still = np.zeros(3)
    return Moment(number, number / 10, bodies, pose, still, still, None, (), np.zeros(1), said, np.full(1, 0.02))


class Sight:
    """What a camera sees, with the box of each person, as if nothing hid it, and the share of it that shows."""

    def __init__(self, camera: GroundCamera, now: Moment) -> None:
        self.image, self.mask, self.view, outlines = camera.look(now, 0)
        self.number = sorted(outlines)
        self.box_px: list[list[float]] = []
        self.visible: list[float] = []
        for n in self.number:
            low, high = outlines[n].min(axis=(0, 1)), outlines[n].max(axis=(0, 1))
            self.box_px.append([*(low + 0.5), *(high - low)])
            whole = np.zeros(self.mask.shape, np.uint8)
            for limb in np.round(outlines[n]).astype(np.int32):
                cv2.fillConvexPoly(whole, limb, 1)
            self.visible.append((self.mask == n).sum() / max(whole.sum(), 1))


def test_a_picture_comes_with_the_camera_that_the_vehicle_reports(bare: World) -> None:
    picture = GroundCamera(bare, SMALL).take(moment((0, 8)), 0)
    assert picture is not None
    camera = picture.camera
    assert (picture.vehicle, picture.frame, picture.image.shape) == ("ugv1", 1, (240, 320, 3))
    assert camera.size_px == (320, 240)
    assert camera.geographic
    assert camera.place == (-110.95, 31.6)
    assert camera.heading_rad == 0.02
    assert (camera.pitch_rad, camera.height_m) == (0.0, 1.3)
    assert camera.position_sigma_m == pytest.approx(3.5 / 2.4477)
    assert 2 * np.degrees(np.arctan(160 / camera.focal_px[0])) == pytest.approx(56)


def test_a_vehicle_that_is_silent_takes_no_picture(bare: World) -> None:
    silent = replace(moment((0, 8)), reported_lonlat_deg=np.full((1, 2), np.nan))
    assert GroundCamera(bare, SMALL).take(silent, 0) is None


def test_someone_stands_where_the_camera_s_geometry_says(bare: World) -> None:
    camera = GroundCamera(bare, SMALL)
    sight = Sight(camera, moment((1.5, 10)))
    assert sight.number == [2]
    x, y, width, height = sight.box_px[0]
    assert x + width / 2 - 0.5 == pytest.approx(159.5 + camera.focal_px * 0.15, abs=4)
    assert height == pytest.approx(camera.focal_px * 0.175, rel=0.06)
    feet = view_of_point(sight.view, (1.5, 10, 0))
    assert y + height - 0.5 == pytest.approx(feet[1], abs=2)
    rows, columns = np.nonzero(sight.mask == 2)
    assert (rows.min(), rows.max()) == (pytest.approx(y, abs=1.5), pytest.approx(y + height - 1, abs=1.5))
    assert columns.min() == pytest.approx(x, abs=1.5)


def view_of_point(view, point):
    return view.project(np.array([point], float))[0]


def test_the_nearer_of_two_hides_the_farther(bare: World) -> None:
    sight = Sight(GroundCamera(bare, SMALL), moment((0, 12), (0, 6)))
    far, near = sight.visible
    assert near > 0.95
    assert far < 0.35


@pytest.mark.parametrize("place", [(0, -8), (8, 2), (-9, 1)])
def test_whoever_is_beside_or_behind_the_camera_is_not_in_the_picture(bare: World, place: tuple[int, int]) -> None:
    camera = GroundCamera(bare, SMALL)
    seen, empty = Sight(camera, moment(place)), Sight(camera, moment())
    assert not seen.mask.any()
    # Their shadow may reach into it.
    assert np.abs(seen.image[:120].astype(int) - empty.image[:120]).max() <= 1


def test_the_same_moment_gives_the_same_picture_whatever_was_taken_before(bare: World) -> None:
    first, second = GroundCamera(bare, SMALL), GroundCamera(bare, SMALL)
    first.look(moment((2, 9), (0, 5), number=4), 0)
    a, b = (camera.look(moment((0, 7), number=5), 0)[0] for camera in (first, second))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, first.look(moment((0, 7), number=6), 0)[0])


def test_a_hill_hides_who_stands_behind_it(bare: World) -> None:
    rows = bare.relief.corner_m[1] + bare.relief.step_m * np.arange(bare.relief.up_m.shape[0])
    ridge = np.broadcast_to(3.0 * np.exp(-(((rows - 15) / 3) ** 2))[:, None], bare.relief.up_m.shape)
    hilly = replace(bare, relief=replace(bare.relief, up_m=ridge))
    over, flat = (Sight(GroundCamera(world, SMALL), moment((0, 30))) for world in (hilly, bare))
    assert (flat.mask == 2).any()
    assert not (over.mask == 2).any()
    assert over.visible[0] == 0


def test_sky_is_above_and_ground_below_and_plants_stand_between(bare: World) -> None:
    grown = build_world(BARE.model_copy(update={"bushes_per_ha": 300.0}), 3)
    empty, full = (GroundCamera(world, SMALL).look(moment(), 0)[0].astype(float) for world in (bare, grown))
    blue, red = empty[:40, :, 0].mean(), empty[:40, :, 2].mean()
    assert blue > red + 30
    assert empty[-40:, :, 2].mean() > empty[-40:, :, 0].mean()
    assert np.abs(full - empty).max(axis=2)[100:180].mean() > 5
