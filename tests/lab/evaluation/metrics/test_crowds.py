import math
from dataclasses import replace

import numpy as np
import pytest

from torchvision_dddas.lab.evaluation.metrics.crowds import (
    CAP_M,
    HOLD_S,
    CrowdScorer,
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
    number, zero = np.arange(1, n + 1) + 10, np.zeros(n)
    kind, target = np.array([row[1] for row in rows]), np.array([row[0] for row in rows], np.int64)
    place, velocity = np.array([row[2] for row in rows], float).reshape(n, 2), np.tile([moving, 0.0], (n, 1))
    looks = np.full(n, 1.7), zero, np.zeros((n, 3)), np.full((n, 3), np.nan), zero.astype(bool)
    bodies = Bodies(number, kind, target, np.c_[place, zero], velocity, zero, *looks)
    mask, people = np.zeros(SIZE, np.uint16), np.zeros(SIZE, np.uint16)
    for k, (u, v) in enumerate(np.round(pixel(place)).astype(int)):
        here = slice(max(v - 2, 0), max(v + 3, 0)), slice(max(u - 2, 0), max(u + 3, 0))
        mask[here], people[here] = bodies.target[k], bodies.number[k]
    return Truth(frame, (frame - 1) / 10, mask, people, bodies, CameraPose(np.array([0, 0, 50.0]), np.eye(3)))


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
    covariance = np.tile(np.eye(2) * sigma_m**2, (len(rows), 1, 1))
    blobs = boxes if blobs is None else np.array(blobs, float).reshape(-1, 4)
    followed = TrackedFrame(frame, None, Detections(blobs), Tracks(frame, identity, boxes, np.ones(n), np.arange(n)))
    positions = Positions(np.full(len(rows), frame), identity[rows], place, covariance)
    zero, at_s, fix = np.zeros(len(rows)), (frame - 1) / 10, Fix(frame, "pose")
    grounded = AerialLocations(
        frame, at_s, positions, rows, covariance, np.zeros((len(rows), 2)), boxes, fix, LandmarkObservations()
    )
    confirmed = None
    if kinds is not None:
        each = np.arange(len(rows))
        confirmed = Confirmation(frame, each, kinds, zero, ((),) * len(rows), each * 0, zero, zero, zero)
    return FrameResult(followed, grounded, confirmed=confirmed)


def scored(*pairs):
    scorer = CrowdScorer()
    for truth, told in pairs:
        scorer.feed(truth)
        scorer.feed(told)
    return scorer.score()


WEST, EAST = [(-5, 0), (-4.5, 0.5), (-5, 1), (-5.5, 0.5)], [(5, 0), (5.5, 0.5), (5, 1)]
MIDDLE, OTHER = np.mean(WEST, axis=0), np.mean(EAST, axis=0)
TWO = (1, "person", WEST), (2, "person", EAST)


def test_targets_found_in_their_places_score_full():
    score = scored((world(*TWO), found((7, box(*WEST), MIDDLE), (8, box(*EAST), OTHER))))
    assert (score.recall, score.detected, score.false_blobs, score.idf1, score.inside) == (1, 1, 0, 1, 1)
    assert score.crowd_error_m.mean == score.target_error_m.mean == score.knowledge_m == pytest.approx(0)
    assert score.lines() == [
        "crowds: 100.0 % of 2 seen and located, 0.00 false blobs a frame",
        "error of a crowd's place: mean 0.00 m, median 0.00, 95 % 0.00",
        "error of a target from its people: mean 0.00 m, median 0.00",
        "95 % ellipses contain the truth in 100.0 %",
        "mean error of the known places of all crowds over the whole time: 0.00 m; 10 m if no place is known",
    ]


def test_nothing_found_is_recall_0_and_costs_the_cap():
    score = scored((world(*TWO), found()))
    assert (score.recall, score.detected, score.known, score.knowledge_m) == (0, 0, 0, CAP_M)
    assert math.isnan(score.crowd_error_m.mean)


def test_one_crowd_in_two_blobs_counts_once_and_lies_between_them():
    parts = [(7, box(WEST[0]), WEST[0]), (8, box(WEST[2]), WEST[2])]
    score = scored((world((1, "person", WEST)), found(*parts)))
    assert (score.crowd_frames, score.recall) == (1, 1)
    assert score.crowd_error_m.mean == pytest.approx(np.linalg.norm(np.mean([WEST[0], WEST[2]], axis=0) - MIDDLE))


CROSSING = [(0, 0), (0.5, 0)], [(0, 0.8), (0.5, 0.8)]


@pytest.mark.parametrize(
    ("things", "target", "recall", "detected"),
    [
        ((TWO[0],), (box(*WEST), None), 0, 1),  # not located
        (TWO, ([0, 0, SIZE[1], SIZE[0]], (0, 8)), 0, 0),  # over everything
        ([(k, "person", CROSSING[k - 1]) for k in (1, 2)], (box(*CROSSING[0], *CROSSING[1]), (0.25, 0.4)), 1, 1),
        ((TWO[0],), (box((0, -6)), MIDDLE + 1.2), 1, 1),  # in the middle of the crowd, wherever its box lies
        ((TWO[0],), (box((0, -6)), MIDDLE + 2.5), 0, 0),
    ],
)
def test_a_box_or_a_place_in_its_middle_finds_a_crowd(things, target, recall, detected):
    score = scored((world(*things), found((7, *target))))
    assert (score.recall, score.detected) == (recall, detected)


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


def test_the_error_of_a_target_is_that_from_the_people_in_its_box():
    score = scored((world((1, "person", WEST)), found((7, box(*WEST[:2], grown=1), np.add(WEST[0], (0.25, 3.25))))))
    assert score.target_error_m.mean == pytest.approx(3.0)
    assert score.inside == 0


def walk(identities, people=lambda k: WEST):
    """A crowd that stays where it is, under the identities given; 0: not found."""
    pairs = []
    for k, identity in enumerate(identities):
        targets = [(identity, box(*people(k)), np.mean(people(k), axis=0))] if identity else []
        pairs.append((world((1, "person", people(k)), frame=k + 1), found(*targets, frame=k + 1)))
    return pairs


@pytest.mark.parametrize(
    ("identities", "switches"),
    [([7] * 6, 0), ([7, 7, 7, 8, 8, 8], 1), ([7, 7, 0, 0, 7, 7], 0), ([7, 0, 8, 8, 7, 7], 2)],
)
def test_a_switch_is_a_change_of_a_crowds_identity_however_long_it_was_lost(identities, switches):
    score = scored(*walk(identities))
    assert score.switches == switches
    assert score.crowd_minutes == pytest.approx(0.5 / 60)
    assert score.switches_a_minute == pytest.approx(switches / (0.5 / 60))


def test_a_crowd_whose_people_change_may_change_its_identity():
    assert scored(*walk([7, 7, 8, 8], lambda k: WEST[: 3 if k < 2 else 4])).switches == 0


def test_two_parts_that_take_turns_at_being_the_larger_one_are_no_switch():
    larger, smaller = box(*WEST[:2]), box(WEST[2])
    pairs = [
        (world(TWO[0], frame=k), found((7, first, MIDDLE), (8, second, MIDDLE), frame=k))
        for k, first, second in ((1, larger, smaller), (2, smaller, box(WEST[1])), (3, larger, smaller))
    ]
    assert scored(*pairs).switches == 0


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


def test_the_last_known_place_of_a_crowd_is_kept_for_a_while_and_then_forgotten():
    late, known = 1 + round((HOLD_S + 1) * 10), 1 + round(HOLD_S * 10)
    first = world((1, "person", WEST), frame=1), found((7, box(*WEST), np.add(MIDDLE, (0, 3))))
    score = scored(first, (world((1, "person", WEST), frame=late), found(frame=late)))
    assert score.known == pytest.approx(known / late)
    assert score.knowledge_m == pytest.approx((3 * known + CAP_M * (late - known)) / late)


def test_frames_without_truth_or_crowds_have_no_figures_and_people_who_stand_count_apart():
    score = scored((world(*TWO), found(frame=2)))
    assert (score.frames, score.by_name()["recall"], score.lines()) == (0, None, [])
    assert math.isnan(scored((world(), found((1, box((0, 0)), (0, 0))))).recall)
    score = scored((world(*TWO, moving=0.0), found((7, box(*WEST), MIDDLE))), (world(*TWO, frame=2), found(frame=2)))
    assert (score.recall, score.recall_moving) == (0.25, 0)


def test_places_in_degrees_are_converted_to_the_truths_metres():
    result = found((7, box(*WEST), (0, 0)))
    positions = replace(result.locations.positions, lonlat_deg=np.array([[1.0, 2.0]]))
    scorer = CrowdScorer(local=lambda degrees: degrees + MIDDLE - (1.0, 2.0))
    scorer.feed(world((1, "person", WEST)))
    scorer.feed(replace(result, locations=replace(result.locations, positions=positions)))
    assert scorer.score().crowd_error_m.mean == pytest.approx(0)
