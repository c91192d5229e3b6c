"""Crowds keep their identities where they meet, part, are missed, and lose a person."""

import numpy as np
import pytest

from torchvision_dddas.tracking.crowd_identity import CrowdIdentities
from torchvision_dddas.types import Tracks

RATE_HZ = 5.0


def identities(frames):
    """The identities of each frame; a frame: the (track, east, north, radius) of its blobs."""
    crowds, found = CrowdIdentities(), []
    for k, blobs in enumerate(frames):
        table = np.array(blobs, float).reshape(-1, 4)
        of_frame = crowds.update(k / RATE_HZ, table[:, 0].astype(np.int64), table[:, 1:3], table[:, 3])
        assert len(np.unique(of_frame[of_frame > 0])) == (of_frame > 0).sum()
        found.append(of_frame.tolist())
    return found


def crossing(swapped):
    """Two crowds, one going east and one north, are one blob for 4 s. swapped: the other one keeps the track then."""
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
    return frames


@pytest.mark.parametrize("swapped", [False, True])
def test_crowds_that_cross_keep_their_identities(swapped):
    found = identities(crossing(swapped))
    assert found[5] == [1, 2] and found[-1] == [1, 2]
    shared = [of_frame for of_frame in found if len(of_frame) == 1]
    assert shared and len({of_frame[0] for of_frame in shared}) == 1


def test_a_crowd_missed_for_seconds_keeps_its_identity_under_a_new_track():
    frames = [[(1 if k < 30 else 5, 0.2 * k, 0, 2.0)] for k in range(60)]
    frames[28:40] = [[]] * 12
    assert identities(frames)[-1] == [1]
    elsewhere = [[(1, 0.2 * k, 0, 2.0)] for k in range(30)] + [[(2, 20, 15 + 0.1 * k, 2.0)] for k in range(10)]
    assert identities(elsewhere)[-1] == [2]


def test_a_small_blob_behind_a_crowd_has_an_identity_later_than_a_large_one():
    crowd = [[(1, 0.2 * k, 0, 2.5)] for k in range(20)]
    small = identities(crowd + [[(1, 4 + 0.2 * k, 0, 2.3), (2, 0.5, 0, 0.6)] for k in range(20)])
    assert [of_frame[1] for of_frame in small[20:23]] == [0, 0, 0] and small[-1] == [1, 2]
    assert identities(crowd + [[(1, 4 + 0.2 * k, 0, 2.3), (2, 0.5, 0, 1.8)] for k in range(20)])[20] == [1, 2]


def test_tracks_get_the_identities_of_their_crowds():
    crowds = CrowdIdentities()
    boxes, scores = np.arange(8.0).reshape(2, 4), np.array([0.9, 0.8])

    def rename(identity, row, place):
        place = np.array(place, float).reshape(-1, 2)
        return crowds.rename(Tracks(1, np.array(identity), boxes, scores, np.array(row)), 0.0, place, np.full(1, 2.0))

    assert rename([9, 4], [0, -1], [0, 0]).identity.tolist() == [1]  # nothing is known of track 4
    later = rename([4, 9], [0, -1], [20, 0])
    assert later.identity.tolist() == [1, 2] and later.row.tolist() == [-1, 0]
    assert later.box_px.tolist() == boxes[::-1].tolist()


def test_a_blob_without_a_place_keeps_its_identity():
    frames = [[(1, 0, 0, 2.0), (2, 12, 0, 2.0)]] * 10 + [[(2, *[np.nan] * 3), (3, *[np.nan] * 3)]]
    assert identities(frames)[-1] == [2, 3]
