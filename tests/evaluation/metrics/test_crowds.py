import math
from dataclasses import replace

import numpy as np
import pytest

from torchvision_dddas.evaluation.metrics.crowds import (
    CAP_M,
    HOLD_S,
    CrowdScorer,
    FoundTargets,
    TrueFrame,
    covering,
    crowds,
)
from torchvision_dddas.types import (
    AerialLocations,
    Bodies,
    CameraPose,
    Confirmation,
    Detections,
    Fix,
    FrameResult,
    LandmarkObservations,
    Positions,
    TrackedFrame,
    Tracks,
    Truth,
)

SIZE = 200, 300
"""Rows and columns; ten pixels are a metre, and the middle of the picture is east = north = 0."""


def pixel(place_m):
    """u, v of a place, straight from above."""
    east, north = np.asarray(place_m, float).T
    return np.stack([(SIZE[1] - 1) / 2 + 10 * east, (SIZE[0] - 1) / 2 - 10 * north], axis=-1)


def world(*things, frame=1, moving=1.0):
    """The truth of a frame. things: (target, kind, [places]); a body shows as 5 x 5 pixels where in the picture."""
    rows = [(target, kind, place) for target, kind, places in things for place in places]
    n = len(rows)
    place = np.array([row[2] for row in rows], float).reshape(n, 2)
    bodies = Bodies(
        np.arange(1, n + 1) + 10,
        np.array([row[1] for row in rows]),
        np.array([row[0] for row in rows], np.int64),
        np.c_[place, np.zeros(n)],
        np.tile([moving, 0.0], (n, 1)),
        np.zeros(n),
        np.full(n, 1.7),
        np.zeros(n),
        np.zeros((n, 3)),
        np.full((n, 3), np.nan),
        np.zeros(n, bool),
    )
    mask, people = np.zeros(SIZE, np.uint16), np.zeros(SIZE, np.uint16)
    for k, (u, v) in enumerate(np.round(pixel(place)).astype(int)):
        here = slice(max(v - 2, 0), max(v + 3, 0)), slice(max(u - 2, 0), max(u + 3, 0))
        mask[here], people[here] = bodies.target[k], bodies.number[k]
    pose = CameraPose(np.array([0, 0, 50.0]), np.eye(3))
    return Truth(frame, (frame - 1) / 10, mask, people, bodies, pose)


def box(*places_m, grown=3):
    """A box about bodies at some places."""
    at = np.round(pixel(np.array(places_m, float).reshape(-1, 2)))
    low, high = at.min(axis=0) - 2 - grown, at.max(axis=0) + 3 + grown
    return [*low, *(high - low)]


def found(*targets, frame=1, blobs=None, kinds=None, sigma_m=0.1):
    """What was found. targets: (identity, box, place or None); kinds: of those that are located."""
    n = len(targets)
    boxes = np.array([t[1] for t in targets], float).reshape(n, 4)
    identity = np.array([t[0] for t in targets], np.int64)
    rows = np.array([k for k, t in enumerate(targets) if t[2] is not None], np.int64)
    place = np.array([targets[k][2] for k in rows], float).reshape(-1, 2)
    blobs = boxes if blobs is None else np.array(blobs, float).reshape(-1, 4)
    followed = TrackedFrame(frame, None, Detections(blobs), Tracks(frame, identity, boxes, np.ones(n), np.arange(n)))
    positions = Positions(
        np.full(len(rows), frame), identity[rows], place, np.tile(np.eye(2) * sigma_m**2, (len(rows), 1, 1))
    )
    none = np.zeros((len(rows), 2))
    grounded = AerialLocations(
        frame,
        (frame - 1) / 10,
        positions,
        rows,
        positions.covariance_m2,
        none,
        boxes,
        Fix(frame, "pose"),
        LandmarkObservations(),
    )
    confirmed = None
    if kinds is not None:
        zero = np.zeros(len(rows))
        whole = np.zeros(len(rows), np.int64)
        confirmed = Confirmation(frame, np.arange(len(rows)), kinds, zero, ((),) * len(rows), whole, zero, zero, zero)
    return FrameResult(followed, grounded, confirmed=confirmed)


def scored(*pairs):
    scorer = CrowdScorer()
    for truth, told in pairs:
        scorer.feed(truth)
        scorer.feed(told)
    return scorer.score()


WEST, EAST = [(-5, 0), (-4.5, 0.5), (-5, 1)], [(5, 0), (5.5, 0.5), (5, 1)]
MIDDLE, OTHER = np.mean(WEST, axis=0), np.mean(EAST, axis=0)
TWO = (1, "person", WEST), (2, "person", EAST)


def test_what_is_found_where_it_is_scores_full():
    score = scored((world(*TWO), found((7, box(*WEST), MIDDLE), (8, box(*EAST), OTHER))))
    assert (score.recall, score.detected, score.false_blobs, score.idf1) == (1, 1, 0, 1)
    assert score.crowd_error_m.mean == score.target_error_m.mean == score.knowledge_m == pytest.approx(0)
    assert score.inside == 1
    assert score.lines() == [
        "crowds: 100.0 % of 2 seen and located, 0.00 false blobs a frame",
        "error of a crowd's place: mean 0.00 m, median 0.00, 95 % 0.00",
        "error of a target from its people: mean 0.00 m, median 0.00",
        "95 % ellipses hold the truth in 100.0 %",
        "what is known of all crowds at all times: 0.00 m off, 10 where nothing is",
    ]


def test_nothing_found_is_recall_0_and_costs_the_cap():
    score = scored((world(*TWO), found()))
    assert (score.recall, score.detected, score.known, score.knowledge_m) == (0, 0, 0, CAP_M)
    assert math.isnan(score.crowd_error_m.mean)


def test_one_blob_over_two_crowds_that_cross_stands_for_both():
    there = [(0, 0), (0.5, 0)], [(0, 0.8), (0.5, 0.8)]
    truth = world((1, "person", there[0]), (2, "person", there[1]))
    assert scored((truth, found((7, box(*there[0], *there[1]), (0.25, 0.4))))).recall == 1


def test_one_crowd_in_two_blobs_counts_once_and_lies_between_them():
    truth = world((1, "person", WEST))
    parts = [(7, box(WEST[0]), WEST[0]), (8, box(WEST[2]), WEST[2])]
    score = scored((truth, found(*parts)))
    assert (score.crowd_frames, score.recall) == (1, 1)
    assert score.crowd_error_m.mean == pytest.approx(np.linalg.norm(np.mean([WEST[0], WEST[2]], axis=0) - MIDDLE))


def test_a_box_that_is_not_located_is_detected_and_not_recalled():
    score = scored((world((1, "person", WEST)), found((7, box(*WEST), None))))
    assert (score.recall, score.detected) == (0, 1)


def test_a_box_over_everything_stands_for_no_crowd():
    score = scored((world(*TWO), found((7, [0, 0, SIZE[1], SIZE[0]], (0, 8)))))
    assert score.detected == 0


def test_a_place_in_the_middle_of_a_crowd_is_it_wherever_its_box_lies():
    away = box((0, -6))
    assert scored((world((1, "person", WEST)), found((7, away, MIDDLE + 1.2)))).recall == 1
    assert scored((world((1, "person", WEST)), found((7, away, MIDDLE + 2.5)))).recall == 0


@pytest.mark.parametrize(("outside", "counts"), [(1, 1), (2, 1), (3, 0)])
def test_a_crowd_counts_where_half_of_its_people_show(outside, counts):
    people = [(5 + k / 2, 0) for k in range(4 - outside)] + [(100, k) for k in range(outside)]
    assert scored((world((1, "person", people)), found())).crowd_frames == counts


def test_only_blobs_that_touch_nothing_are_false():
    truth = world((1, "person", WEST), (5, "car", [(5, 5)]), (6, "ugv", [(8, -5)]))
    beside = box(np.array(WEST[0]) - (1.0, 0.0))  # the shadow
    blobs = [box(*WEST), beside, box((5, 5)), box((8, -5)), box((0, -8))]
    score = scored((truth, found((7, box(*WEST), MIDDLE), blobs=blobs)))
    assert (score.false_blobs, score.landmark_blobs, score.false_targets) == (1, 1, 0)


def test_a_body_lies_in_the_box_that_has_half_of_its_pixels():
    truth = TrueFrame(world((1, "person", [(0, 0)])))
    u, v = truth.u.min(), truth.v.min()
    boxes = np.array([[u, v, 3, 5], [u, v, 2, 5]], float)
    assert truth.bodies_in(truth.pixels_in(boxes)).tolist() == [[True], [False]]


def test_pixels_of_what_is_no_body_touch_and_belong_to_nobody():
    truth = world((1, "person", [(0, 0)]))
    truth.mask[:4, :4] = 3
    frame = TrueFrame(truth)
    assert frame.pixels.sum() == 25
    assert frame.untouched(np.array([[0, 0, 9, 9.0]])) == 0


def test_the_error_of_a_target_is_that_from_the_people_in_its_box():
    score = scored((world((1, "person", WEST)), found((7, box(*WEST[:2], grown=1), np.add(WEST[0], (0.25, 3.25))))))
    assert score.target_error_m.mean == pytest.approx(3.0)
    assert score.inside == 0


def walk(frames, identities, people=lambda k: WEST):
    """A crowd that stays where it is, under the identities given; 0: not found."""
    pairs = []
    for k in range(frames):
        told = [(identities[k], box(*people(k)), np.mean(people(k), axis=0))] if identities[k] else []
        pairs.append((world((1, "person", people(k)), frame=k + 1), found(*told, frame=k + 1)))
    return pairs


@pytest.mark.parametrize(
    ("identities", "switches"),
    [([7] * 6, 0), ([7, 7, 7, 8, 8, 8], 1), ([7, 7, 0, 0, 7, 7], 0), ([7, 0, 8, 8, 7, 7], 2)],
)
def test_a_switch_is_a_change_of_a_crowds_identity_however_long_it_was_lost(identities, switches):
    score = scored(*walk(6, identities))
    assert score.switches == switches
    assert score.crowd_minutes == pytest.approx(0.5 / 60)
    assert score.switches_a_minute == pytest.approx(switches / (0.5 / 60))


def test_a_crowd_whose_people_change_may_change_its_identity():
    grown = [*WEST, (-5.5, 0.5)]
    assert scored(*walk(4, [7, 7, 8, 8], lambda k: WEST if k < 2 else grown)).switches == 0


def test_two_parts_that_take_turns_at_being_the_larger_one_are_no_switch():
    truth = [world((1, "person", WEST), frame=k) for k in (1, 2, 3)]
    larger, smaller = box(*WEST[:2]), box(WEST[2])
    told = [
        found((7, larger, MIDDLE), (8, smaller, MIDDLE)),
        found((7, smaller, MIDDLE), (8, box(WEST[1]), MIDDLE), frame=2),
        found((7, larger, MIDDLE), (8, smaller, MIDDLE), frame=3),
    ]
    assert scored(*zip(truth, told, strict=True)).switches == 0


def test_a_blob_over_two_crowds_carries_one_identity_and_the_others_returns():
    apart = found((7, box(*WEST), MIDDLE), (8, box(*EAST), OTHER))
    close = [(-0.4, 0), (-0.4, 0.8)], [(0.4, 0), (0.4, 0.8)]
    crossing = world((1, "person", close[0]), (2, "person", close[1]), frame=2)
    blob = found((7, box(*close[0], *close[1]), (0, 0.4)), frame=2)
    after = world(*TWO, frame=3), replace(apart, tracked=replace(apart.tracked, number=3))
    score = scored((world(*TWO), apart), (crossing, blob), after)
    assert (score.switches, score.recall) == (0, 1)


def test_kinds_are_judged_by_what_most_boxes_of_a_target_hold():
    truth = [world((1, "person", WEST), (5, "car", [(5, 5)]), frame=k) for k in (1, 2)]
    targets = (7, box(*WEST), MIDDLE), (8, box((5, 5)), (5, 5)), (9, box((0, -8)), (0, -8))
    told = [
        found(*targets, frame=1, kinds=("not_human", "not_human", "unseen")),
        found(*targets, frame=2, kinds=("human", "human", "unseen")),
    ]
    score = scored(*zip(truth, told, strict=True))
    assert (score.kinds, score.kind_right, score.blob_kind_right) == (2, 0.5, 0.5)


def test_between_looks_the_last_known_place_moves_on_and_then_is_forgotten():
    late = 1 + round((HOLD_S + 1) * 10)
    pairs = [
        (world((1, "person", WEST), frame=1), found((7, box(*WEST), np.add(MIDDLE, (0, 3))))),
        (world((1, "person", WEST), frame=late), found(frame=late)),
    ]
    score = scored(*pairs)
    known = 1 + round(HOLD_S * 10)
    assert score.known == pytest.approx(known / late)
    assert score.knowledge_m == pytest.approx((3 * known + CAP_M * (late - known)) / late)


def test_people_who_stand_count_apart():
    score = scored((world(*TWO, moving=0.0), found((7, box(*WEST), MIDDLE))), (world(*TWO, frame=2), found(frame=2)))
    assert (score.recall, score.recall_moving) == (0.25, 0)


def test_frames_without_truth_are_left_out_and_a_run_without_any_has_no_figures():
    score = scored((world(*TWO), found(frame=2)))
    assert score.frames == 0
    assert math.isnan(score.recall)
    assert score.by_name()["recall"] is None
    assert score.lines() == []


def test_places_told_in_degrees_are_taken_to_the_truths_metres():
    told = found((7, box(*WEST), (0, 0)))
    positions = replace(told.locations.positions, lonlat_deg=np.array([[1.0, 2.0]]))
    scorer = CrowdScorer(local=lambda degrees: degrees + MIDDLE - (1.0, 2.0))
    scorer.feed(world((1, "person", WEST)))
    scorer.feed(replace(told, locations=replace(told.locations, positions=positions)))
    assert scorer.score().crowd_error_m.mean == pytest.approx(0)


def test_an_empty_world_has_no_crowds():
    truth = TrueFrame(world())
    told = FoundTargets(
        np.zeros((1, 4)), np.ones(1, int), np.zeros((1, 2)), np.zeros((1, 2, 2)), np.zeros((1, 2)), ("human",)
    )
    held = truth.bodies_in(truth.pixels_in(told.box_px))
    assert crowds(truth) == []
    assert covering(truth, [], told, held).shape == (0, 1)
