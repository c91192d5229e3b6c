"""Events of crowds: who joins, splits, gathers and scatters, and who only passes."""

import numpy as np

from torchvision_dddas.tracking import CrowdEvents

STEP_S = 0.5


def watched(until_s, *crowds):
    """The events by the second. crowds: (identity, from_s, until_s, place at a time)."""
    events, told = CrowdEvents(join_m=3.0), []
    for k in range(int(until_s / STEP_S)):
        now = k * STEP_S
        seen = [(number, place(now)) for number, start, end, place in crowds if start <= now < end]
        identity = np.array([number for number, _ in seen], np.int64)
        place_m = np.array([at for _, at in seen], float).reshape(-1, 2)
        told += events.update(k + 1, now, identity, place_m, np.full(len(seen), 1.0))
    told += events.flush()
    return [(event.kind, event.target, event.others, event.time_s) for event in told]


def at(east, north=0.0, speed=0.0):
    return lambda now: (east + speed * now, north)


def test_crowds_that_stay_together_have_joined_whether_or_not_they_share_a_blob():
    assert watched(30, (1, 0, 30, at(0)), (2, 0, 10, at(14, speed=-1.0))) == [("join", 1, (2,), 9.0)]
    stays = (2, 0, 30, lambda now: (max(14 - now, 4), 0))
    assert [kind for kind, *_ in watched(30, (1, 0, 30, at(0)), stays)] == ["join"]


def test_a_crowd_that_is_back_in_time_has_passed():
    before, after = (2, 0, 8, at(12, speed=-1.0)), (2, 14, 30, at(12, speed=-1.0))
    assert watched(30, (1, 0, 30, at(0)), before, after) == []


def test_a_crowd_that_is_back_under_another_identity_has_passed():
    before, after = (2, 0, 8, at(12, speed=-1.0)), (3, 14, 30, at(12, speed=-1.0))
    assert watched(30, (1, 0, 30, at(0)), before, after) == []


def test_a_car_neither_joins_nor_splits_off():
    before, after = (2, 0, 8, at(48, speed=-6.0)), (3, 20, 24, at(-120, speed=6.0))
    assert watched(40, (1, 0, 40, at(0)), before, after) == []


def test_a_crowd_that_vanishes_far_from_all_others_has_not_joined():
    assert watched(30, (1, 0, 30, at(0)), (2, 0, 10, at(20))) == []


def test_a_part_has_split_off_once_it_is_away_for_a_while():
    straggler = (3, 10, 30, lambda now: (-9 if 15 <= now < 16 else -4, 0))
    leaves = (2, 10, 30, at(-7, speed=1.0))
    assert watched(30, (1, 0, 30, at(0)), leaves, straggler) == [("split", 1, (2,), 14.5)]


def test_crowds_that_appear_far_away_or_at_the_start_have_not_split():
    assert watched(30, (1, 0, 30, at(0)), (2, 0, 30, at(5)), (3, 10, 30, at(30))) == []


def test_a_crowd_that_walks_out_of_the_picture_beside_another_has_not_joined_it():
    events, told = CrowdEvents(join_m=3.0), []
    for k in range(60):
        number = np.array([1, 2] if k < 20 else [1])
        place = np.array([[0.0, 0], [4, 0]])[: len(number)]
        told += events.update(k + 1, k * STEP_S, number, place, np.ones(len(number)), number == 2)
    assert told == [] and events.flush() == []


def test_what_drives_by_and_is_lost_again_holds_up_no_join():
    car = (3, 20, 21, lambda now: (5.0, 6 * (now - 20)))
    assert watched(40, (1, 0, 40, at(0)), (2, 0, 10, at(4)), car) == []
    assert watched(40, (1, 0, 40, at(0)), (2, 0, 10, at(14, speed=-1)), car) == [("join", 1, (2,), 9.0)]


def test_crowds_that_join_in_a_chain_gather():
    chain = (1, 0, 40, at(0)), *((n, 0, 10 + 4 * n, at(8 * n, speed=-1.0)) for n in (2, 3))
    assert [kind for kind, *_ in watched(40, *chain)].count("gather") == 1


def test_three_that_become_one_gather_and_one_that_becomes_three_scatters_once():
    others = [(n, 0, 12, at((n - 3) * 14, speed=3.0 - n)) for n in (2, 4)]
    kinds = [(kind, set(rest)) for kind, _, rest, _ in watched(40, (1, 0, 40, at(0)), *others)]
    assert kinds == [("join", {2}), ("join", {4}), ("gather", {2, 4})]
    parts = [
        (n, 10, 40, lambda now, n=n: ((now - 8) * np.cos(1.57 * n), (now - 8) * np.sin(1.57 * n))) for n in (2, 3, 4, 5)
    ]
    told = watched(40, (1, 0, 40, at(0)), *parts)
    assert [kind for kind, *_ in told].count("split") == 4 and [kind for kind, *_ in told].count("scatter") == 1
