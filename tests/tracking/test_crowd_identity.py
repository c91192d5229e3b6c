"""Crowds keep their names where they meet, part, are missed, and lose somebody."""

import numpy as np

from torchvision_dddas.tracking.crowd_identity import RollCall

RATE_HZ = 5.0


def called(frames, roll=None):
    """The names of each frame; a frame: the (followed, east, north, radius) of its blobs."""
    roll = roll or RollCall()
    told = []
    for k, blobs in enumerate(frames):
        table = np.array(blobs, float).reshape(-1, 4)
        names = roll.step(k / RATE_HZ, table[:, 0].astype(np.int64), table[:, 1:3], table[:, 3])
        assert len(np.unique(names[names > 0])) == (names > 0).sum()
        told.append(names.tolist())
    return told


def crossing(swapped):
    """Two crowds, one to the east and one to the north, are one blob for 4 s; the picture's numbers after that."""
    frames = []
    for k in range(75):
        t = k / RATE_HZ
        east, north = np.array([-10 + 1.3 * t, 0.0]), np.array([0.0, -9 + 1.2 * t])
        if np.linalg.norm(east - north) > 4.5:
            parted = t > 7.5
            first, second = (8, 1) if parted and swapped else (1, 8 if parted else 2)
            frames.append([(first, *east, 2.0), (second, *north, 1.8)])
        else:
            frames.append([(1, *((east + north) / 2), 2.0 + np.linalg.norm(east - north) / 2)])
    assert any(len(frame) == 1 for frame in frames)
    return frames


def test_crowds_that_cross_are_who_they_were_whichever_part_the_picture_follows_on():
    for swapped in (False, True):
        told = called(crossing(swapped))
        assert told[5] == [1, 2] and told[-1] == [1, 2]
        assert {len(names) for names in told} == {1, 2} and set().union(*told) == {1, 2}


def test_a_blob_of_two_keeps_one_name():
    together = [names for names in called(crossing(False)) if len(names) == 1]
    assert len({names[0] for names in together}) == 1


def test_crowds_that_join_for_good_go_by_one_name():
    apart = [[(1, -6 + 0.2 * k, 0, 2.0), (2, 6 - 0.2 * k, 0, 1.5)] for k in range(20)]
    one = [[(1 if k < 40 else 3, 0.05 * k, 0, 3.0)] for k in range(150)]
    told = called([*apart, *one])
    assert {names[0] for names in told[20:]} == {1}


def test_a_crowd_that_is_missed_for_some_seconds_is_known_again_under_a_new_number_of_the_picture():
    seen = [[(1 if k < 30 else 5, 0.2 * k, 0, 2.0)] for k in range(60)]
    seen[28:40] = [[]] * 12
    assert called(seen)[-1] == [1]


def test_another_crowd_elsewhere_is_another():
    seen = [[(1, 0.2 * k, 0, 2.0)] for k in range(30)] + [[(2, 20, 15 + 0.1 * k, 2.0)] for k in range(10)]
    assert called(seen)[-1] == [2]


def test_who_falls_behind_a_crowd_has_no_name_for_a_while_and_a_large_part_has_one_at_once():
    crowd = [[(1, 0.2 * k, 0, 2.5)] for k in range(20)]
    small = called(crowd + [[(1, 4 + 0.2 * k, 0, 2.3), (2, 0.5, 0, 0.6)] for k in range(20)])
    assert [names[1] for names in small[20:23]] == [0, 0, 0] and small[-1] == [1, 2]
    large = called(crowd + [[(1, 4 + 0.2 * k, 0, 2.3), (2, 0.5, 0, 1.8)] for k in range(20)])
    assert large[20] == [1, 2]


def test_what_lies_nowhere_keeps_the_name_that_it_had():
    seen = [[(1, 0, 0, 2.0), (2, 12, 0, 2.0)]] * 10 + [[(2, np.nan, np.nan, np.nan), (3, np.nan, np.nan, np.nan)]]
    assert called(seen)[-1] == [2, 3]
