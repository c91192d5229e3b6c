import numpy as np
import pytest

from torchvision_dddas.lab.evaluation.metrics import bootstrap
from torchvision_dddas.lab.evaluation.metrics.bootstrap import FEWEST, Stratum


def mean_of(values):
    return lambda weight: {"mean": float(weight @ values) / float(weight.sum())}


def chain(rng, count, alike, worlds=1):
    """(worlds, count) of a series whose neighbours are correlated so; mean 0."""
    noise = rng.normal(size=(worlds, count + 200))
    series = np.zeros_like(noise)
    for t in range(1, noise.shape[1]):
        series[:, t] = alike * series[:, t - 1] + noise[:, t]
    return series[:, 200:]


def coverage(series, block=None):
    """The share of worlds whose interval of the mean holds the truth, 0."""
    held = 0
    for i, values in enumerate(series):
        size = block or bootstrap.block_length(values[:, None])
        span = bootstrap.intervals(mean_of(values), [Stratum(len(values), size)], i, 300)["mean"]
        held += span is not None and span.low <= 0 <= span.high
    return held / len(series)


@pytest.mark.slow
def test_intervals_of_correlated_frames_hold_the_truth_as_often_as_they_say():
    series = chain(np.random.default_rng(1), 300, 0.8, worlds=100)
    assert 0.88 <= coverage(series) <= 0.99
    assert coverage(series, block=1) < 0.65  # what single frames drawn anew would claim


@pytest.mark.parametrize(("units", "block", "least"), [(60, None, 0.9), (5, 1, 0.83), (8, 1, 0.88)])
def test_intervals_of_independent_frames_or_a_few_clips_hold_the_truth(units, block, least):
    # What five resampled values can span is a little too narrow.
    assert least <= coverage(np.random.default_rng(3).normal(size=(100, units)), block) <= 0.995


def test_blocks_grow_with_likeness_and_are_single_frames_without_it():
    rng = np.random.default_rng(4)
    lengths = [
        np.median([bootstrap.block_length(s[:, None]) for s in chain(rng, 400, a, worlds=20)]) for a in (0, 0.5, 0.9)
    ]
    assert lengths[0] <= 3 < lengths[1] < lengths[2]


@pytest.mark.parametrize("series", [np.zeros((30, 2)), np.full((3, 1), 1.0), np.arange(8.0)[:, None]])
def test_a_series_that_says_nothing_has_a_block_that_can_be_drawn(series):
    assert 1 <= bootstrap.block_length(series) <= max(1, len(series) // FEWEST)


def test_too_few_blocks_or_clips_or_defined_samples_give_no_interval():
    values = np.arange(20.0)
    assert bootstrap.intervals(mean_of(values), [Stratum(20, 5)], 0) == {"mean": None}
    assert bootstrap.intervals(mean_of(values[:4]), [Stratum(4)], 0) == {"mean": None}
    assert bootstrap.intervals(mean_of(values[:5]), [Stratum(5)], 0)["mean"] is not None
    rarely_defined = bootstrap.intervals(lambda weight: {"mean": 1.0 if weight[0] else float("nan")}, [Stratum(10)], 0)
    assert rarely_defined == {"mean": None}


def test_samples_have_as_many_units_of_each_clip_as_it_has_and_keep_neighbours_together():
    strata = [Stratum(10, 4), Stratum(6, 1)]
    for weight in bootstrap.weights(strata, 7, 50):
        assert (weight[:10].sum(), weight[10:].sum()) == (10, 6)
    (alone,) = bootstrap.weights([Stratum(8, 8)], 0, 1)
    assert alone.tolist() == [1] * 8


def test_the_same_content_gives_the_same_seed_and_interval():
    values = np.random.default_rng(0).normal(size=40)
    spans = [bootstrap.intervals(mean_of(values), [Stratum(40, 3)], seed) for seed in (5, 5, 6)]
    assert spans[0] == spans[1] != spans[2]
    assert bootstrap.seed_of("boxes", values) == bootstrap.seed_of("boxes", values.copy())
    assert bootstrap.seed_of("boxes", values) != bootstrap.seed_of("boxes", values[::-1])


def changed(first, second, strata, seed=0, resamples=2, most=200):
    values = np.concatenate([first, second])
    return bootstrap.effects(mean_of(values), strata, seed, resamples, most)["mean"]


def test_no_change_is_called_a_change_as_seldom_as_it_should_be():
    rng = np.random.default_rng(5)
    ps = [changed(rng.normal(size=8), rng.normal(size=8), [Stratum(8)], i).p for i in range(100)]
    assert np.mean(np.array(ps) < 0.05) < 0.1


def test_correlated_frames_are_exchanged_in_blocks_so_that_noise_is_no_change():
    rng = np.random.default_rng(6)
    worlds = list(zip(chain(rng, 200, 0.8, 40), chain(rng, 200, 0.8, 40), strict=True))
    singly, in_blocks = (
        np.mean([changed(*pair, [Stratum(200, block)], i).p < 0.05 for i, pair in enumerate(worlds)])
        for block in (1, 20)
    )
    assert in_blocks < 0.15 < singly


def test_a_change_of_all_clips_is_found_with_its_size():
    rng = np.random.default_rng(7)
    first = rng.normal(size=9)
    effect = changed(first, first + 0.5 + rng.normal(0, 0.1, 9), [Stratum(9)], resamples=500, most=600)
    assert effect.p == pytest.approx(2 / 2**9)
    assert effect.interval is not None
    assert 0.3 < effect.interval.low < 0.5 < effect.interval.high


def test_p_values_of_few_clips_are_exact():
    # Of the 2^5 ways to exchange five clips that all rose, two are as extreme: none and all.
    first = np.array([1.0, 2, 3, 4, 5])
    assert changed(first, first + 1, [Stratum(5)]).p == pytest.approx(2 / 32)
    assert changed(first, first + 1, [Stratum(5)]).least == pytest.approx(2 / 32)
    assert changed(first, first, [Stratum(5)]).p == 1


def test_holm_by_hand():
    adjusted = bootstrap.holm({"a": 0.01, "b": 0.04, "c": 0.03, "d": float("nan")})
    assert [adjusted[k] for k in "abc"] == pytest.approx([0.03, 0.06, 0.06])
    assert np.isnan(adjusted["d"])
