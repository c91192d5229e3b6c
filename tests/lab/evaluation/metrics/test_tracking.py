import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.evaluate import evaluate
from torchvision_dddas.lab.evaluation.metrics import tracking
from torchvision_dddas.lab.evaluation.metrics.matching import pair
from torchvision_dddas.lab.evaluation.metrics.pixels import add_counts
from torchvision_dddas.lab.evaluation.metrics.tracking import TrackCounts, accuracy_ratio, mismatches
from torchvision_dddas.lab.evaluation.metrics.truth import TrackTable

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
    found = scores(THREE, THREE)
    assert found == pytest.approx(dict.fromkeys(found, 1) | {"mostly_lost": 0})


@pytest.mark.parametrize(
    ("last", "switches", "identity", "assa"),
    [
        ({"a": 1, "b": 9}, 1, (5, 1, 1), (3 * 3 / 3 + 2 * 2 / 3 + 1 / 3) / 6),
        # Each pair that agrees over two frames: 2 / (3 + 3 - 2); over one: 1 / (3 + 3 - 1).
        ({"a": 2, "b": 1}, 2, (4, 2, 2), (4 * 2 / 4 + 2 * 1 / 5) / 6),
    ],
)
def test_a_target_that_changes_its_identity_is_a_switch(last, switches, identity, assa):
    counts = tracking.count(THREE, table({"a": 1, "b": 2}, {"a": 1, "b": 2}, last))[0]
    assert (counts.clear.switches, counts.identity) == (switches, identity)
    found = tracking.measures(counts)
    assert (found["mota"], found["idf1"]) == pytest.approx((1 - switches / 6, identity[0] / 6))
    assert found["assa"] == pytest.approx(assa)


def test_the_identity_of_the_frame_before_is_kept_where_another_box_fits_better():
    truth = TrackTable(np.array([1, 2]), np.array([1, 1]), np.array([[0, 0, 10, 10.0]] * 2))
    boxes = np.array([[0, 0, 10, 10], [3, 0, 10, 10], [0, 0, 10, 10.0]])
    counts = tracking.count(truth, TrackTable(np.array([1, 2, 2]), np.array([1, 1, 2]), boxes))[0].clear
    assert counts.switches == 0
    assert counts.overlap == pytest.approx(1 + 7 / 13)


def test_gaps_and_shares_of_targets_by_hand():
    counts = tracking.count(THREE, table({"a": 1, "b": 2}, {"b": 2}, {"a": 7, "b": 2}))[0].clear
    assert (counts.switches, counts.fragmentations, counts.fn) == (1, 1, 1)
    everybody = {"a": 1, "b": 2, "c": 3}
    found = table(everybody, *[{"a": 1, "b": 2}] * 7, *[{"a": 1}] * 2)
    counts = tracking.count(table(*[everybody] * 10), found)[0].clear
    assert (counts.mostly_tracked, counts.partly_tracked, counts.mostly_lost) == (1, 1, 1)


def test_boxes_below_the_least_overlap_are_false_and_missed():
    shifted = THREE._replace(box_px=THREE.box_px + np.array([0, 7, 0, 0]))  # IoU 13 / 27
    counts = tracking.count(THREE, shifted)[0]
    assert (counts.clear.tp, counts.clear.fp, counts.clear.fn) == (0, 6, 6)
    assert tracking.measures(counts)["mota"] == -1
    # Found at alpha .05 to .45, nine of nineteen.
    assert tracking.measures(counts)["hota"] == pytest.approx(9 / 19)
    assert tracking.curves(counts.hota)["loca"][:10] == pytest.approx([13 / 27] * 9 + [1])


def test_rows_marked_zero_are_dropped_or_removed_with_their_matches():
    truth, ignored = table({"a": 1}, {"a": 1}), table({"b": 2}, {"b": 2})
    found = table({"a": 1, "b": 2}, {"a": 1, "b": 2, "c": 3})
    assert tracking.count(truth, found, ignored)[0].clear.fp == 3
    assert tracking.count(truth, found, ignored, "removed")[0].clear.fp == 1
    truth, ignored, found = (  # a found box stays where a true box that counts needs it
        TrackTable(np.array([1]), np.array([k]), np.array([[x, 0, 10, 10.0]])) for k, x in ((1, 0), (2, 2), (1, 0.5))
    )
    assert tracking.count(truth, found, ignored, "removed")[0].clear.tp == 1


def test_nothing_found_scores_zero_and_nothing_true_is_undefined():
    m = scores(THREE, NOTHING)
    assert {m[k] for k in ("hota", "deta", "assa", "mota", "idf1", "recall", "precision")} == {0}
    assert (m["mostly_lost"], m["loca"]) == (1, 1)
    m = scores(NOTHING, THREE)
    assert all(math.isnan(m[k]) for k in ("hota", "assa", "loca", "mota", "idf1", "recall"))
    assert tracking.count(NOTHING, NOTHING)[0].clear == tracking.Clear()


def test_pooled_counts_are_those_of_one_long_clip():
    pairs = walk(0), walk(1)
    long = [
        TrackTable(np.r_[a.frame, b.frame + 100], np.r_[a.identity, b.identity + 1000], np.r_[a.box_px, b.box_px])
        for a, b in zip(*pairs, strict=True)
    ]
    pooled = add_counts(*(tracking.count(truth, found)[0] for truth, found in pairs))
    together, apart = scores(*long), tracking.measures(pooled)
    links = {name: together[name] for name in together if name.startswith("ar_")}  # windows at the joint differ
    assert apart | links == pytest.approx(together)
    assert tracking.measures(add_counts(TrackCounts(), pooled)) == pytest.approx(apart)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_scores_do_not_depend_on_names_or_order_and_counts_add_up_to_the_boxes(seed):
    truth, found = walk(seed)
    rng = np.random.default_rng(seed)
    names, expected = rng.permutation(200), pytest.approx(scores(truth, found))
    named = truth._replace(identity=names[truth.identity]), found._replace(identity=names[found.identity] - 50)
    assert scores(*named) == expected
    assert scores(truth.at(rng.permutation(len(truth.frame))), found.at(rng.permutation(len(found.frame)))) == expected
    counts = tracking.count(truth, found)[0]
    for right, missed, false in (counts.clear[:3], (counts.identity.idtp, *counts.identity[1:])):
        assert (right + missed, right + false) == (len(truth.frame), len(found.frame))
    assert (counts.hota.tp + counts.hota.fn == len(truth.frame)).all()
    assert counts.identity.idtp <= counts.clear.tp
    assert (np.diff(counts.hota.tp) <= 0).all()


def test_one_labelled_target_is_followed_among_others():
    truth = table({"a": 1}, {"a": 1}, {"a": 1}, {"a": 1})
    found = table({"a": 4, "b": 1}, {"b": 1}, {"a": 5, "b": 1}, {"a": 5})
    counts = tracking.count_one_target(truth, found)[0]
    assert counts == (4, 3, 1, 1, 2)
    assert tracking.one_target_measures(counts) == {"found": 0.75, "same_identity": 0.5}


def test_the_accuracy_ratio_counts_wrong_links_over_windows_of_frames_an_interval_apart():
    truth, swapped = {"a": 1, "b": 2}, {"a": 2, "b": 1}
    m = scores(table(*[truth] * 4), table(truth, truth, swapped, swapped))
    assert (m["ar_2"], m["ar_3"]) == pytest.approx(((1 + 0 + 1) / 3, (2 / 4 + 2 / 4) / 2))
    truth, found = (table({"a": 1}, {}, {"a": k}, {}, {"a": k}) for k in (1, 2))
    counts = tracking.count(truth, found, interval=2)[0]
    assert (counts.links_2, counts.links_3) == ((2, 1.0), (1, 0.5))


def test_windows_in_distant_frames_are_those_of_the_same_frames_close_by():
    near = table({"a": 1}, {"a": 1}, {}, {}, {}, {}, {"a": 2}, {"a": 1}, {"a": 1})
    far = near._replace(frame=np.where(near.frame > 3, near.frame + 2**50, near.frame))
    for interval in (1, 2):
        first, second = (tracking.count(t, t, interval=interval)[0] for t in (near, far))
        assert (first.links_2, first.links_3) == (second.links_2, second.links_3)
    # Every window of three frames in 1 to 9 that holds a target.
    assert tracking.count(near, near)[0].links_3[0] == 5


def test_an_identity_twice_in_a_frame_is_refused():
    twice = TrackTable(np.array([3, 3]), np.array([7, 7]), np.ones((2, 4)))
    with pytest.raises(InputError, match="the result has identity 7 twice in frame 3"):
        pair(THREE, twice)


# What TrackEval 1.3.0 gives for these MOTChallenge tables: TRUTH as gt/a/gt/gt.txt, FOUND as results/r/data/a.txt, and
# {"a": 8} as lengths.json under FOLDER, then `.venv-peers/bin/python eval/peers/trackeval_figures.py FOLDER OUT.json`.
TRUTH = (
    "1,1,22,35,20,40,1 2,1,18,38,20,40,0 3,1,14,41,20,40,1 4,1,10,44,20,40,1 5,1,6,47,20,40,0 6,1,2,50,20,40,0 "
    "7,1,-2,53,20,40,1 1,2,33,24,20,40,1 2,2,35,20,20,40,1 3,2,37,16,20,40,1 4,2,39,12,20,40,1 6,2,43,4,20,40,1 "
    "7,2,45,0,20,40,1 8,2,47,-4,20,40,1 1,3,38,27,20,40,1 2,3,39,27,20,40,1 3,3,40,27,20,40,1 4,3,41,27,20,40,1 "
    "5,3,42,27,20,40,1 6,3,43,27,20,40,1 7,3,44,27,20,40,1 8,3,45,27,20,40,1"
)

FOUND = (
    "1,1,20,34,19,42,1 2,1,15,42,19,42,1 3,1,12,45,19,42,1 4,1,11,44,19,42,1 5,1,10,45,19,42,1 6,3,-1,53,19,42,1 "
    "1,2,33,22,19,42,1 2,2,33,22,19,42,1 3,2,33,14,19,42,1 4,2,43,10,19,42,1 6,2,43,3,19,42,1 8,2,44,-2,19,42,1 "
    "1,3,35,29,19,42,1 2,3,35,24,19,42,1 3,3,36,29,19,42,1 5,3,41,29,19,42,1 6,1,44,27,19,42,1 7,1,41,23,19,42,1 "
    "2,8,200,5,20,40,1 3,8,203,5,20,40,1"
)

TRACKEVAL = {
    "hota": 0.4183415526, "deta": 0.4353697661, "assa": 0.4027483453, "loca": 0.7809696565, "detre": 0.5761772853,
    "detpr": 0.5473684211, "assre": 0.5048595045, "asspr": 0.5493682925, "mota": 0.4736842105, "motp": 0.7106465372,
    "recall": 0.7894736842, "precision": 0.75, "mostly_tracked": 0.3333333333, "mostly_lost": 0,
    "idf1": 0.6666666667, "idp": 0.65, "idr": 0.6842105263,
    "n_tp": 15, "n_fn": 4, "n_fp": 5, "n_switches": 1, "n_fragmentations": 4, "n_mostly_tracked": 1,
    "n_partly_tracked": 2, "n_mostly_lost": 0, "n_idtp": 13, "n_idfn": 6, "n_idfp": 7,
}  # fmt: skip


def test_the_figures_are_trackevals(tmp_path):
    for name, text in (("gt.txt", TRUTH), ("found.txt", FOUND)):
        (tmp_path / name).write_text(text.replace(" ", "\n") + "\n")
    found = evaluate(tmp_path / "gt.txt", tmp_path / "found.txt")["clips"]["found"]["tracks"]
    assert {name: found[name] for name in TRACKEVAL} == pytest.approx(TRACKEVAL, abs=1e-9)


# -- accuracy ratio ----------------------------------------------------------------------------------------------------


def rows(*lines: tuple[int, ...]) -> np.ndarray:
    return np.array(lines)


@pytest.mark.parametrize(
    ("associated", "frames", "wanted"),
    [
        (rows((1, 1), (2, 2)), ([7, 8], [7, 8]), 0),
        (rows((1, 2), (2, 1)), ([7, 8], [7, 8]), 2),  # swapped
        (rows((1, 1), (2, 0), (0, 2)), ([7, 8], [7, 8]), 1),  # with the dummy although it is there
        (rows((1, 1), (0, 2)), ([7], [7, 8]), 0),  # gone indeed
        (rows((1, 2), (0, 1)), ([7], [7, 8]), 2),  # 8 takes the place of 7, which is there
        (rows((1, 1), (2, 0)), ([7, 9], [7]), 0),  # new indeed
        (rows((1, 1)), ([9], [7]), 1),  # followed by another
        (rows((1, 1, 2), (2, 2, 1)), ([7, 8], [7, 8], [7, 8]), 2),  # the older link swapped
        (rows((1, 2, 1), (2, 1, 2)), ([7, 8], [7, 8], [7, 8]), 4),  # both
        (rows((1, 0, 1), (2, 1, 2)), ([7, 8], [8], [7, 8]), 0),  # bridged rightly
        (rows((1, 0, 2), (2, 1, 0), (0, 0, 1)), ([7, 8], [8], [7, 8]), 1),  # 8 was there: one mismatch, not two
        (rows((1, 0, 1), (2, 0, 0)), ([9, 8], [], [7]), 1),  # bridged to another
        (rows((1, 0, 0), (0, 0, 1)), ([7], [], [7]), 0),  # a bridge that was not made
        (np.zeros((0, 2), int), ([], []), 0),
    ],
)
def test_mismatches_by_hand(associated, frames, wanted):
    """frames: true identities, newest frame first."""
    identities = [np.array(f, int) for f in frames]
    assert mismatches(associated, identities) == wanted
    links = (len(frames) - 1) * max(map(len, frames))
    assert accuracy_ratio(associated, identities) == (1 - wanted / links if links else 1)


@pytest.mark.parametrize(
    ("associated", "wanted"),
    [
        (rows((1, 1)), "frame 0 .* has 2 targets"),
        (rows((1, 1), (2, 1)), r"frame 1 .* got rows for \[1, 1\]"),
        (rows((1, 1, 1), (2, 2, 2)), "as many columns"),
    ],
)
def test_rows_that_are_no_assignment_are_refused(associated, wanted):
    with pytest.raises(InputError, match=wanted):
        mismatches(associated, [np.array([7, 8])] * 2)


@given(st.permutations(range(5)), st.permutations(range(5)))
@settings(max_examples=40, deadline=None)
def test_only_a_row_of_one_identity_is_free_of_mismatches(first, second):
    associated = np.stack([np.arange(5), np.array(first), np.array(second)], axis=1) + 1
    known = np.arange(5)
    wrong = (np.array(first) != known).sum() + (np.array(second) != np.array(first)).sum()
    assert mismatches(associated, [known, known, known]) == wrong
