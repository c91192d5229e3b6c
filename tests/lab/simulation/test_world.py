"""The simulated world: the same every time, lit from where the sun stands, and as high where it says so."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.simulation.scenario import WorldParameters
from torchvision_dddas.lab.simulation.world import build_world, shadow_above_ground, shore_north_m, sun_direction
from torchvision_dddas.types import Elevation, Ortho

PARAMETERS = WorldParameters(side_m=60, bushes_per_ha=300, trees_per_ha=20, buildings=1)
BARE = WorldParameters(side_m=60, bushes_per_ha=0, trees_per_ha=0, buildings=0, relief_m=0)


@pytest.fixture(scope="module")
def world():
    return build_world(PARAMETERS, seed=3)


def bare(**changed):
    return BARE.model_copy(update=changed)


def test_same_seed_gives_the_same_world_and_another_seed_another(world):
    again, other = build_world(PARAMETERS, seed=3), build_world(PARAMETERS, seed=4)
    parts = [(w.albedo, w.surface, w.relief.up_m) for w in (world, again, other)]
    assert all(np.array_equal(a, b) and not np.array_equal(a, c) for a, b, c in zip(*parts, strict=True))


@pytest.mark.parametrize("parameters", [PARAMETERS, BARE])
def test_the_texture_does_not_depend_on_the_bands_it_is_made_in(monkeypatch, parameters):
    whole = build_world(parameters, seed=3).albedo.astype(int)
    monkeypatch.setattr("torchvision_dddas.lab.simulation.world._AT_ONCE", 72 * 600)
    off = np.abs(build_world(parameters, seed=3).albedo.astype(int) - whole)
    # Rounding of a filter that begins elsewhere.
    assert off.max() <= 1
    assert np.mean(off > 0) < 0.01


def test_height_is_bilinear_and_mirrored_at_the_edges():
    hilly = build_world(bare(relief_m=5.0), seed=1)
    relief = hilly.relief
    nodes = np.array(relief.corner_m) + relief.step_m * np.array([[3, 5], [4, 5], [3, 6], [4, 6]])
    heights = relief.up_m[[5, 5, 6, 6], [3, 4, 3, 4]]
    assert hilly.up_m(nodes) == pytest.approx(heights)
    assert hilly.up_m(nodes.mean(0)[None]) == pytest.approx([heights.mean()])
    half = hilly.side_m / 2
    inside = np.array([[half - 4, 7.0], [-half + 2, -3], [1, half - 6]])
    outside = np.array([[half + 4, 7.0], [-half - 2, -3], [1, half + 6]])
    assert hilly.up_m(outside) == pytest.approx(hilly.up_m(inside))


def test_a_given_elevation_replaces_the_hills():
    north, east = np.mgrid[-60:61:5.0, -50:51:5.0]
    given = Elevation(0.05 * east - 0.02 * north + 7, (-50.0, -60.0), 5.0, base_m=1200.0)
    made = build_world(BARE, seed=0, elevation=given)
    places = np.random.default_rng(0).uniform(-30, 30, (40, 2))
    assert made.up_m(places) == pytest.approx(places @ [0.05, -0.02], abs=1e-3)
    assert made.relief.base_m == pytest.approx(1207, abs=1e-3)


@pytest.mark.parametrize(("west_m", "hole", "share"), [(0.0, slice(0), "5[01]"), (-60.0, slice(20, 24), "9[0-9]")])
def test_an_elevation_that_does_not_cover_the_world_is_refused(west_m, hole, share):
    up_m = np.zeros((41, 41))
    up_m[hole, hole] = np.nan
    with pytest.raises(InputError, match=rf"covers {share} % of the world: it has heights from .* m east"):
        build_world(BARE, seed=0, elevation=Elevation(up_m, (west_m, -60.0), 3.0))


def test_a_world_of_too_many_pixels_is_refused_with_the_texel_that_is_possible():
    with pytest.raises(InputError, match=r"40000 pixels per side; .* set world.texel_m to 0.334 or more"):
        build_world(bare(side_m=4000.0), seed=0)


def test_things_stand_where_the_list_says_and_nowhere_else(world):
    things, texel = world.things, world.surface_texel_m
    assert set(things.kind) == {"bush", "tree", "building"}
    middle = (np.arange(world.surface.shape[0]) + 0.5) * texel - world.side_m / 2
    apart = [np.hypot(middle[None] - east, -middle[:, None] - north) for east, north in things.east_north_m]
    reach = np.min([d - r for d, r in zip(apart, things.radius_m, strict=True)], axis=0)
    assert not world.surface[reach > 2 * texel].any()
    for distance, radius, height in zip(apart, things.radius_m, things.height_m, strict=True):
        # The smallest bushes are but a few pixels, which level their tops.
        assert world.surface[distance < radius].max() > (0.55 if radius > 0.8 else 0.25) * height
    assert world.surface.max() <= things.height_m.max()
    assert np.abs(things.east_north_m).max() < world.side_m / 2


def test_nothing_stands_near_the_places_kept_clear():
    places = np.array([[0.0, 0.0], [12.0, -9.0], [-20, 15]])
    for keep_clear, near in ((None, True), ((places, 4.0), False)):
        things = build_world(bare(bushes_per_ha=800.0), seed=2, keep_clear=keep_clear).things
        apart = np.hypot(*(things.east_north_m[:, None] - places).T) - things.radius_m
        assert (apart.min() < 4) == near


@pytest.mark.parametrize("azimuth_deg", [90.0, 215.0])
def test_shadows_fall_away_from_the_sun_as_long_as_it_is_low(azimuth_deg):
    to_sun = sun_direction(azimuth_deg, 40)
    heights = np.zeros((161, 161), np.float32)
    heights[79:82, 79:82] = 5  # a pole in pixels of 0.25 m
    over = shadow_above_ground(heights, 0.25, to_sun)
    way = -to_sun[:2] / np.hypot(*to_sun[:2])
    metres = np.array([0.5, 0.85, 1.15, -0.5]) * 5 / np.tan(np.radians(40))
    half, most, beyond, before = over[
        np.round(80 - metres * way[1] / 0.25).astype(int), np.round(80 + metres * way[0] / 0.25).astype(int)
    ]
    assert half == pytest.approx(2.5, abs=0.4)
    assert most > 0
    assert max(beyond, before) < 0
    assert (shadow_above_ground(heights, 0.25, np.array([0.0, 0, 1])) < 0).all()  # of a sun overhead


def test_ground_in_shadow_is_darker_and_bluer():
    lit, shaded = (build_world(bare(sun_height_deg=30.0, buildings=count), seed=5) for count in (0, 1))
    (place,), (radius,), (height,) = shaded.things.east_north_m, shaded.things.radius_m, shaded.things.height_m
    assert height > 2
    behind = place - (radius + np.arange(0.2, 0.6, 0.1))[:, None] * lit.to_sun[:2] / np.hypot(*lit.to_sun[:2])
    rows, columns = ((30 + sign * behind[:, axis]) / lit.texel_m for sign, axis in ((-1, 1), (1, 0)))
    at = rows.astype(int), columns.astype(int)
    blue, _, red = (shaded.albedo[at] / np.maximum(lit.albedo[at], 1.0)).mean(0)
    assert red < 0.6
    assert blue > red


@pytest.mark.parametrize("width_m", [0.1, 0.35])
def test_keypoints_are_found_everywhere(width_m):
    grey = cv2.cvtColor(build_world(bare(side_m=120.0), seed=6).albedo, cv2.COLOR_BGR2GRAY)
    seen = cv2.resize(grey, None, fx=0.1 / width_m, fy=0.1 / width_m, interpolation=cv2.INTER_AREA)
    strength, cells = cv2.cornerMinEigenVal(seen, 3), len(seen) // 48
    # Eigenvalues of a corner between greys 20 apart: sensor noise of 1.5 gives a tenth of it.
    corners = (strength == cv2.dilate(strength, np.ones((11, 11)))) & (strength > 1e-3)
    assert corners[: 48 * cells, : 48 * cells].reshape(cells, 48, cells, 48).sum(axis=(1, 3)).min() >= 3


def photo_of(image):
    """A photo in pixels of 0.1 m about the origin, north up."""
    return Ortho(image, np.array([[0.1, 0, -29.95], [0, -0.1, 29.95]]))


def test_a_photo_on_the_same_grid_is_the_texture_and_its_holes_are_soil_of_its_colour():
    image = np.random.default_rng(1).integers(60, 120, (600, 600, 3), np.uint8)
    assert np.array_equal(build_world(BARE, seed=0, photo=photo_of(image)).albedo, image)
    for empty in (255, 0):
        image[:200] = empty
        made = build_world(BARE, seed=0, photo=photo_of(image)).albedo
        assert np.array_equal(made[220:], image[220:])
        assert made[:190].mean() == pytest.approx(90, rel=0.25)
        assert made[:190].std() > 5


@pytest.mark.parametrize("pixel_m", [0.08, 0.4])
def test_a_photo_turned_and_finer_or_coarser_lies_where_its_matrix_says(pixel_m):
    side = round(120 / pixel_m)
    image = np.full((side, side, 3), 90, np.uint8)
    spot = round(0.63 * side), round(0.37 * side)
    cv2.circle(image, spot, round(1.6 / pixel_m), (40, 60, 210), -1)
    turn = np.radians(30)
    turned = pixel_m * np.array([[np.cos(turn), np.sin(turn)], [np.sin(turn), -np.cos(turn)]])
    matrix = np.c_[turned, -turned @ [side / 2, side / 2]]
    made = build_world(BARE, seed=0, photo=Ortho(image, matrix))
    rows, columns = np.nonzero(made.albedo[..., 2] > 150)
    east, north = (columns.mean() + 0.5) * 0.1 - 30, 30 - (rows.mean() + 0.5) * 0.1
    assert (east, north) == pytest.approx(matrix @ [*spot, 1], abs=0.05 if pixel_m < 0.1 else 0.2)


def test_a_photo_of_elsewhere_is_refused():
    away = Ortho(np.full((50, 50, 3), 90, np.uint8), np.array([[0.1, 0, 500], [0, -0.1, 40]]))
    with pytest.raises(InputError, match="shows nothing of the world: it lies from 500 m to 505 m east"):
        build_world(BARE, seed=0, photo=away)


def test_poles_are_thin_and_high_and_nothing_stands_in_the_water():
    things = build_world(bare(poles=12, trees_per_ha=40.0, shore_m=10.0), seed=4).things
    poles = things.radius_m < 0.3
    assert poles.sum() >= 6 and (things.height_m[poles] > 4).all()
    assert (things.east_north_m[:, 1] > shore_north_m(things.east_north_m[:, 0], 10.0)).all()
