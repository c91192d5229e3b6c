"""The simulated world: the same every time, lit from where the sun stands, and as high where it says so."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.simulation import WorldParameters, build_world
from torchvision_dddas.simulation.world import shadow_above_ground, sun_direction
from torchvision_dddas.types import Elevation, Ortho

KNOBS = WorldParameters(side_m=60, bushes_per_ha=300, trees_per_ha=20, buildings=1)
BARE = WorldParameters(side_m=60, bushes_per_ha=0, trees_per_ha=0, buildings=0, relief_m=0)


@pytest.fixture(scope="module")
def world():
    return build_world(KNOBS, seed=3)


def texel_of(world, east_north_m):
    """(row, column) of places in the texture."""
    half = world.side_m / 2
    places = np.asarray(east_north_m)
    return (
        np.clip((half - places[..., 1]) / world.texel_m, 0, len(world.albedo) - 1).astype(int),
        np.clip((places[..., 0] + half) / world.texel_m, 0, len(world.albedo) - 1).astype(int),
    )


def test_same_seed_gives_the_same_world_and_another_seed_another(world):
    again, other = build_world(KNOBS, seed=3), build_world(KNOBS, seed=4)
    assert np.array_equal(world.albedo, again.albedo)
    assert np.array_equal(world.surface, again.surface)
    assert np.array_equal(world.relief.up_m, again.relief.up_m)
    assert not np.array_equal(world.albedo, other.albedo)
    assert not np.array_equal(world.relief.up_m, other.relief.up_m)


@pytest.mark.parametrize("parameters", [KNOBS, BARE])
def test_the_texture_does_not_depend_on_the_bands_it_is_made_in(monkeypatch, parameters):
    whole = build_world(parameters, seed=3).albedo.astype(int)
    monkeypatch.setattr("torchvision_dddas.simulation.world._AT_ONCE", 72 * 600)
    off = np.abs(build_world(parameters, seed=3).albedo.astype(int) - whole)
    # Rounding of a filter that begins elsewhere.
    assert off.max() <= 1
    assert np.mean(off > 0) < 0.01


def test_height_is_bilinear_and_mirrored_at_the_edges():
    hilly = build_world(BARE.model_copy(update={"relief_m": 5.0}), seed=1)
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


@pytest.mark.parametrize("hole", [False, True])
def test_an_elevation_that_does_not_cover_the_world_is_refused(hole):
    up_m = np.zeros((41, 41))
    if hole:
        up_m[20:24, 20:24] = np.nan
    given = Elevation(up_m, (-60.0, -60.0) if hole else (0.0, -60.0), 3.0)
    share = "9[0-9]" if hole else "5[01]"
    with pytest.raises(InputError, match=rf"covers {share} % of the world: it has heights from .* m east"):
        build_world(BARE, seed=0, elevation=given)


def test_a_world_of_too_many_pixels_is_refused_with_the_texel_that_would_do():
    parameters = BARE.model_copy(update={"side_m": 4000.0})
    with pytest.raises(InputError, match=r"40000 of them .* set world.texel_m to 0.334 or more"):
        build_world(parameters, seed=0)


def test_things_stand_where_the_list_says_and_nowhere_else(world):
    assert set(world.things.kind) == {"bush", "tree", "building"}
    texel = world.surface_texel_m
    middle = (np.arange(world.surface.shape[0]) + 0.5) * texel - world.side_m / 2
    apart = [np.hypot(middle[None] - east, -middle[:, None] - north) for east, north in world.things.east_north_m]
    reach = np.min([d - r for d, r in zip(apart, world.things.radius_m, strict=True)], axis=0)
    assert not world.surface[reach > 2 * texel].any()
    for distance, radius, height in zip(apart, world.things.radius_m, world.things.height_m, strict=True):
        # The smallest bushes are but a few pixels, which level their tops.
        assert world.surface[distance < radius].max() > (0.55 if radius > 0.8 else 0.25) * height
    assert world.surface.max() <= world.things.height_m.max()
    assert np.abs(world.things.east_north_m).max() < world.side_m / 2


def test_nothing_stands_near_the_places_kept_clear():
    dense = KNOBS.model_copy(update={"bushes_per_ha": 800.0})
    places = np.array([[0.0, 0.0], [12.0, -9.0], [-20, 15]])
    for keep_clear, near in ((None, True), ((places, 4.0), False)):
        made = build_world(dense, seed=2, keep_clear=keep_clear)
        apart = np.hypot(*(made.things.east_north_m[:, None] - places).T) - made.things.radius_m
        assert (apart.min() < 4) == near


@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, 215.0])
def test_shadows_fall_away_from_the_sun_as_long_as_it_is_low(azimuth_deg):
    to_sun = sun_direction(azimuth_deg, 40)
    heights = np.zeros((161, 161), np.float32)
    heights[79:82, 79:82] = 5  # a pole in pixels of 0.25 m
    over = shadow_above_ground(heights, 0.25, to_sun)
    way = -to_sun[:2] / np.hypot(*to_sun[:2])
    length = 5 / np.tan(np.radians(40))

    def at(metres):
        return over[round(80 - metres * way[1] / 0.25), round(80 + metres * way[0] / 0.25)]

    assert at(0.5 * length) == pytest.approx(2.5, abs=0.4)
    assert at(0.85 * length) > 0
    assert at(1.15 * length) < 0
    assert at(-0.5 * length) < 0


def test_ground_in_shadow_is_darker_and_bluer():
    parameters = BARE.model_copy(update={"buildings": 1, "sun_height_deg": 30.0})
    lit, shaded = build_world(BARE.model_copy(update={"sun_height_deg": 30.0}), seed=5), build_world(parameters, seed=5)
    (place,), (radius,), (height,) = shaded.things.east_north_m, shaded.things.radius_m, shaded.things.height_m
    assert height > 2
    way = -lit.to_sun[:2] / np.hypot(*lit.to_sun[:2])
    behind = place + (radius + np.arange(0.2, 0.6, 0.1))[:, None] * way
    rows, columns = texel_of(lit, behind)
    ratio = shaded.albedo[rows, columns] / np.maximum(lit.albedo[rows, columns], 1.0)
    blue, _, red = ratio.mean(0)
    assert red < 0.6
    assert blue > red


@pytest.mark.parametrize("width_m", [0.1, 0.35])
def test_keypoints_are_found_everywhere(width_m):
    made = build_world(BARE.model_copy(update={"side_m": 120.0}), seed=6)
    grey = cv2.cvtColor(made.albedo, cv2.COLOR_BGR2GRAY)
    seen = cv2.resize(grey, None, fx=0.1 / width_m, fy=0.1 / width_m, interpolation=cv2.INTER_AREA)
    cell = 48
    for top in range(0, seen.shape[0] - cell, cell):
        for left in range(0, seen.shape[1] - cell, cell):
            strength = cv2.cornerMinEigenVal(seen[top : top + cell, left : left + cell], 3)
            # Eigenvalues of a corner between greys 20 apart: sensor noise of 1.5 gives a tenth of it.
            assert (strength == cv2.dilate(strength, np.ones((11, 11))))[strength > 1e-3].sum() >= 3


def photo_of(side_px, pixel_m, image=None):
    """A photo about the origin, north up."""
    if image is None:
        image = np.random.default_rng(1).integers(60, 180, (side_px, side_px, 3), np.uint8)
    first = pixel_m * (side_px - 1) / 2
    return Ortho(image, np.array([[pixel_m, 0, -first], [0, -pixel_m, first]]))


def test_a_photo_on_the_same_grid_is_the_texture():
    photo = photo_of(600, 0.1)
    assert np.array_equal(build_world(BARE, seed=0, photo=photo).albedo, photo.image)


def test_a_photo_turned_and_finer_lies_where_its_matrix_says():
    image = np.full((1500, 1500, 3), 90, np.uint8)
    cv2.circle(image, (950, 550), 20, (40, 60, 210), -1)
    turn, pixel_m = np.radians(30), 0.08
    turned = pixel_m * np.array([[np.cos(turn), np.sin(turn)], [np.sin(turn), -np.cos(turn)]])
    matrix = np.c_[turned, -turned @ [750, 750]]
    made = build_world(BARE, seed=0, photo=Ortho(image, matrix))
    rows, columns = np.nonzero(made.albedo[..., 2] > 150)
    east, north = (columns.mean() + 0.5) * 0.1 - 30, 30 - (rows.mean() + 0.5) * 0.1
    assert (east, north) == pytest.approx(matrix @ [950, 550, 1], abs=0.05)


@pytest.mark.parametrize("empty", [255, 0])
def test_holes_of_a_photo_are_filled_with_soil_of_its_colour(empty):
    image = np.random.default_rng(1).integers(60, 120, (600, 600, 3), np.uint8)
    image[:200] = empty
    made = build_world(BARE, seed=0, photo=photo_of(600, 0.1, image)).albedo
    assert np.array_equal(made[220:], image[220:])
    assert made[:190].mean() == pytest.approx(90, rel=0.25)
    assert 20 < np.percentile(made[:190], 0.5) < np.percentile(made[:190], 99.5) < 200
    assert made[:190].std() > 5


def test_a_photo_of_elsewhere_is_refused():
    away = Ortho(np.full((50, 50, 3), 90, np.uint8), np.array([[0.1, 0, 500], [0, -0.1, 40]]))
    with pytest.raises(InputError, match="shows nothing of the world: it lies from 500 m to 505 m east"):
        build_world(BARE, seed=0, photo=away)
