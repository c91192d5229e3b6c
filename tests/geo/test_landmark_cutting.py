"""Vehicles cut out of the blobs that they share with others."""

import cv2
import numpy as np

from torchvision_dddas.geo.landmark_watch import cut_out_landmarks
from torchvision_dddas.types import Detections

NOWHERE = np.full((1, 2), np.nan)


def scene():
    """A crowd of 40 x 20 px with a vehicle at its left end, a lone vehicle, and a target far away."""
    mask = np.zeros((100, 160), np.uint16)
    mask[40:60, 20:60], mask[10:22, 100:112], mask[80:90, 130:140] = 1, 2, 3
    boxes = [cv2.boundingRect((mask == value).astype(np.uint8)) for value in (1, 2, 3)]
    area = np.array([(mask == value).sum() for value in (1, 2, 3)], float)
    unknown = np.full(3, np.nan)
    return Detections(np.array(boxes, float), np.array([0.5, 0.6, 0.7]), area, unknown, np.arange(3.0)), mask


VEHICLES = np.array([False, True, False])


def test_the_rest_of_a_crowd_stays_a_target_and_what_no_disc_touches_is_as_it_was():
    found, mask = scene()
    middles = np.array([[25.0, 50.0], [105.5, 15.5]])
    left, numbered = cut_out_landmarks(found, mask, VEHICLES, middles, np.array([12.0, 12.0]), 20.0)
    assert left.score.tolist() == [0.5, 0.7]
    assert left.speed_px.tolist() == [0.0, 2.0]
    x, _, width, _ = left.box_px[0]
    assert 31 <= x <= 38
    assert x + width == 60
    assert left.area_px[0] == (numbered == 1).sum() < found.area_px[0]
    assert left.box_px[1].tolist() == found.box_px[2].tolist()
    assert not numbered[50, 25]
    assert sorted(np.unique(numbered)) == [0, 1, 2]


def test_what_a_vehicles_own_blob_leaves_must_be_larger_than_a_rest_of_a_crowd():
    found, mask = scene()
    mask[10:22, 112:120] = 2  # 96 px beside it
    found.box_px[1, 2] += 8
    middles, radius = np.array([[105.5, 15.5]]), np.array([9.0])
    own, _ = cut_out_landmarks(found, mask, VEHICLES, middles, radius, 30.0)
    shared, _ = cut_out_landmarks(found, mask, np.zeros(3, bool), middles, radius, 30.0)
    assert own.score.tolist() == [0.5, 0.7]
    assert shared.score.tolist() == [0.5, 0.6, 0.7]


def test_of_a_vehicle_whose_middle_is_not_known_nothing_stays_and_of_others_all_does():
    found, mask = scene()
    left, numbered = cut_out_landmarks(found, mask, VEHICLES, NOWHERE, np.array([np.nan]), np.inf)
    assert left.score.tolist() == [0.5, 0.7]
    assert (numbered > 0).sum() == ((mask == 1) | (mask == 3)).sum()
