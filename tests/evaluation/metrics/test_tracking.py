import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.evaluate import evaluate
from torchvision_dddas.evaluation.metrics import tracking
from torchvision_dddas.evaluation.metrics.matching import pair
from torchvision_dddas.evaluation.metrics.pixels import add_counts
from torchvision_dddas.evaluation.metrics.tracking import TrackCounts
from torchvision_dddas.evaluation.metrics.truth import TrackTable

BOX = {"a": (0, 0, 10, 20), "b": (100, 0, 10, 20), "c": (0, 300, 10, 20)}


def table(*frames):
    """A table from a dict a frame: place -> identity."""
    rows = [(f, name, BOX[place]) for f, frame in enumerate(frames, 1) for place, name in frame.items()]
    return TrackTable(
        np.array([f for f, _, _ in rows], np.int64),
        np.array([name for _, name, _ in rows], np.int64),
        np.array([box for _, _, box in rows], float).reshape(-1, 4),
    )


NOTHING = table()


def walk(seed, people=5, frames=12):
    """Truth and a result with loose boxes, missed and false ones, and changed identities."""
    rng = np.random.default_rng(seed)
    frame, name = (x.ravel() for x in np.meshgrid(np.arange(1, frames + 1), np.arange(people)))
    place = rng.uniform(0, 60, (people, 2))[name] + rng.normal(0, 2, (people, 2))[name] * frame[:, None]
    box = np.c_[place, np.full((len(frame), 2), (20.0, 40.0))]
    truth = TrackTable(frame, name, box).at(rng.random(len(frame)) < 0.9)
    loose = truth.box_px + rng.normal(0, 2, truth.box_px.shape)
    names = np.where(rng.random(len(loose)) < 0.1, truth.identity + 50, truth.identity)
    found = TrackTable(truth.frame, names, loose).at(rng.random(len(loose)) < 0.8)
    return truth, found


def scores(truth, found, **how):
    return tracking.measures(tracking.count(truth, found, **how)[0])


THREE = table({"a": 1, "b": 2}, {"a": 1, "b": 2}, {"a": 1, "b": 2})


def test_the_truth_itself_scores_one():
    counts = tracking.count(THREE, THREE)[0]
    assert (counts.clear.switches, counts.clear.fragmentations) == (0, 0)
    assert (counts.true, counts.found) == (2, 2)
    assert tracking.measures(counts) == pytest.approx(dict.fromkeys(tracking.measures(counts), 1) | {"mostly_lost": 0})


def test_a_target_that_changes_its_name_is_one_switch():
    found = table({"a": 1, "b": 2}, {"a": 1, "b": 2}, {"a": 1, "b": 9})
    counts = tracking.count(THREE, found)[0]
    assert counts.clear.switches == 1
    assert tracking.measures(counts)["mota"] == pytest.approx(1 - 1 / 6)
    assert counts.identity == (5, 1, 1)


def test_two_targets_that_swap_their_names_are_two_switches():
    counts = tracking.count(THREE, table({"a": 1, "b": 2}, {"a": 1, "b": 2}, {"a": 2, "b": 1}))[0]
    assert counts.clear.switches == 2
    assert tracking.measures(counts)["idf1"] == pytest.approx(4 / 6)
    # Each pair that agrees: 2 frames of 2 + 3 + 3 - ... : 2 / (3 + 3 - 2); each that does not: 1 / (3 + 3 - 1).
    assert tracking.measures(counts)["assa"] == pytest.approx((4 * 2 / 4 + 2 * 1 / 5) / 6)


def test_a_switch_is_seen_over_a_gap_and_the_gap_is_a_fragmentation():
    counts = tracking.count(THREE, table({"a": 1, "b": 2}, {"b": 2}, {"a": 7, "b": 2}))[0].clear
    assert (counts.switches, counts.fragmentations, counts.fn) == (1, 1, 1)


def test_the_name_of_the_frame_before_is_kept_where_another_box_fits_better():
    truth = TrackTable(np.array([1, 2]), np.array([1, 1]), np.array([[0, 0, 10, 10.0]] * 2))
    found = TrackTable(
        np.array([1, 2, 2]), np.array([1, 1, 2]), np.array([[0, 0, 10, 10], [3, 0, 10, 10], [0, 0, 10, 10.0]])
    )
    assert tracking.count(truth, found)[0].clear.switches == 0
    assert tracking.count(truth, found)[0].clear.overlap == pytest.approx(1 + 7 / 13)


def test_shares_of_targets_by_how_much_of_them_is_found():
    truth = table(*[{"a": 1, "b": 2, "c": 3}] * 10)
    found = table(*[{"a": 1, "b": 2, "c": 3}] * 1, *[{"a": 1, "b": 2}] * 7, *[{"a": 1}] * 2)
    counts = tracking.count(truth, found)[0].clear
    assert (counts.mostly_tracked, counts.partly_tracked, counts.mostly_lost) == (1, 1, 1)


def test_boxes_below_the_least_overlap_are_false_and_missed():
    shifted = THREE._replace(box_px=THREE.box_px + np.array([0, 7, 0, 0]))  # IoU 13 / 27
    counts = tracking.count(THREE, shifted)[0]
    assert (counts.clear.tp, counts.clear.fp, counts.clear.fn) == (0, 6, 6)
    assert tracking.measures(counts)["mota"] == -1
    # Found at alpha .05 to .45, nine of nineteen.
    assert tracking.measures(counts)["hota"] == pytest.approx(9 / 19)
    assert tracking.curves(counts.hota)["loca"][:10] == pytest.approx([13 / 27] * 9 + [1])


def test_rows_marked_zero_are_dropped_or_take_what_matches_them_along():
    truth, ignored = table({"a": 1}, {"a": 1}), table({"b": 2}, {"b": 2})
    found = table({"a": 1, "b": 2}, {"a": 1, "b": 2, "c": 3})
    assert tracking.count(truth, found, ignored)[0].clear.fp == 3
    assert tracking.count(truth, found, ignored, "removed")[0].clear.fp == 1


def test_a_found_box_is_not_removed_if_a_true_box_that_counts_needs_it():
    truth = TrackTable(np.array([1]), np.array([1]), np.array([[0, 0, 10, 10.0]]))
    ignored = TrackTable(np.array([1]), np.array([2]), np.array([[2, 0, 10, 10.0]]))
    found = TrackTable(np.array([1]), np.array([1]), np.array([[0.5, 0, 10, 10.0]]))
    assert tracking.count(truth, found, ignored, "removed")[0].clear.tp == 1


def test_nothing_found_scores_zero_and_nothing_true_is_undefined():
    m = scores(THREE, NOTHING)
    assert {m[k] for k in ("hota", "deta", "assa", "mota", "idf1", "recall", "precision")} == {0}
    assert (m["mostly_lost"], m["loca"]) == (1, 1)
    m = scores(NOTHING, THREE)
    assert all(math.isnan(m[k]) for k in ("hota", "assa", "loca", "mota", "idf1", "recall"))
    assert tracking.count(NOTHING, NOTHING)[0].clear == tracking.Clear()


def test_pooled_counts_are_those_of_one_long_clip():
    truth, found = walk(0)
    later, other = walk(1)
    long_truth, long_found = (
        TrackTable(np.r_[a.frame, b.frame + 100], np.r_[a.identity, b.identity + 1000], np.r_[a.box_px, b.box_px])
        for a, b in ((truth, later), (found, other))
    )
    pooled = add_counts(tracking.count(truth, found)[0], tracking.count(later, other)[0])
    together, apart = scores(long_truth, long_found), tracking.measures(pooled)
    assert {k: v for k, v in apart.items() if k[:3] != "ar_"} == pytest.approx(
        {k: v for k, v in together.items() if k[:3] != "ar_"}
    )
    assert tracking.measures(add_counts(TrackCounts(), pooled)) == pytest.approx(apart)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_renaming_identities_changes_nothing(seed):
    truth, found = walk(seed)
    names = np.random.default_rng(seed).permutation(200)
    renamed = scores(
        truth._replace(identity=names[truth.identity]), found._replace(identity=names[found.identity] - 50)
    )
    assert renamed == pytest.approx(scores(truth, found))


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_the_order_of_rows_changes_nothing(seed):
    truth, found = walk(seed)
    rng = np.random.default_rng(seed)
    shuffled = scores(truth.at(rng.permutation(len(truth.frame))), found.at(rng.permutation(len(found.frame))))
    assert shuffled == pytest.approx(scores(truth, found))


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_counts_add_up_to_the_boxes_there_are(seed):
    truth, found = walk(seed)
    counts = tracking.count(truth, found)[0]
    for right, missed, false in (counts.clear[:3], (counts.identity.idtp, *counts.identity[1:])):
        assert (right + missed, right + false) == (len(truth.frame), len(found.frame))
    assert (counts.hota.tp + counts.hota.fn == len(truth.frame)).all()
    assert counts.identity.idtp <= counts.clear.tp
    assert (np.diff(counts.hota.tp) <= 0).all()


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(0, 10))
def test_a_wrong_name_more_never_raises_hota_or_idf1(seed, row):
    truth, _ = walk(seed)
    names = truth.identity.copy()
    names[row % len(names)] = 999
    worse = scores(truth, truth._replace(identity=names))
    assert worse["hota"] <= 1
    assert worse["idf1"] == pytest.approx(1 - 1 / len(names))


def test_an_interval_takes_every_so_many_frames():
    truth = table(*[{"a": 1}] * 11)
    assert truth.every(5).frame.tolist() == [1, 6, 11]


def test_one_labelled_target_is_followed_among_others():
    truth = table({"a": 1}, {"a": 1}, {"a": 1}, {"a": 1})
    found = table({"a": 4, "b": 1}, {"b": 1}, {"a": 5, "b": 1}, {"a": 5})
    counts = tracking.count_one_target(truth, found)[0]
    assert counts == (4, 3, 1, 1, 2)
    assert tracking.one_target_measures(counts) == {"found": 0.75, "same_identity": 0.5}


def test_the_accuracy_ratio_of_windows_counts_wrong_links():
    truth = table(*[{"a": 1, "b": 2}] * 4)
    found = table({"a": 1, "b": 2}, {"a": 1, "b": 2}, {"a": 2, "b": 1}, {"a": 2, "b": 1})
    m = scores(truth, found)
    assert m["ar_2"] == pytest.approx((1 + 0 + 1) / 3)
    assert m["ar_3"] == pytest.approx((2 / 4 + 2 / 4) / 2)


def test_windows_are_of_looks_an_interval_apart():
    truth = table({"a": 1}, {}, {"a": 1}, {}, {"a": 1})
    found = table({"a": 1}, {}, {"a": 2}, {}, {"a": 2})
    assert tracking.count(truth, found, interval=2)[0].links_2 == (2, 1.0)
    assert tracking.count(truth, found, interval=2)[0].links_3 == (1, 0.5)


def test_windows_of_looks_far_apart_are_those_of_the_same_looks_close_by():
    near = table({"a": 1}, {"a": 1}, {}, {}, {}, {}, {"a": 2}, {"a": 1}, {"a": 1})
    far = near._replace(frame=np.where(near.frame > 3, near.frame + 2**50, near.frame))
    for interval in (1, 2):
        counts = [tracking.count(t, t, interval=interval)[0] for t in (near, far)]
        assert (counts[0].links_2, counts[0].links_3) == (counts[1].links_2, counts[1].links_3)
    # Every window of three looks on frames 1 to 9 that holds a target.
    assert tracking.count(near, near)[0].links_3[0] == 5


def test_an_identity_twice_in_a_frame_is_refused():
    twice = TrackTable(np.array([3, 3]), np.array([7, 7]), np.ones((2, 4)))
    with pytest.raises(InputError, match="the result has identity 7 twice in frame 3"):
        pair(THREE, twice)


# What TrackEval 1.3.0 gives for these two tables: TRUTH as gt/a/gt/gt.txt, FOUND as results/r/data/a.txt, {"a": 8} as
# lengths.json under FOLDER, then `.venv-peers/bin/python eval/peers/trackeval_figures.py FOLDER OUT.json`.
TRUTH = """
1 1 22 35 20 40 1
2 1 18 38 20 40 0
3 1 14 41 20 40 1
4 1 10 44 20 40 1
5 1 6 47 20 40 0
6 1 2 50 20 40 0
7 1 -2 53 20 40 1
1 2 33 24 20 40 1
2 2 35 20 20 40 1
3 2 37 16 20 40 1
4 2 39 12 20 40 1
6 2 43 4 20 40 1
7 2 45 0 20 40 1
8 2 47 -4 20 40 1
1 3 38 27 20 40 1
2 3 39 27 20 40 1
3 3 40 27 20 40 1
4 3 41 27 20 40 1
5 3 42 27 20 40 1
6 3 43 27 20 40 1
7 3 44 27 20 40 1
8 3 45 27 20 40 1
"""

FOUND = """
1 1 20 34 19 42 1
2 1 15 42 19 42 1
3 1 12 45 19 42 1
4 1 11 44 19 42 1
5 1 10 45 19 42 1
6 3 -1 53 19 42 1
1 2 33 22 19 42 1
2 2 33 22 19 42 1
3 2 33 14 19 42 1
4 2 43 10 19 42 1
6 2 43 3 19 42 1
8 2 44 -2 19 42 1
1 3 35 29 19 42 1
2 3 35 24 19 42 1
3 3 36 29 19 42 1
5 3 41 29 19 42 1
6 1 44 27 19 42 1
7 1 41 23 19 42 1
2 8 200 5 20 40 1
3 8 203 5 20 40 1
"""

TRACKEVAL = {
    "hota": 0.41834155257535544,
    "deta": 0.43536976605737215,
    "assa": 0.4027483453343777,
    "loca": 0.7809696564699453,
    "detre": 0.5761772853185597,
    "detpr": 0.5473684210526315,
    "assre": 0.5048595045305571,
    "asspr": 0.5493682925261871,
    "mota": 0.47368421052631576,
    "motp": 0.7106465371732092,
    "recall": 0.7894736842105263,
    "precision": 0.75,
    "mostly_tracked": 0.3333333333333333,
    "mostly_lost": 0.0,
    "n_tp": 15.0,
    "n_fn": 4.0,
    "n_fp": 5.0,
    "n_switches": 1.0,
    "n_fragmentations": 4.0,
    "n_mostly_tracked": 1.0,
    "n_partly_tracked": 2.0,
    "n_mostly_lost": 0.0,
    "idf1": 0.6666666666666666,
    "idp": 0.65,
    "idr": 0.6842105263157895,
    "n_idtp": 13.0,
    "n_idfn": 6.0,
    "n_idfp": 7.0,
}


def test_the_figures_are_trackevals(tmp_path):
    for name, text in (("gt.txt", TRUTH), ("found.txt", FOUND)):
        (tmp_path / name).write_text(text.lstrip())
    found = evaluate(tmp_path / "gt.txt", tmp_path / "found.txt")["clips"]["found"]["tracks"]
    assert {name: found[name] for name in TRACKEVAL} == pytest.approx(TRACKEVAL, abs=1e-9)
