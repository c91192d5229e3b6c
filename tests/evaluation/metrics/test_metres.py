import numpy as np
import pytest

from torchvision_dddas.evaluation.metrics import metres
from torchvision_dddas.evaluation.metrics.metres import INSIDE
from torchvision_dddas.evaluation.metrics.truth import TrackTable


def samples(error, inside):
    nothing = np.full(len(error), np.nan)
    known = {"error_m": np.array(error, float), "inside": np.array(inside, float)}
    return {**known, "relative_error_m": nothing, "relative_inside": nothing}


def test_errors_by_hand():
    found = metres.measures(samples([1, 2, 3, 4], [1, 1, 0, np.nan]))
    assert (found["mean_m"], found["median_m"], found["p95_m"]) == (2.5, 2, 4)
    assert found["rms_m"] == pytest.approx(np.sqrt(7.5))
    assert found["in_ellipse"] == pytest.approx(2 / 3)
    assert np.isnan(found["relative_mean_m"])


def test_weights_count_as_copies_do():
    error, inside = np.random.default_rng(0).random((2, 9))
    weight = np.array([0, 1, 2, 3, 0, 1, 1, 2, 5.0])
    rows = np.repeat(np.arange(9), weight.astype(int))
    once = metres.measures(samples(error, inside < 0.5), weight)
    copied = metres.measures(samples(error[rows], (inside < 0.5)[rows]))
    assert once == pytest.approx(copied, nan_ok=True)


def test_quantiles_are_numpys_of_the_inverted_distribution():
    rng = np.random.default_rng(1)
    for share in (0.1, 0.5, 0.95):
        value, weight = rng.random(37), rng.integers(1, 5, 37).astype(float)
        wanted = np.quantile(value, share, weights=weight, method="inverted_cdf")
        assert metres.quantile(value, share, weight) == wanted


def test_ninety_five_in_a_hundred_gaussian_errors_lie_in_their_ellipses():
    rng = np.random.default_rng(2)
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    off = rng.multivariate_normal((0, 0), covariance, 4000)
    held = metres.inside(off, np.broadcast_to(covariance, (4000, 2, 2)))
    assert held.mean() == pytest.approx(0.95, abs=0.012)
    squared = np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariance), off)
    assert np.array_equal(held, squared <= INSIDE)


def test_an_unknown_or_flat_covariance_says_nothing():
    covariance = np.array([np.full((2, 2), np.nan), [[1, 1], [1, 1]], np.eye(2)])
    assert np.isnan(metres.inside(np.zeros((3, 2)), covariance)).tolist() == [True, True, False]


def test_each_true_box_and_place_is_one_targets():
    truth = TrackTable(
        np.array([1, 1, 2]), np.array([1, 2, 1]), np.array([[0, 0, 10, 10], [20, 0, 10, 10]] * 2)[:3] * 1.0
    )
    found = np.array([[1, 0, 10, 10], [0, 1, 10, 10], [21, 0, 10, 10], [0, 0, 10, 10]], float)
    which = metres.by_boxes(np.array([1, 1, 1, 3]), found, truth)
    assert sorted(which.tolist()) == [-1, -1, 0, 1]
    assert which[2] == 1
    places = np.array([[0, 0], [0.5, 0], [30, 0]], float)
    nearest = metres.by_places(np.array([1, 1, 1]), places, np.array([1, 1]), np.array([[0.4, 0], [19, 0.0]]))
    assert nearest.tolist() == [-1, 0, -1]


def test_marks_are_told_apart_by_where_they_drive_and_their_common_error_is_found():
    rng = np.random.default_rng(3)
    frame = np.repeat(np.arange(1, 21), 3)
    who = np.tile([5, 6, 9], 20)
    true = np.stack([15.0 * who + frame, 3.0 * frame], axis=1)
    common = np.stack([2 + 0.1 * frame, np.full(60, -1.0)], axis=1)
    driven = who != 9
    reports = (true + common + rng.normal(0, 0.05, (60, 2)))[driven]
    mark = np.where(who[driven] == 5, 1, 0)
    at, shift = metres.shared_error(frame[driven], mark, reports, frame, who, true)
    assert at.tolist() == list(range(1, 21))
    assert shift == pytest.approx(np.stack([2 + 0.1 * at, np.full(20, -1.0)], axis=1), abs=0.15)


def test_without_common_frames_no_error_is_shared():
    place = np.zeros((1, 2))
    at, shift = metres.shared_error(np.array([9]), np.array([0]), place, np.array([1]), np.array([1]), place)
    assert (len(at), shift.shape) == (0, (0, 2))
