"""The made-up detectors and the scores of the study of identities; no peer runs here."""

import importlib
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from torchvision_dddas.lab.evaluation.metrics import tracking
from torchvision_dddas.lab.evaluation.metrics.matching import pair
from torchvision_dddas.lab.evaluation.metrics.truth import TrackTable

ROOT = Path(__file__).resolve().parents[2]
PEERS = ROOT / "eval" / "peers"

pytestmark = pytest.mark.skipif(not PEERS.is_dir(), reason="studies are in a checkout, not in a package")

FRAMES, TARGETS, SIZE = 300, 20, (640.0, 480.0)


@pytest.fixture(scope="module")
def study():
    """Imports a module of the study by name."""
    modules, path = set(sys.modules), list(sys.path)
    sys.path[:0] = [str(ROOT / "eval"), str(PEERS)]
    yield importlib.import_module
    sys.path[:] = path
    for name in set(sys.modules) - modules:  # modules of a study must not shadow others later
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(ROOT / "eval")):
            del sys.modules[name]


@pytest.fixture(scope="module")
def truth() -> TrackTable:
    """Targets that stand apart, each as wide and high as none other."""
    frame, identity = np.repeat(np.arange(1, FRAMES + 1), TARGETS), np.tile(np.arange(TARGETS), FRAMES)
    corner = np.c_[30.0 * identity, 5.0 * identity + 0.1 * frame]
    return TrackTable(frame, identity, np.c_[corner, 10.0 + identity, 20.0 + identity])


def given(study, truth: TrackTable, condition: str, interval: int = 1, name: str = "a"):
    detectors: ModuleType = study("detectors")
    return detectors.look(name, truth, FRAMES, SIZE, interval, detectors.DETECTORS[condition])


# -- made-up detectors -----------------------------------------------------------------------------------------------


def test_true_boxes_are_those_of_every_frame_looked_at_in_another_order(study, truth) -> None:
    found, wanted = given(study, truth, "true", 5).table, truth.every(5)
    assert (np.diff(found.frame) >= 0).all()
    order = np.lexsort((found.identity, found.frame))
    for column, known in zip(found.at(order), wanted, strict=True):
        np.testing.assert_array_equal(column, known)
    assert (found.identity != wanted.identity).any()


def test_the_errors_of_a_detector_are_as_large_as_it_says(study, truth) -> None:
    detector = study("detectors").DETECTORS["noisy"]
    found = given(study, truth, "noisy")
    true = found.truth
    assert len(true.frame) / len(truth.frame) == pytest.approx(1 - detector.dropped, abs=0.02)
    assert len(found.table.frame) - len(true.frame) == FRAMES * detector.false
    known = truth.box_px[(true.frame - 1) * TARGETS + true.identity]
    near = (true.box_px[:, :2] - known[:, :2]) / known[:, 2:]
    assert near.std() == pytest.approx(detector.jitter, rel=0.05)
    false = found.table.identity == study("detectors").FALSE
    assert found.score[~false].mean() == pytest.approx(9 / 10.5, abs=0.01)
    assert found.score[false].mean() == pytest.approx(2 / 5, abs=0.05)


def test_flat_scores_say_nothing(study, truth) -> None:
    assert (given(study, truth, "noisy, flat scores").score == 1).all()


def test_at_an_unknown_rate_the_same_boxes_come_with_consecutive_frames(study, truth) -> None:
    known, unknown = (given(study, truth, condition, 15) for condition in ("noisy", "noisy, unknown rate"))
    np.testing.assert_array_equal(known.table.box_px, unknown.table.box_px)
    np.testing.assert_array_equal((known.table.frame - 1) // 15 + 1, unknown.table.frame)
    assert (known.interval, unknown.interval, unknown.length) == (15, 1, FRAMES // 15)


def test_a_table_is_the_same_at_every_call_and_another_for_another_sequence(study, truth) -> None:
    first, again, other = (given(study, truth, "very noisy", 5, name) for name in "aab")
    np.testing.assert_array_equal(first.table.box_px, again.table.box_px)
    assert len(first.score) != len(other.score) or (first.score != other.score).any()


# -- scores ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("true", "found", "idf1", "switches"),
    [
        ([1, 1, 2, 2], [7, 7, 8, 8], 100.0, 0),
        # Target 2 is explained by identity 6 or not at all: m = 3 of 4 true rows and 5 named ones.
        ([1, 2, 1, 2, -1], [5, 5, 5, 6, 6], 200 * 3 / 9, 1),
        # A row without identity is missing, and nothing switches.
        ([1, 1, 1], [4, 0, 4], 200 * 2 / 5, 0),
        ([1, 1, 1], [4, 0, 5], 200 * 1 / 5, 1),
        ([1, 1], [0, 0], 0.0, 0),
        ([-1, -1], [0, 3], 0.0, 0),
        ([], [], 0.0, 0),
    ],
)
def test_scores_of_rows_by_hand(study, true, found, idf1, switches) -> None:
    score = study("row_scores").score_rows(np.array(true, int), np.array(found, int))
    assert score == (pytest.approx(idf1), switches)


def test_scores_of_rows_are_those_of_whole_tables_where_each_box_is_found_as_it_is(study, truth) -> None:
    looks = given(study, truth, "true", 5)
    rng = np.random.default_rng(0)
    shift = np.cumsum(rng.random(FRAMES + 1) < 0.02)[looks.table.frame]  # now and then all identities move on by one
    identity = np.where(rng.random(len(shift)) < 0.2, 0, (looks.table.identity + shift) % TARGETS + 1)
    idf1, switches = study("row_scores").score_rows(looks.table.identity, identity)
    both = pair(looks.table, looks.table._replace(identity=identity).at(identity > 0))
    assert idf1 == pytest.approx(100 * tracking.identity_measures(tracking.count_identity(both, 0.9))["idf1"])
    assert switches == tracking.count_clear(both, 0.9)[0].switches > 0


def test_the_bounds_hold_the_mean_and_close_as_sequences_agree(study) -> None:
    bounds = study("row_scores").bounds_of_mean
    values = np.random.default_rng(1).normal(50, 10, 12)
    low, high = bounds(values)
    assert low < values.mean() < high
    # A normal mean has 3.92 standard errors between its bounds.
    assert high - low == pytest.approx(3.92 * values.std() / 12**0.5, rel=0.1)
    assert bounds(np.full(12, 7.0)) == (7.0, 7.0)


# -- sets and what is kept -------------------------------------------------------------------------------------------


def test_sequences_of_one_name_are_a_set_and_the_others_one_more(study) -> None:
    names = ["A-1", "A-2", "B-1", "C-1", "C-2", "C-3", "D"]
    assert study("identities").group(names) == {"others": ["A-1", "A-2", "B-1", "D"], "C": ["C-1", "C-2", "C-3"]}


def test_a_sequence_has_no_part_in_choosing_its_own_setting(study) -> None:
    # The second setting is best on the first sequence alone, and so much that it is the best in the mean as well.
    score = np.array([[50.0, 60, 60], [100.0, 55, 55]])
    choose = study("left_out").choose_without_each
    assert choose(score, np.ones(3)).tolist() == [0, 1, 1]
    assert choose(score, np.array([0.01, 1, 1])).tolist() == [0, 0, 0]


def test_every_condition_has_a_twin_of_known_rate(study) -> None:
    at_known_rate = study("identities").at_known_rate
    assert at_known_rate("noisy, unknown rate") == "noisy" == at_known_rate("noisy")
    assert at_known_rate("true, unknown rate") == "true"


def test_runs_of_peers_are_read_again_until_tables_or_settings_change(study, truth, tmp_path) -> None:
    kept, score = study("kept_peers"), study("row_scores").Score
    looks = [given(study, truth, "noisy", 5)]
    key = kept.checksum(looks, [{}])
    assert key != kept.checksum(looks, [{}, {"gate": 1}])
    assert key != kept.checksum([given(study, truth, "true", 5)], [{}])
    runs = [
        kept.Run(settings, {"a": score(a, 3, 0.5), "b": score(b, 0, 0.25)})
        for settings, a, b in (({}, 50.0, 60.0), ({"gate": 1}, 70.0, 40.0), ({"times": True}, 90.0, 80.0))
    ]
    path, sets = tmp_path / "kept.json", {"first": ["a"], "second": ["b"]}
    kept.KeptPeers(path, sets).add("noisy", 5, "SORT", key, runs)
    again = kept.KeptPeers(path, sets)
    assert again.has("noisy", 5, "SORT", key) and not again.has("noisy", 5, "SORT", key + 1)
    assert not again.has("noisy", 15, "SORT", key)
    assert again.defaults("noisy", 5, "SORT") == runs[0]
    best, untimed = (again.tuned("noisy", 5, "SORT", "first", times=times) for times in (True, False))
    assert (best.settings, untimed.settings) == ({"times": True}, {"gate": 1})
    assert (best.idf1(["a"]), untimed.idf1(["a"])) == (90.0, 70.0)
    assert again.tuned("noisy", 5, "SORT", "second", times=False).idf1(["b"]) == 60.0
    assert not kept.KeptPeers(path, {"first": ["a"]}).has("noisy", 5, "SORT", key)
    assert json.loads(path.read_text())["figures"]["sets"] == sets
