"""Positions of targets seen from the air as functions of the noise parameters, with gradients about the hard fit.

`geo.pose_estimation.find_pose` finds the likeliest pose and landmark positions. At that point one more Gauss-Newton
step is zero, and its derivative by the parameters is that of the fit itself, except for the curvature of the projection
where the picture disagrees with it. So positions have the value of the hard fit and the gradient of that step.

Every variance is a sum of squares of parameters.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchvision_dddas import geometry
from torchvision_dddas.config import AerialParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import (
    EXACT_M,
    AerialLocator,
    LandmarkTrajectories,
    Prior,
    Targets,
    find_pose,
    focal_prior,
    independent_expectation,
    linearize_pose,
    passes,
    pose_prior,
)
from torchvision_dddas.geometry import Surface, ground_with_slopes, surface_of
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.studies.scoring import whose_places
from torchvision_dddas.lab.evaluation.studies.stages import open_pipeline, open_table
from torchvision_dddas.lab.tuning.parameters import value_of
from torchvision_dddas.types import AerialLocations, Camera, CameraPose, Flight, LandmarkObservations

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

SPREADS = (
    *(f"aerial.{name}" for name in PRIOR),
    "aerial.target_sigma_px",
    "aerial.own_sigma",
    "landmarks.pixel_sigma",
    "landmarks.sigma_m",
    "landmarks.common_sigma_m",
)
"""All parameters that the ellipses of targets seen from the air depend on."""

NO_NOISE = 3.0
"""Landmarks that do not fit even with errors this many times as large have a wrong identity or position. No noise level
explains them, so that their frames are no examples."""

PROBE = 2.0
"""The share of landmarks.sigma_m in a variance is found from the variance at this many times the parameter."""

_FLOOR = 1e-12  # of a variance: `pose_prior` takes no standard deviation below 1e-6


@dataclass(frozen=True)
class AerialView:
    """One picture with n landmarks, all with pixel and position, and T targets. Metres are local, in one frame.

    reference: the pose by telemetry; known: (7,) which of its numbers are known. prior_base (7,), prior_gain (8, 7):
    their variances are the base and the sum of gain × parameter² over PRIOR. reported_m2, own: (n,) variances of the
    positions are reported_m2 + own × landmarks.sigma_m². targets_px: (T, 2); up_m: (T,) heights above the ground;
    side_px: (T,) of the boxes, for aerial.own_sigma. true_m: (T, 2). surface: the ground, if not flat.
    """

    camera: Camera
    marks: LandmarkObservations
    reference: CameraPose
    known: np.ndarray
    prior_base: Tensor
    prior_gain: Tensor
    reported_m2: Tensor
    own: Tensor
    targets_px: np.ndarray
    up_m: np.ndarray
    side_px: Tensor
    true_m: np.ndarray
    surface: Surface | None = None

    def variances(self, parameters: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Of the prior (7,), of the landmarks' positions (n,) m² and pixels (n,) px², and of the targets (T,) px²."""
        squares = torch.stack([parameters[f"aerial.{name}"] for name in PRIOR]).to(self.prior_gain) ** 2
        places = self.reported_m2 + self.own * parameters["landmarks.sigma_m"] ** 2
        pixels = parameters["landmarks.pixel_sigma"] ** 2 * torch.ones_like(places)
        targets = parameters["aerial.target_sigma_px"] ** 2 + self.side_px**2 * parameters["aerial.own_sigma"] ** 2
        return self.prior_base + squares @ self.prior_gain, places.clamp(min=EXACT_M**2), pixels, targets


def build_view(
    camera: Camera,
    flight: Flight | None,
    marks: LandmarkObservations,
    targets_px: np.ndarray,
    true_m: np.ndarray,
    settings: Settings,
    own: np.ndarray,
    up_m: np.ndarray,
    side_px: np.ndarray,
    focal_known: bool = True,
    surface: Surface | None = None,
) -> AerialView:
    """A view in which the variances depend on the parameters.

    marks: with the standard deviations of the settings. own: (n,) share of landmarks.sigma_m in their variance, 0 where
    a report gives its own standard deviation. The others: as in `AerialView`.
    """

    def prior(parameters: AerialParameters) -> Prior:
        by_telemetry = pose_prior(flight, camera, parameters, focal_known=focal_known)
        return by_telemetry or focal_prior(camera, parameters, focal_known)

    def variance(**parameters: float) -> np.ndarray:
        changed = prior(AerialParameters().model_copy(update=dict.fromkeys(PRIOR, 0.0) | parameters))
        return np.where(changed.known, 1 / np.maximum(np.diag(changed.information), 1e-300), 0.0)

    base = variance()
    gain = np.stack([np.maximum(variance(**{name: 1.0}) - base, 0.0) for name in PRIOR])
    reported_m2 = np.maximum(marks.sigma_m**2 - np.where(own, settings.landmarks.sigma_m**2, 0.0), 0)
    expected = prior(settings.aerial)
    return AerialView(
        camera,
        marks,
        expected.pose,
        expected.known,
        _tensor(np.where(base <= 2 * _FLOOR, 0.0, base)),
        _tensor(np.where(gain < 1e-9, 0.0, gain)),
        _tensor(reported_m2),
        _tensor(own),
        np.asarray(targets_px, float).reshape(-1, 2),
        up_m,
        _tensor(side_px),
        np.asarray(true_m, float).reshape(-1, 2),
        surface,
    )


class LinearFit(NamedTuple):
    """A view of n landmarks and T targets at its likeliest pose: the least squares there, and the targets' errors.

    missing: (2n,) px. slopes: (2n, S) of the pixels by the S = 7 + 2n numbers of pose and positions. correction: (S,)
    of telemetry and reports. by_turn: (S, S) its growth with a step. known: (S,), 1 where something is expected, else
    0. off_m: (T, 2); by_pose: (T, 2, 7); by_pixel: (T, 2, 2). As `linearize_pose` and `ground_with_slopes` return them.
    """

    missing: Tensor
    slopes: Tensor
    correction: Tensor
    by_turn: Tensor
    known: Tensor
    off_m: Tensor
    by_pose: Tensor
    by_pixel: Tensor


def fit_view(view: AerialView, parameters: Mapping[str, Tensor]) -> LinearFit | None:
    """The hard fit with these parameters; None where no pose shows the landmarks, or a ray does not meet the ground."""
    prior, marks = _expect(view, parameters)
    expected = independent_expectation(prior, marks.sigma_m)
    solution = find_pose(marks, view.camera, expected)
    if solution is None:
        return None
    here = linearize_pose(marks, view.camera, expected, solution.pose, solution.places)
    if here is None:
        return None
    place, by_pose, by_pixel = ground_with_slopes(solution.pose, view.camera, view.targets_px, view.up_m, view.surface)
    if not all(np.isfinite(found).all() for found in (place, by_pose, by_pixel)):
        return None
    by_turn = np.eye(7 + 2 * len(marks))
    by_turn[:3, :3] = here.by_turn
    known = np.concatenate([view.known, np.ones(2 * len(marks))])
    parts = here.missing, here.slopes, here.correction, by_turn, known, place - view.true_m, by_pose, by_pixel
    return LinearFit(*map(_tensor, parts))


def is_only_noise(view: AerialView, parameters: Mapping[str, Tensor], probability: float) -> bool:
    """Whether landmarks and telemetry agree, with errors up to NO_NOISE times as large as expected."""
    prior, marks = _expect(view, parameters)
    wide = Prior(prior.pose, prior.information / NO_NOISE**2)
    marks = replace(marks, sigma_m=NO_NOISE * marks.sigma_m, pixel_sigma=NO_NOISE * marks.pixel_sigma)
    return passes(find_pose(marks, view.camera, independent_expectation(wide, marks.sigma_m)), probability)


def _expect(view: AerialView, parameters: Mapping[str, Tensor]) -> tuple[Prior, LandmarkObservations]:
    """The prior and the landmarks with their standard deviations under these parameters."""
    with torch.no_grad():
        prior, places, pixels, _ = (variance.numpy() for variance in view.variances(parameters))
    information = np.diag(view.known / np.maximum(prior, _FLOOR))
    marks = replace(view.marks, sigma_m=np.sqrt(places), pixel_sigma=np.sqrt(pixels))
    return Prior(view.reference, information), marks


def aerial_losses(
    views: Sequence[AerialView], parameters: Mapping[str, Tensor], fits: Sequence[LinearFit]
) -> Float[Tensor, "B"]:
    """(B,) nats a target, of views with equal numbers of landmarks and targets."""
    fit = LinearFit(*(torch.stack(parts) for parts in zip(*fits, strict=True)))
    variances = zip(*(view.variances(parameters) for view in views), strict=True)
    prior, places, pixels, targets = (torch.stack(parts) for parts in variances)
    variance = torch.cat([prior, places.repeat_interleave(2, dim=1)], dim=1)
    step, covariance = gauss_newton_step(fit, pixels.repeat_interleave(2, dim=1), variance)
    off_m, spread = project_to_ground(fit, step, covariance, targets)
    shared = parameters["landmarks.common_sigma_m"] ** 2 * torch.eye(2, dtype=spread.dtype)
    return gaussian_nll(off_m, spread + shared).mean(dim=1)


def gauss_newton_step(
    fit: LinearFit, pixel_variance: Float[Tensor, "B 2n"], variance: Float[Tensor, "B S"]
) -> tuple[Float[Tensor, "B 7"], Float[Tensor, "B 7 7"]]:
    """The next step of the pose, which is zero at the solution but has a derivative, and the covariance of the pose.

    fit: of a batch. pixel_variance: px², of the landmarks' pixels. variance: of telemetry and reports.
    """
    # The normal equations of `find_pose`, which are in NumPy, of one problem, with a full information matrix; here they
    # are of a batch, with a diagonal one that has a gradient. Tests compare loss and gradient with the hard fit.
    information = fit.known / variance.clamp(min=1e-12)
    weighed = fit.slopes.mT / pixel_variance[:, None]
    pulled = fit.by_turn.mT * information[:, None]
    curvature = weighed @ fit.slopes + pulled @ fit.by_turn
    downhill = weighed @ fit.missing[..., None] - pulled @ fit.correction[..., None]
    # Radians beside hundreds of metres: scaling to a diagonal of ones keeps the digits of the inverse.
    scale = curvature.diagonal(dim1=1, dim2=2).detach().rsqrt()
    inverse = torch.linalg.inv(curvature * scale[:, :, None] * scale[:, None]) * scale[:, :, None] * scale[:, None]
    return (inverse @ downhill)[:, :7, 0], inverse[:, :7, :7]


def project_to_ground(
    fit: LinearFit, step: Float[Tensor, "B 7"], covariance: Float[Tensor, "B 7 7"], pixel_variance: Float[Tensor, "B T"]
) -> tuple[Float[Tensor, "B T 2"], Float[Tensor, "B T 2 2"]]:
    """Errors of the targets after a step of the pose, and their covariance."""
    moved = fit.off_m + (fit.by_pose @ step[:, None, :, None])[..., 0]
    spread = fit.by_pose @ covariance[:, None] @ fit.by_pose.mT
    return moved, spread + pixel_variance[..., None, None] * fit.by_pixel @ fit.by_pixel.mT


def gaussian_nll(off_m: Float[Tensor, "... 2"], covariance_m2: Float[Tensor, "... 2 2"]) -> Float[Tensor, "..."]:
    """Negative log-likelihood of errors under their covariances, in nats; NaN where one is not positive definite."""
    (a, b), (_, c) = (row.unbind(-1) for row in covariance_m2.unbind(-2))
    x, y = off_m.unbind(-1)
    size = a * c - b * b
    return ((c * x * x - 2 * b * x * y + a * y * y) / size + size.log()) / 2 + math.log(2 * math.pi)


def default_values(settings: Settings) -> dict[str, Tensor]:
    """The values of SPREADS under some settings."""
    return {name: torch.tensor(value_of(settings, name), dtype=torch.float64) for name in SPREADS}


def _tensor(array: np.ndarray) -> Tensor:
    return torch.as_tensor(np.asarray(array, float))


def aerial_examples(clip: Clip, settings: Settings) -> Iterator[tuple[int, AerialView]]:
    """The frames of a clip with a known true position, whose landmarks and telemetry agree within noise.

    Raises InputError where the true positions are in other units than its landmarks.
    """
    probe: LandmarkTrajectories | None = None
    for locator, located, targets in (_locate_pictures if clip.pictures else _locate_detections)(clip, settings):
        if probe is None:
            sigma_m = settings.landmarks.sigma_m
            wider_m = max(PROBE * sigma_m, 1.0)
            parameters = settings.landmarks.model_copy(update={"sigma_m": wider_m})
            probe = LandmarkTrajectories(locator.site.landmarks, parameters, locator.rate_hz)
        reports = probe.at(located.frame)
        wider = dict(zip(reports.landmark.tolist(), reports.sigma_m.tolist(), strict=True))
        more = np.array([wider[k] for k in located.marks.landmark.tolist()]) ** 2 - located.marks.sigma_m**2
        view = _located_view(clip, locator, located, targets, np.maximum(more, 0) / (wider_m**2 - sigma_m**2))
        if view is not None and is_only_noise(view, default_values(settings), settings.aerial.gate_probability):
            yield located.frame, view


def _located_view(
    clip: Clip, locator: AerialLocator, located: AerialLocations, targets: Targets, own: np.ndarray
) -> AerialView | None:
    """One frame; None where no true position is known. own: as in `build_view`, of all landmarks."""
    marks, row = located.marks, located.row
    if located.fix.pose is None or not len(row):
        return None
    truth = clip.truth
    assert truth is not None and truth.positions is not None
    places = truth.positions
    true_m = places.east_north_m
    if (origin := locator.site.origin_deg) is not None:
        if places.lonlat_deg is None:
            raise InputError(
                f"{clip.name}: the landmarks are in degrees and the true positions in metres only; give both in one "
                "unit"
            )
        true_m = geometry.east_north(places.lonlat_deg, origin)
    frame = np.full(len(row), located.frame)
    owner, _ = whose_places(truth, places, true_m, frame, located.box_px[row], located.positions.east_north_m)
    known = owner >= 0
    usable = np.isfinite(marks.image_px).all(axis=1) & np.isfinite(marks.east_north_m).all(axis=1)
    if not known.any() or not usable.any():
        return None
    pixels, lift = locator.target_points(located.fix, targets)
    kept = row[known]
    box = targets.box_px[kept]
    return build_view(
        locator.camera,
        locator.telemetry_at(located.time_s),
        replace(marks, **{name: column[usable] for name, column in vars(marks).items()}),
        pixels[kept],
        true_m[owner[known]],
        locator.settings,
        own[usable],
        lift[kept],
        np.sqrt(np.maximum(box[:, 2] * box[:, 3], 0)) if targets.bodies else np.zeros(len(kept)),
        locator.focal_known,
        surface_of(locator.site.elevation),
    )


def _locate_pictures(clip: Clip, settings: Settings) -> Iterator[tuple[AerialLocator, AerialLocations, Targets]]:
    source, ready, pipeline = open_pipeline(clip, settings)
    assert ready.watch is not None
    for result in pipeline(source):
        if result.locations is not None:
            yield ready.watch.locator, result.locations, _targets(result.locations.box_px, None, bodies=True)


def _locate_detections(clip: Clip, settings: Settings) -> Iterator[tuple[AerialLocator, AerialLocations, Targets]]:
    table, locator, _ = open_table(clip, settings)
    for located in locator.locate_table(table):
        feet_px = None if table.feet_px is None else table.feet_px[table.rows(located.frame)]
        yield locator, located, _targets(located.box_px, feet_px, table.ours)


def _targets(box_px: np.ndarray, feet_px: np.ndarray | None, bodies: bool) -> Targets:
    count = len(box_px)
    return Targets(box_px, np.arange(count), np.zeros(count, bool), np.ones(count), feet_px, bodies)
