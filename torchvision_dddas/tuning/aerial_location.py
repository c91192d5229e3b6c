"""Positions of targets seen from the air as functions of the noise parameters, with gradients about the hard fit.

`geo.pose_estimation.find_pose` finds the likeliest pose and landmark positions. At that point one more Gauss-Newton
step is zero, and its derivative by the parameters is that of the fit itself, except for the curvature of the projection
where the picture disagrees with it. So positions have the value of the hard fit and the gradient of that step.

Every variance is a sum of squares of parameters: `Spread` holds what each of them adds.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchvision_dddas.config import AerialParameters, Settings
from torchvision_dddas.geo.landmark_faults import passes
from torchvision_dddas.geo.pose_estimation import (
    EXACT_M,
    Prior,
    find_pose,
    focal_prior,
    independent_expectation,
    linearize_pose,
    pose_prior,
)
from torchvision_dddas.geo.projection import Surface, ground_with_slopes
from torchvision_dddas.tuning.parameters import value_of
from torchvision_dddas.types import Camera, CameraPose, Flight, LandmarkObservations

PRIOR = (
    "focal_sigma",
    "focal_guess_sigma",
    "tilt_sigma_deg",
    "tilt_guess_sigma_deg",
    "heading_sigma_deg",
    "altitude_sigma",
    "altitude_sigma_m",
    "position_sigma_m",
)
"""Parameters of the group `aerial` that say how well telemetry is known."""

NO_NOISE = 3.0
"""Landmarks that do not fit even with errors this many times as large have a wrong identity or position. No noise level
explains them, so that their frames are no examples."""

_FLOOR = 1e-12  # of a variance: `pose_prior` takes no standard deviation below 1e-6


SPREADS = (
    *(f"aerial.{name}" for name in PRIOR),
    "aerial.target_sigma_px",
    "aerial.own_sigma",
    "landmarks.pixel_sigma",
    "landmarks.sigma_m",
    "landmarks.common_sigma_m",
)
"""All parameters that the ellipses of targets seen from the air depend on."""


@dataclass(frozen=True)
class Spread:
    """Variances (..., N) that are base + sum of gain × parameter². gain: by the parameter's name."""

    base: Tensor
    gain: Mapping[str, Tensor] = field(default_factory=dict)

    def variance(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """(..., N). parameters: all that have a gain."""
        total = self.base
        for name, gain in self.gain.items():
            total = total + gain * parameters[name].to(gain) ** 2
        return total


@dataclass(frozen=True)
class Linear:
    """The least squares of poses and landmark positions about the hard solutions of B pictures of m landmarks each.

    missing: (B, 2m) px. slopes: (B, 2m, S) of the pixels by the S = 7 + 2m numbers of pose and positions. correction:
    (B, S) of telemetry and reports. by_turn: (B, S, S) its growth with a step. known: (B, S), 1 where something is
    expected, else 0. As `linearize_pose` returns them.
    """

    missing: Tensor
    slopes: Tensor
    correction: Tensor
    by_turn: Tensor
    known: Tensor


@dataclass(frozen=True)
class AerialView:
    """One picture. Metres are local, in one frame of reference.

    reference: the pose by telemetry; known: (7,) which of its numbers are known; prior: their variances (7,). marks: n
    landmarks, all with pixel and position; places: variances (n,) m² of the positions; pixels: (n,) px² of the pixels.
    targets_px: (T, 2); up_m: (T,) their heights above the ground; spot: variances (T,) px². true_m: (T, 2). surface:
    the ground, if not flat.
    """

    camera: Camera
    reference: CameraPose
    known: np.ndarray
    prior: Spread
    marks: LandmarkObservations
    places: Spread
    pixels: Spread
    targets_px: np.ndarray
    up_m: np.ndarray
    spot: Spread
    true_m: np.ndarray
    surface: Surface | None = None


@dataclass(frozen=True)
class GroundFit:
    """A view at its likeliest pose under some variances: errors of targets and their derivatives, detached."""

    problem: Linear
    off_m: Tensor
    by_pose: Tensor
    by_pixel: Tensor


@dataclass(frozen=True)
class AerialExample:
    """The content of an example. settings: those it was prepared with.

    fit: used in place of a hard fit with the current parameters (see `keep_fit`); None: fit anew each time.
    """

    view: AerialView
    settings: Settings
    fit: GroundFit | None = None


def keep_fit(example: AerialExample) -> AerialExample | None:
    """Keep the fit at the example's settings: a hundred times as fast, and right to first order about these.

    None where no pose shows the landmarks.
    """
    fit = fit_ground(example.view, default_values(example.settings))
    return None if fit is None else replace(example, fit=fit)


def build_view(
    camera: Camera,
    flight: Flight | None,
    marks: LandmarkObservations,
    targets_px: np.ndarray,
    true_m: np.ndarray,
    settings: Settings,
    own: np.ndarray,
    up_m: np.ndarray | None = None,
    side_px: np.ndarray | None = None,
    focal_known: bool = True,
    surface: Surface | None = None,
) -> AerialView:
    """A view in which the variances depend on the parameters.

    marks: with the standard deviations of the settings. own: (n,) bool, landmarks whose reports give no standard
    deviation, so that landmarks.sigma_m counts. side_px: (T,) of the boxes, for aerial.own_sigma.
    """
    aerial, landmarks = settings.aerial, settings.landmarks
    of_parameters = _prior(flight, camera, aerial, focal_known)
    share = landmarks.sigma_m**2
    reported = marks.sigma_m**2 - np.where(own, share, 0.0)
    count = len(targets_px)
    side = np.zeros(count) if side_px is None else side_px
    return AerialView(
        camera,
        of_parameters.pose,
        of_parameters.known,
        _spread_of(flight, camera, focal_known),
        marks,
        Spread(_column(np.maximum(reported, 0)), {"landmarks.sigma_m": _column(own)}),
        Spread(_column(np.zeros(len(marks))), {"landmarks.pixel_sigma": _column(np.ones(len(marks)))}),
        np.asarray(targets_px, float).reshape(-1, 2),
        np.zeros(count) if up_m is None else up_m,
        Spread(
            _column(np.zeros(count)),
            {"aerial.target_sigma_px": _column(np.ones(count)), "aerial.own_sigma": _column(side**2)},
        ),
        np.asarray(true_m, float).reshape(-1, 2),
        surface,
    )


def fit_ground(view: AerialView, parameters: dict[str, Tensor]) -> GroundFit | None:
    """The hard fit with these parameters; None where no pose shows the landmarks, or a ray does not meet the ground."""
    n = len(view.marks)
    prior, sigma_m, pixel_sigma = _expect(view, parameters)
    marks = replace(view.marks, sigma_m=sigma_m, pixel_sigma=pixel_sigma)
    expected = independent_expectation(prior, sigma_m)
    solution = find_pose(marks, view.camera, expected)
    if solution is None:
        return None
    here = linearize_pose(marks, view.camera, expected, solution.pose, solution.places)
    if here is None:
        return None
    place, by_pose, by_pixel = ground_with_slopes(solution.pose, view.camera, view.targets_px, view.up_m, view.surface)
    if not all(np.isfinite(found).all() for found in (place, by_pose, by_pixel)):
        return None
    by_turn = np.eye(7 + 2 * n)
    by_turn[:3, :3] = here.by_turn
    known = np.concatenate([view.known, np.ones(2 * n)])
    problem = Linear(*(_column(part) for part in (here.missing, here.slopes, here.correction, by_turn, known)))
    return GroundFit(problem, _column(place - view.true_m), _column(by_pose), _column(by_pixel))


def is_only_noise(view: AerialView, parameters: dict[str, Tensor], probability: float) -> bool:
    """Whether landmarks and telemetry agree, with errors up to NO_NOISE times as large as expected."""
    prior, sigma_m, pixel_sigma = _expect(view, parameters)
    wide = Prior(prior.pose, prior.information / NO_NOISE**2)
    marks = replace(view.marks, sigma_m=NO_NOISE * sigma_m, pixel_sigma=NO_NOISE * pixel_sigma)
    return passes(find_pose(marks, view.camera, independent_expectation(wide, marks.sigma_m)), probability)


def aerial_losses(views: Sequence[AerialView], parameters: dict[str, Tensor], here: Sequence[GroundFit]) -> Tensor:
    """(B,) nats a target, of views with equal numbers of landmarks and targets."""
    parts = ("missing", "slopes", "correction", "by_turn", "known")
    problem = Linear(*(torch.stack([getattr(one.problem, part) for one in here]) for part in parts))
    places = stack_spreads([view.places for view in views]).variance(parameters).clamp(min=EXACT_M**2)
    pixels = stack_spreads([view.pixels for view in views]).variance(parameters)
    prior = stack_spreads([view.prior for view in views]).variance(parameters)
    variance = torch.cat([prior, places.repeat_interleave(2, dim=1)], dim=1)
    step, covariance = gauss_newton_step(problem, pixels.repeat_interleave(2, dim=1), variance)
    off_m, by_pose, by_pixel = (
        torch.stack([getattr(one, part) for one in here]) for part in ("off_m", "by_pose", "by_pixel")
    )
    spot = stack_spreads([view.spot for view in views]).variance(parameters)
    off_m, spread = project_to_ground(off_m, by_pose, by_pixel, step, covariance, spot)
    shared = parameters["landmarks.common_sigma_m"] ** 2 * torch.eye(2, dtype=spread.dtype)
    return gaussian_nll(off_m, spread + shared).mean(dim=1)


def gauss_newton_step(
    problem: Linear, pixel_variance: Float[Tensor, "B 2m"], variance: Float[Tensor, "B S"]
) -> tuple[Float[Tensor, "B 7"], Float[Tensor, "B 7 7"]]:
    """The next step of the pose, which is zero at the solution but has a derivative, and the covariance of the pose.

    pixel_variance: px², of the landmarks' pixels. variance: of telemetry and reports.
    """
    # The normal equations of `find_pose`, which are in NumPy, of one problem, with a full information matrix; here they
    # are of a batch, with a diagonal one that has a gradient. Tests compare loss and gradient with the hard fit.
    information = problem.known / variance.clamp(min=1e-12)
    weighed = problem.slopes.mT / pixel_variance[:, None]
    pulled = problem.by_turn.mT * information[:, None]
    curvature = weighed @ problem.slopes + pulled @ problem.by_turn
    downhill = weighed @ problem.missing[..., None] - pulled @ problem.correction[..., None]
    # Radians beside hundreds of metres: scaling to a diagonal of ones keeps the digits of the inverse.
    scale = curvature.diagonal(dim1=1, dim2=2).detach().rsqrt()
    inverse = torch.linalg.inv(curvature * scale[:, :, None] * scale[:, None]) * scale[:, :, None] * scale[:, None]
    return (inverse @ downhill)[:, :7, 0], inverse[:, :7, :7]


def project_to_ground(
    off_m: Float[Tensor, "B T 2"],
    by_pose: Float[Tensor, "B T 2 7"],
    by_pixel: Float[Tensor, "B T 2 2"],
    step: Float[Tensor, "B 7"],
    covariance: Float[Tensor, "B 7 7"],
    pixel_variance: Float[Tensor, "B T"],
) -> tuple[Float[Tensor, "B T 2"], Float[Tensor, "B T 2 2"]]:
    """Errors of the targets after a step of the pose, and their covariance. by_*: from `ground_with_slopes`."""
    moved = off_m + (by_pose @ step[:, None, :, None])[..., 0]
    spread = by_pose @ covariance[:, None] @ by_pose.mT
    return moved, spread + pixel_variance[..., None, None] * by_pixel @ by_pixel.mT


def gaussian_nll(off_m: Float[Tensor, "... 2"], covariance_m2: Float[Tensor, "... 2 2"]) -> Float[Tensor, "..."]:
    """Negative log-likelihood of errors under their covariances, in nats; NaN where one is not positive definite."""
    (a, b), (_, c) = (row.unbind(-1) for row in covariance_m2.unbind(-2))
    x, y = off_m.unbind(-1)
    size = a * c - b * b
    return ((c * x * x - 2 * b * x * y + a * y * y) / size + size.log()) / 2 + math.log(2 * math.pi)


def stack_spreads(parts: Sequence[Spread]) -> Spread:
    """Spreads of equal length and parameters as one batch."""
    gain = {name: torch.stack([part.gain[name] for part in parts]) for name in parts[0].gain}
    return Spread(torch.stack([part.base for part in parts]), gain)


def _expect(view: AerialView, parameters: dict[str, Tensor]) -> tuple[Prior, np.ndarray, np.ndarray]:
    """The prior under these parameters, and standard deviations of the landmarks' positions and pixels."""
    with torch.no_grad():
        variance = view.prior.variance(parameters).numpy()
        sigma_m = view.places.variance(parameters).clamp(min=EXACT_M**2).sqrt().numpy()
        pixel_sigma = view.pixels.variance(parameters).sqrt().numpy()
    return Prior(view.reference, np.diag(view.known / np.maximum(variance, _FLOOR))), sigma_m, pixel_sigma


def _prior(flight: Flight | None, camera: Camera, parameters: AerialParameters, focal_known: bool) -> Prior:
    return pose_prior(flight, camera, parameters, focal_known=focal_known) or focal_prior(
        camera, parameters, focal_known
    )


def _spread_of(flight: Flight | None, camera: Camera, focal_known: bool) -> Spread:
    """The part of each parameter in the variances of the prior."""

    def variance(**parameters: float) -> np.ndarray:
        prior = _prior(
            flight, camera, AerialParameters().model_copy(update=dict.fromkeys(PRIOR, 0.0) | parameters), focal_known
        )
        return np.where(prior.known, 1 / np.maximum(np.diag(prior.information), 1e-300), 0.0)

    base = variance()
    gain = {f"aerial.{name}": np.maximum(variance(**{name: 1.0}) - base, 0.0) for name in PRIOR}
    base = np.where(base <= 2 * _FLOOR, 0.0, base)
    return Spread(_column(base), {name: _column(np.where(part < 1e-9, 0.0, part)) for name, part in gain.items()})


def _column(array: np.ndarray) -> Tensor:
    return torch.as_tensor(np.asarray(array, float))


def default_values(settings: Settings) -> dict[str, Tensor]:
    """The values of SPREADS under some settings."""
    return {name: torch.tensor(value_of(settings, name), dtype=torch.float64) for name in SPREADS}
