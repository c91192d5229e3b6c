import numpy as np
import pytest
import torch

from torchvision_dddas.tuning.aerial_location import Linear, Spread, gauss_newton_step, gaussian_nll, project_to_ground


def test_a_spread_is_the_sum_of_what_knobs_add_to_it():
    spread = Spread(torch.tensor([1.0, 0.0]), {"a": torch.tensor([2.0, 1.0]), "b": torch.tensor([0.0, 4.0])})
    found = spread.variance({"a": torch.tensor(3.0), "b": torch.tensor(0.5)})
    assert found.tolist() == [1 + 2 * 9, 9 + 4 * 0.25]


def test_surprise_is_the_density_of_a_normal_distribution():
    from scipy.stats import multivariate_normal

    covariance = np.array([[2.0, 0.6], [0.6, 0.5]])
    off = np.array([0.7, -1.1])
    found = gaussian_nll(torch.as_tensor(off), torch.as_tensor(covariance))
    assert float(found) == pytest.approx(-multivariate_normal(np.zeros(2), covariance).logpdf(off))


def test_surprise_is_least_where_ellipses_are_as_large_as_errors():
    rng = np.random.default_rng(0)
    off = torch.as_tensor(rng.normal(0, 1.5, (4000, 2)))
    sigmas = torch.linspace(0.5, 4, 71, dtype=torch.float64)
    mean = [
        float(gaussian_nll(off, (s**2 * torch.eye(2, dtype=torch.float64)).expand(4000, 2, 2)).mean()) for s in sigmas
    ]
    assert float(sigmas[int(np.argmin(mean))]) == pytest.approx(float(off.std()), abs=0.05)


def a_problem(seed: int = 0, landmarks: int = 3, batch: int = 2) -> Linear:
    rng = np.random.default_rng(seed)
    states = 7 + 2 * landmarks

    def drawn(*shape: int) -> torch.Tensor:
        return torch.as_tensor(rng.normal(0, 1, shape))

    by_turn = torch.eye(states, dtype=torch.float64).repeat(batch, 1, 1)
    by_turn[:, :3, :3] += 0.1 * drawn(batch, 3, 3)
    known = torch.ones(batch, states, dtype=torch.float64)
    return Linear(
        drawn(batch, 2 * landmarks), drawn(batch, 2 * landmarks, states), drawn(batch, states), by_turn, known
    )


def test_the_step_is_that_of_weighted_least_squares():
    problem = a_problem()
    pixels, variance = torch.full((2, 6), 0.5, dtype=torch.float64), torch.full((2, 13), 2.0, dtype=torch.float64)
    step, covariance = gauss_newton_step(problem, pixels, variance)
    for b in range(2):
        rows = np.vstack([problem.slopes[b] / np.sqrt(0.5), problem.by_turn[b] / np.sqrt(2.0)])
        wanted = np.concatenate([problem.missing[b] / np.sqrt(0.5), -problem.correction[b] / np.sqrt(2.0)])
        assert step[b].numpy() == pytest.approx(np.linalg.lstsq(rows, wanted, rcond=None)[0][:7])
        assert covariance[b].numpy() == pytest.approx(np.linalg.inv(rows.T @ rows)[:7, :7])


def test_what_is_not_known_has_no_say():
    problem = a_problem()
    problem.known[:, 2] = 0
    pixels, variance = torch.full((2, 6), 0.5, dtype=torch.float64), torch.full((2, 13), 2.0, dtype=torch.float64)
    before = gauss_newton_step(problem, pixels, variance)
    variance[:, 2] = 1e4
    problem.correction[:, 2] = 77.0
    for a, b in zip(before, gauss_newton_step(problem, pixels, variance), strict=True):
        assert a.numpy() == pytest.approx(b.numpy())


def test_gradients_of_places_by_variances_are_right():
    problem, rng = a_problem(), np.random.default_rng(1)
    off, by_pose, by_pixel = (torch.as_tensor(rng.normal(0, 1, s)) for s in ((2, 4, 2), (2, 4, 2, 7), (2, 4, 2, 2)))
    start = [torch.as_tensor(rng.uniform(0.5, 2, s)).requires_grad_() for s in ((2, 6), (2, 13), (2, 4))]

    def lost(pixels: torch.Tensor, variance: torch.Tensor, spot: torch.Tensor) -> torch.Tensor:
        # The scale that keeps digits is no part of the result: its slope must not be either.
        return gaussian_nll(
            *project_to_ground(off, by_pose, by_pixel, *gauss_newton_step(problem, pixels, variance), spot)
        )

    assert torch.autograd.gradcheck(lost, start)


def test_a_picture_among_others_is_as_by_itself():
    problem, pixels = a_problem(), torch.full((2, 6), 0.5, dtype=torch.float64)
    variance = torch.full((2, 13), 2.0, dtype=torch.float64)
    both = gauss_newton_step(problem, pixels, variance)
    for b in range(2):
        one = Linear(*(getattr(problem, name)[b : b + 1] for name in Linear.__dataclass_fields__))
        for whole, part in zip(both, gauss_newton_step(one, pixels[b : b + 1], variance[b : b + 1]), strict=True):
            assert part[0].numpy() == pytest.approx(whole[b].numpy())
