"""What ground vehicles did, as the map shows it."""

import numpy as np

from tests.io.ground import positions, tracks
from torchvision_dddas.io.maps.ground_tracks import Gathered
from torchvision_dddas.io.maps.map_drawing import VERDICTS
from torchvision_dddas.io.maps.map_picture import Signs, map_picture


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
    signs.told(1, "human", np.array([10.0, 0]))
    human = shown(signs)
    assert near(human, VERDICTS["human"]) > near(bare, VERDICTS["human"]) + 60
    assert near(human, VERDICTS["not_human"]) == near(bare, VERDICTS["not_human"])
    signs.told(1, "not_human", np.array([30.0, 0]))
    assert near(shown(signs), VERDICTS["not_human"]) > near(bare, VERDICTS["not_human"]) + 60


def test_a_wedge_opens_from_the_vehicle_towards_what_it_saw():
    signs = Signs()
    bare = shown(Signs())
    signs.look("ugv1", np.array([10.0, 4.0]), np.array([10.0, 0.0]))
    changed = (np.abs(shown(signs)[:-100].astype(int) - bare[:-100]) > 8).any(axis=2)
    rows, columns = np.nonzero(changed)
    widths = [np.ptp(columns[rows == row]) for row in (rows.min() + 3, rows.max() - 3)]
    assert len(rows) > 100 and widths[1] > 2 * widths[0]


def test_looks_from_all_but_one_place_are_one_and_those_from_nowhere_none():
    signs = Signs()
    for k in range(100):
        signs.look("ugv1", np.array([0.01 * k, 0.0]), np.zeros(2))
    signs.look("ugv2", np.full(2, np.nan), np.zeros(2))
    assert len(signs.looks) == 1


def test_signs_far_outside_the_map_do_no_harm():
    signs = Signs()
    signs.told(1, "human", np.array([1e7, -1e7]))
    signs.look("ugv1", np.array([-1e7, 1e7]), np.zeros(2))
    assert shown(signs).shape[1] == 1400


def test_memory_is_bounded_however_much_is_told():
    signs = Signs()
    for k in range(3000):
        signs.told(k, "human", np.zeros(2))
        signs.look("ugv1", np.array([10.0 * k, 0.0]), np.zeros(2))
    assert len(signs.verdicts) < 1000 and len(signs.looks) < 1000
