"""Blobs confirmed by people recognized from the ground."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.config import ConfirmParameters, GroundParameters, PeopleParameters
from torchvision_dddas.control.confirmation import (
    Beliefs,
    GroundObservation,
    GroundView,
    evidence,
    field_of_view,
    observe_ground,
    observe_picture,
)
from torchvision_dddas.types import Camera

KNOBS = ConfirmParameters(spread_m=0.0)
CROWD = [[0.2, 10], [-0.3, 10.1], [0.1, 9.8], [5, 12]]
NORTH = GroundView(np.zeros(2), 0.0, math.radians(30), 2.0, 20.0)


def observed(blobs, people=(), views=(NORTH,), score=None):
    blobs, people = (np.reshape(places, (-1, 2)).astype(float) for places in (blobs, people))
    score = np.ones(len(people)) if score is None else np.array(score)
    sigma, person_sigma = (np.tile(s**2 * np.eye(2), (len(x), 1, 1)) for s, x in ((0.3, blobs), (0.1, people)))
    return observe_ground(blobs, sigma, people, person_sigma, score, views, KNOBS)


def test_the_distance_to_the_nearest_person_is_kept():
    found = observed([0, 10], [0.3, 10.4])
    assert found.nearest_m[0] == pytest.approx(0.5)
    assert found.nearest_sigmas[0] == pytest.approx(0.5 / math.hypot(0.3, 0.1))


@pytest.mark.parametrize(
    ("blobs", "people", "visible"),
    [
        *(([blob], [], [False]) for blob in [(0, 1.5), (0, 30), (0, -10), (8, 10), (0, 2.3), (0, 19.7)]),
        ([[0, 5], [0, 10]], [], [True, False]),  # hidden by a blob
        ([[-1, 5], [1, 10]], [], [True, True]),
        ([[0, 10]], [[0, 5]], [False]),  # hidden by a person
    ],
)
def test_a_blob_outside_the_view_at_its_edge_or_hidden_is_unseen(blobs, people, visible):
    assert observed(blobs, people).looked.tolist() == visible


@pytest.mark.parametrize(
    ("blobs", "people", "score", "counts", "best", "visible"),
    [
        ([0, 10], [0.3, 10.4], [1.0], [1], [1.0], [True]),
        ([[0, 10], [5, 12]], CROWD, [0.6, 0.9, 0.7, 0.8], [3, 1], [0.9, 0.8], [True, True]),
        ([[0, 10], [0.8, 10]], [0.2, 10], [1.0], [1, 0], [1.0, 0.0], [True, False]),  # a person between two blobs
    ],
)
def test_people_inside_the_gate_are_counted_at_one_blob(blobs, people, score, counts, best, visible):
    found = observed(blobs, people, score=score)
    assert (found.people.tolist(), found.best.tolist(), found.looked.tolist()) == (counts, best, visible)


@given(st.floats(-math.pi, math.pi), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4))
@settings(max_examples=50, deadline=None)
def test_turning_and_moving_the_whole_scene_changes_nothing(angle, east, north):
    blobs, people = np.random.default_rng(3).uniform((-6, 1), (6, 22), (2, 12, 2))
    first = observed(blobs, people)
    # Clockwise, as headings go.
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    view = GroundView(np.array([east, north]), angle, NORTH.half_rad, NORTH.near_m, NORTH.far_m)
    second = observed(blobs @ turn.T + (east, north), people @ turn.T + (east, north), views=[view])
    np.testing.assert_array_equal(first.looked, second.looked)
    np.testing.assert_array_equal(first.people, second.people)
    np.testing.assert_allclose(first.nearest_sigmas, second.nearest_sigmas, atol=1e-6)


@pytest.mark.parametrize(("enlarge", "step"), [(1.0, 1.05), (2.0, 2**0.25)])  # whole steps to twice the size
def test_a_view_ends_where_bodies_become_too_small(enlarge, step):
    camera = Camera("ugv", (800, 600), (1000.0, 1000.0), (399.5, 299.5))
    parameters = PeopleParameters(enlarge=enlarge, scale_step=step, height_share=0.75)
    view = field_of_view(camera, np.zeros(2), 0.0, parameters, GroundParameters(body_height_m=1.8))
    assert view.far_m == pytest.approx(enlarge * 1000 * 1.8 / 96)
    assert view.near_m == pytest.approx(3.0)
    assert view.half_rad == pytest.approx(math.atan(0.4))


def one(looked, people=0, best=0.0):
    nothing = np.full(1, np.nan)
    return GroundObservation(np.array([looked]), np.array([people]), nothing, nothing, np.array([best]))


def test_the_evidence_of_an_observation_is_bayes_rule():
    parameters = ConfirmParameters(detection_rate=0.8, false_rate=0.1, prior=0.25)
    beliefs = Beliefs(parameters)
    beliefs.add(["blob"], [("ugv", one(True, 1, 1.0))])
    assert beliefs.probability("blob") == pytest.approx(0.25 * 0.8 / (0.25 * 0.8 + 0.75 * 0.1))
    assert evidence(one(True), parameters)[0] == pytest.approx(math.log(0.2 / 0.9))
    assert evidence(one(False), parameters)[0] == 0
    beliefs.add(["other"], [("ugv", one(False))])
    assert beliefs.kind("other") == "unseen" and beliefs.probability("other") == pytest.approx(0.25)


def test_one_false_hit_does_not_make_a_car_a_crowd():
    person, wide = np.array([[0, 0, 50, 130.0]]), np.array([[0, 0, 400, 130.0]])
    one_hit, many = [[5, 5, 45, 120.0]], [[x, 5, 45, 120.0] for x in range(5, 350, 80)]

    def weight(blob, people):
        found = observe_picture(blob, np.reshape(people, (-1, 4)), np.full(len(people), 0.8), KNOBS)
        return evidence(found, KNOBS)[0]

    assert weight(person, one_hit) > 0.5
    assert weight(wide, one_hit) < 0 < weight(wide, many)
    assert weight(wide, []) < weight(person, [])


def test_boxes_are_confirmed_by_the_people_in_them():
    blobs = np.array([[100, 100, 60, 130], [300, 100, 60, 130], [500, 150, 30, 40], [0, 0, 200, 20.0]])
    people = np.array([[110, 95, 40, 120], [500, 120, 40, 110.0], [330, 400, 40, 100]])
    found = observe_picture(blobs, people, np.array([0.9, 0.6, 0.8]), KNOBS, least_px=96)
    assert found.people.tolist() == [1, 0, 1, 0]
    # The second is tall enough for a person to have been found in it, the last is not.
    assert found.looked.tolist() == [True, True, True, False]
    assert found.best.tolist() == [0.9, 0, 0.6, 0]


@pytest.mark.parametrize(("blobs", "people"), [(0, 1), (1, 0), (0, 0)])
def test_no_blobs_or_no_people_give_an_empty_observation(blobs, people):
    assert len(observed([(0, 10)] * blobs, [(0, 10)] * people).looked) == blobs
    assert len(observe_picture(np.zeros((blobs, 4)), np.zeros((people, 4)), np.ones(people), KNOBS).people) == blobs
