"""Events at zones: when, where and how often targets enter, leave, dwell and cross."""

import math

import numpy as np
import pytest

from tests.zoned import ORIGIN, walk
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import Zones
from torchvision_dddas.geometry import Jitter, crosses_itself, crossings, edges_of, is_inside, lonlat, nearest_on

SQUARE = np.array([[0.0, 0.0], [4, 0], [4, 4], [0, 4]])
GATE = np.array([[2.0, -5.0], [2, 8]])


def events(zones, results):
    return [event for result in results for event in zones.update(result)]


def eastward(t):
    """Enters the square at 3 s, passes the gate at 5 s and leaves at 7 s."""
    return -3 + t, 2.0


def test_a_walker_enters_crosses_dwells_and_leaves_when_its_path_does():
    zones = Zones(polygons={"field": SQUARE}, lines={"gate": GATE}, unit="m", dwell_s=3)
    found = events(zones, walk(eastward, labels={1: "person"}))
    assert [e.kind for e in found] == ["enter", "cross", "dwell", "leave"]
    np.testing.assert_allclose([e.time_s for e in found], [3, 5, 6, 7], atol=0.2)
    np.testing.assert_allclose(found[0].east_north_m, [0, 2], atol=1e-6)
    np.testing.assert_allclose(found[0].lonlat_deg, lonlat(np.array([[0.0, 2.0]]), ORIGIN)[0], atol=1e-9)
    assert found[1].direction == "to_right" and found[3].inside_s == pytest.approx(4, abs=0.01)
    assert all(e.speed_m_s == pytest.approx(1, abs=0.01) and e.label == "person" for e in found)
    assert [e.is_first for e in found] == [True, True, False, False]
    assert "enters field at 1.0 m/s" in found[0].describe()


def test_zones_in_degrees_are_those_in_metres():
    in_m = events(Zones(polygons=[SQUARE], lines=[GATE], unit="m"), walk(eastward, noise_m=0.1))
    degrees = Zones(polygons=[lonlat(SQUARE, ORIGIN)], lines=[lonlat(GATE, ORIGIN)])
    assert [(e.kind, round(e.time_s, 3)) for e in events(degrees, walk(eastward, noise_m=0.1))] == [
        (e.kind, round(e.time_s, 3)) for e in in_m
    ]


def test_zones_in_pixels_need_no_places_and_right_is_right_in_the_picture():
    pixels = [ring * (10, -10) + (0, 200) for ring in (SQUARE, GATE)]  # the gate runs upward in the picture
    zones = Zones(polygons=[pixels[0]], lines=[pixels[1]], unit="px")
    found = events(zones, walk(eastward, located=False))
    assert [(e.kind, e.direction) for e in found] == [("enter", ""), ("cross", "to_right"), ("leave", "")]
    assert found[0].speed_px_s == pytest.approx(10, rel=0.01) and math.isnan(found[0].speed_m_s)
    np.testing.assert_allclose(found[0].image_px, [0, 180], atol=1e-6)


@pytest.mark.parametrize("noise_m", [0.1, 0.3])
def test_a_target_on_the_border_does_not_flicker(noise_m):
    """Without a margin there are dozens of events."""
    zones = Zones(polygons=[SQUARE * 3], lines=[GATE], unit="m")
    border, line = lambda t: (6.0, 0.0), lambda t: (2.0, 2.0)
    found = [events(zones, walk(border, line, seconds=60, noise_m=noise_m, seed=seed)) for seed in range(3)]
    assert sum(len([e for e in one if e.kind != "present"]) for one in found) <= 2


def test_who_comes_back_and_who_was_there_is_told_apart():
    def there_and_back(t):
        return -2 + 5 * abs(t - 6) / 6, 2.0  # inside, out, and inside again

    found = events(Zones(polygons=[SQUARE], unit="m"), walk(there_and_back))
    assert [e.kind for e in found] == ["present", "leave", "enter"] and sum(e.is_first for e in found) == 1


def test_a_walker_around_the_end_of_a_line_does_not_cross_it():
    around = lambda t: (2 - 3 * np.cos(np.pi * t / 12), 8 + 3 * np.sin(np.pi * t / 12))  # noqa: E731
    assert not events(Zones(lines=[GATE], unit="m"), walk(around))
    assert [e.direction for e in events(Zones(lines=[GATE[::-1]], unit="m"), walk(eastward))] == ["to_left"]


def test_what_an_area_leaves_out_is_outside():
    ring = edges_of([SQUARE, SQUARE[::-1] / 4 + 1.5], closed=True)
    points = np.array([[0.5, 0.5], [2.0, 2.0], [5.0, 2.0]])
    assert is_inside(points, ring).tolist() == [True, False, False]
    wanted = np.array([[0.5, 0], [2, 2.5], [4, 2]])
    np.testing.assert_allclose(nearest_on(points, ring), wanted, atol=1e-9)


def test_a_step_through_a_corner_crosses_once():
    edges = edges_of([np.array([[0.0, 0.0], [0, 1], [0, 2]])], closed=False)
    assert crossings(np.array([-1.0, 1.0]), np.array([1.0, 1.0]), edges) == (1, 0.5)


def test_an_outline_that_crosses_or_touches_itself_is_noticed():
    assert not crosses_itself(SQUARE) and not crosses_itself(SQUARE[:3])
    assert crosses_itself(SQUARE[[0, 2, 1, 3]])
    assert crosses_itself(np.array([[0.0, 0], [4, 0], [4, 4], [2, 0], [0, 4]]))


def test_jitter_is_the_noise_of_an_even_motion():
    rng = np.random.default_rng(0)
    found = []
    for _ in range(50):
        jitter = Jitter()
        for k in range(40):
            jitter.add(k * 0.6, np.array([1.4 * k, 0.3 * k]) + rng.normal(0, 0.2, 2))
        found.append(jitter.sigma**2)
    assert np.sqrt(np.mean(found)) == pytest.approx(0.2, rel=0.2)
    assert math.isnan(Jitter().sigma)


@pytest.mark.parametrize(
    ("zones", "how", "says"),
    [
        ({"polygons": [SQUARE], "unit": "m"}, {"located": False}, "locates nothing"),
        ({"polygons": [SQUARE]}, {"origin": None}, "in local metres"),
    ],
)
def test_zones_of_another_kind_than_the_places_are_refused(zones, how, says):
    with pytest.raises(InputError, match=says):
        events(Zones(**zones), walk(eastward, **how))


def test_a_moving_camera_and_a_zone_outside_the_picture_are_noted_once():
    motion = np.array([[1.0, 0, -3], [0, 1, 0], [0, 0, 1]])
    zones = Zones(polygons={"door": SQUARE * 10 + 20, "off": SQUARE * 10 + 900}, unit="px")
    events(zones, walk(eastward, located=False, motion=motion))
    assert len(zones.notes) == 2 and "off lies outside" in zones.notes[0] and "the camera moves: door" in zones.notes[1]
    still = Zones(polygons={"door": SQUARE * 10 + 20}, unit="px")
    events(still, walk(eastward, located=False, motion=np.eye(3)))
    assert not still.notes


def test_a_zone_that_is_near_only_with_swapped_coordinates_is_noted_once():
    origin = (16.37, 48.2)
    square = lonlat(SQUARE, origin)
    for corners, count in ((square[:, ::-1], 1), (square, 0), (square + np.array([30, 0]), 0)):
        zones = Zones(polygons={"yard": corners, "field": corners})
        events(zones, walk(eastward, origin=origin))
        assert len(zones.notes) == count
    swapped = Zones(polygons={"yard": square[:, ::-1]})
    events(swapped, walk(eastward, origin=origin))
    assert "yard lies" in swapped.notes[0] and "0.0 km with latitude and longitude swapped" in swapped.notes[0]


def test_targets_that_have_gone_take_no_memory():
    zones = Zones(polygons=[SQUARE], unit="m")
    list(zones.mark(walk(lambda t: (1, 1) if t < 2 else None, lambda t: (9, 9), seconds=70)))
    assert list(zones._targets) == [2]
