"""The family of places: how surprising position errors are under their error ellipses."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchvision_dddas.config import AerialParameters, LandmarkParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.record import Task
from torchvision_dddas.geo.ground_rays import met_with_slopes
from torchvision_dddas.geo.initial_pose import find_pose
from torchvision_dddas.geo.landmark_faults import passes
from torchvision_dddas.geo.pose_estimation import EXACT_M, Prior, bare_prior, expected_of, prior_of, slopes_at
from torchvision_dddas.geo.terrain_intersection import Surface
from torchvision_dddas.tuning.family import Example, Tick
from torchvision_dddas.tuning.place_examples import looks_of, person_lost, sightings_of
from torchvision_dddas.types import Camera, CameraPose, Flight, LandmarkObservations

UNPLACED = 25.0
"""Nats that a picture costs which no pose of the camera explains, or whose rays miss the ground: no slope, no NaN."""


@dataclass(frozen=True)
class Places:
    """The family `location`."""

    name: str = "location"
    task: Task = "location"
    measure: str = "location.metres.mean_m"
    softness: tuple[float, float] = (1.0, 1.0)
    """Without effect: nothing here is hard."""

    def examples(self, clips: Sequence[Clip], settings: Settings, tick: Tick = lambda: None) -> list[Example]:
        """Looks from the air of clips with landmarks, sightings of those with a camera on the ground alone.

        See `family.Family`.
        """
        found: list[Example] = []
        for clip in clips:
            mine = sightings_of(clip, settings) if clip.landmarks is None else looks_of(clip, settings)
            before = len(found)
            for example in mine:
                found.append(example)
                tick()
            if len(found) == before:
                raise InputError(f"{clip.name}: no target was located whose true place is known; nothing can be tuned")
        return found

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """(B,) nats a target. See `family.Family`.

        Computed on the CPU, where the fits are, whatever the knobs' device.
        """
        device = next(iter(parameters.values())).device if parameters else torch.device("cpu")
        parameters = {name: value.cpu() for name, value in parameters.items()}
        found: list[Tensor] = [torch.zeros(0)] * len(batch)
        groups: dict[tuple[int, int], list[tuple[int, Look, dict[str, Tensor], GroundFit]]] = defaultdict(list)
        for row, example in enumerate(batch):
            if not isinstance(example.content, Seen):
                seen, settings = example.content
                found[row] = person_lost(seen, settings, parameters, UNPLACED)
                continue
            look = example.content.look
            values = {**of_settings(example.content.settings), **parameters}
            here = example.content.fit or fit_ground(look, values)
            if here is None:
                found[row] = torch.full((), UNPLACED, dtype=torch.float64) + 0 * sum(parameters.values())
            else:
                groups[len(look.marks), len(look.true_m)].append((row, look, values, here))
        for members in groups.values():
            lost = _lost([look for _, look, _, _ in members], members[0][2], [here for *_, here in members])
            for (row, *_), value in zip(members, lost, strict=True):
                found[row] = value
        return torch.stack(found).to(device)


def family() -> Places:
    """See `family.family_of`."""
    return Places()


def _lost(looks: Sequence[Look], parameters: dict[str, Tensor], here: Sequence[GroundFit]) -> Tensor:
    """(B,) of looks with as many landmarks and targets each."""
    parts = ("missing", "slopes", "correction", "by_turn", "known")
    problem = Linear(*(torch.stack([getattr(one.problem, part) for one in here]) for part in parts))
    places = joined([look.places for look in looks]).variance(parameters).clamp(min=EXACT_M**2)
    pixels = joined([look.pixels for look in looks]).variance(parameters)
    prior = joined([look.prior for look in looks]).variance(parameters)
    variance = torch.cat([prior, places.repeat_interleave(2, dim=1)], dim=1)
    step, covariance = gauss_newton_step(problem, pixels.repeat_interleave(2, dim=1), variance)
    off_m, by_pose, by_pixel = (
        torch.stack([getattr(one, part) for one in here]) for part in ("off_m", "by_pose", "by_pixel")
    )
    spot = joined([look.spot for look in looks]).variance(parameters)
    off_m, spread = project_to_ground(off_m, by_pose, by_pixel, step, covariance, spot)
    shared = parameters["landmarks.common_sigma_m"] ** 2 * torch.eye(2, dtype=spread.dtype)
    return gaussian_nll(off_m, spread + shared).mean(dim=1)


Parameters = Mapping[str, Tensor]


@dataclass(frozen=True)
class Spread:
    """Variances (..., N) that are base + sum of gain x knob². gain: by knob's name, each as base."""

    base: Tensor
    gain: Mapping[str, Tensor] = field(default_factory=dict)

    def variance(self, parameters: Parameters) -> Tensor:
        """(..., N). parameters: all that there is a gain of."""
        total = self.base
        for name, gain in self.gain.items():
            total = total + gain * parameters[name].to(gain) ** 2
        return total


@dataclass(frozen=True)
class Linear:
    """The least squares of poses and landmarks' places about the hard solutions of B pictures of m landmarks each.

    missing: (B, 2m) px. slopes: (B, 2m, S) of the pixels by the S = 7 + 2n numbers of pose and places. correction:
    (B, S) of telemetry and reports. by_turn: (B, S, S) how that grows with a step. known: (B, S) of which of them
    something is expected, 0 or 1. As `targets.pose.Slopes`.
    """

    missing: Tensor
    slopes: Tensor
    correction: Tensor
    by_turn: Tensor
    known: Tensor


def gauss_newton_step(
    problem: Linear, pixel_variance: Float[Tensor, "B 2m"], variance: Float[Tensor, "B S"]
) -> tuple[Float[Tensor, "B 7"], Float[Tensor, "B 7 7"]]:
    """The pose's next step, zero at the solution but not its derivative, and the pose's covariance.

    pixel_variance: px², of the landmarks' pixels. variance: of what telemetry and reports say, in the units of Fix.
    """
    # The normal equations of `fit_pose`, which this cannot share: there they are of one problem at a time, in NumPy for
    # the onboard install, with an information matrix that is full once frames are remembered; here of a batch, with a
    # diagonal one that has a gradient. The tests of `tuning.places` hold loss and slope to those of the hard fit.
    information = problem.known / variance.clamp(min=1e-12)
    weighed = problem.slopes.mT / pixel_variance[:, None]
    pulled = problem.by_turn.mT * information[:, None]
    curvature = weighed @ problem.slopes + pulled @ problem.by_turn
    downhill = weighed @ problem.missing[..., None] - pulled @ problem.correction[..., None]
    # Radians beside hundreds of metres: brought to a diagonal of ones, the inverse keeps its digits.
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
    """Errors of targets' places after the pose's step, and their covariance; by_*: `targets.ground_rays`."""
    moved = off_m + (by_pose @ step[:, None, :, None])[..., 0]
    spread = by_pose @ covariance[:, None] @ by_pose.mT
    return moved, spread + pixel_variance[..., None, None] * by_pixel @ by_pixel.mT


def gaussian_nll(off_m: Float[Tensor, "... 2"], covariance_m2: Float[Tensor, "... 2 2"]) -> Float[Tensor, "..."]:
    """Negative log-likelihood of errors under their ellipses, in nats: least where these are as large as the errors.

    Written out for two by two. A covariance that is none, flat or turned over, gives NaN.
    """
    (a, b), (_, c) = (row.unbind(-1) for row in covariance_m2.unbind(-2))
    x, y = off_m.unbind(-1)
    size = a * c - b * b
    return ((c * x * x - 2 * b * x * y + a * y * y) / size + size.log()) / 2 + math.log(2 * math.pi)


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
"""Knobs of the group `aerial` that say how well telemetry is known."""

NO_NOISE = 3.0
"""Landmarks that would not fit were all errors so many times as large are not where they are said to be: an identity
swapped, a place far off. No noise level explains them, and none is learned from them."""

_FLOOR = 1e-12  # of a variance: `prior_of` takes no standard deviation below 1e-6


@dataclass(frozen=True)
class Look:
    """One picture. Metres are local, in one frame of reference.

    reference: what telemetry says of the pose, with known: (7,) of which something is. prior: variances (7,) of that.
    marks: n landmarks, all with pixel and place; places: variances (n,) m² of those, pixels: (n,) px² of the pixels.
    targets_px: (T, 2), up_m: (T,) how high above the ground that is; spot: variances (T,) px² of it. true_m: (T, 2).
    surface: the ground, if not flat.
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
    """A look at the likeliest pose under some variances, with what `modules.places` goes on from."""

    problem: Linear
    off_m: torch.Tensor
    by_pose: torch.Tensor
    by_pixel: torch.Tensor


@dataclass(frozen=True)
class Seen:
    """A look as an example has it: what its loss is taken from. settings: with what it was prepared.

    fit: to go on from in place of a hard fit with the parameters of the moment (see `kept`); None: fit anew each time.
    """

    look: Look
    settings: Settings
    fit: GroundFit | None = None


def kept(seen: Seen) -> Seen | None:
    """The same with its fit at the settings kept: some hundred times as quick, and right to first order about these.

    None where no pose shows the landmarks.
    """
    fit = fit_ground(seen.look, of_settings(seen.settings))
    return None if fit is None else Seen(seen.look, seen.settings, fit)


def look_at(
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
) -> Look:
    """A look whose parameters count for the rest.

    marks: with the standard deviations of the settings. own: (n,) bool, which landmarks' reports do not say how well
    they are known, so that landmarks.sigma_m counts. side_px: (T,) of the boxes that aerial.own_sigma counts for.
    """
    aerial, landmarks = settings.aerial, settings.landmarks
    of_parameters = _prior(flight, camera, aerial, focal_known)
    share = landmarks.sigma_m**2
    told = marks.sigma_m**2 - np.where(own, share, 0.0)
    count = len(targets_px)
    side = np.zeros(count) if side_px is None else side_px
    return Look(
        camera,
        of_parameters.pose,
        of_parameters.known,
        _spread_of(flight, camera, focal_known),
        marks,
        Spread(_column(np.maximum(told, 0)), {"landmarks.sigma_m": _column(own)}),
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


def fit_ground(look: Look, parameters: dict[str, torch.Tensor]) -> GroundFit | None:
    """The hard fit with these knobs, detached; None where no pose shows the landmarks, or a ray meets no ground."""
    n = len(look.marks)
    prior, sigma_m, pixel_sigma = _hard(look, parameters)
    marks = LandmarkObservations(
        look.marks.landmark,
        look.marks.image_px,
        look.marks.east_north_m,
        sigma_m,
        pixel_sigma,
        look.marks.up_m,
    )
    expected = expected_of(prior, sigma_m)
    solution = find_pose(marks, look.camera, expected)
    if solution is None:
        return None
    here = slopes_at(marks, look.camera, expected, solution.pose, solution.places)
    if here is None:
        return None
    place, by_pose, by_pixel = met_with_slopes(solution.pose, look.camera, look.targets_px, look.up_m, look.surface)
    if not all(np.isfinite(found).all() for found in (place, by_pose, by_pixel)):
        return None
    by_turn = np.eye(7 + 2 * n)
    by_turn[:3, :3] = here.by_turn
    known = np.concatenate([look.known, np.ones(2 * n)])
    problem = Linear(*(_column(part) for part in (here.missing, here.slopes, here.correction, by_turn, known)))
    return GroundFit(problem, _column(place - look.true_m), _column(by_pose), _column(by_pixel))


def only_noise(look: Look, parameters: dict[str, torch.Tensor], probability: float) -> bool:
    """Whether landmarks and telemetry agree, if not by what is said of their errors then by NO_NOISE times as much."""
    prior, sigma_m, pixel_sigma = _hard(look, parameters)
    wide = Prior(prior.pose, prior.information / NO_NOISE**2)
    marks = LandmarkObservations(
        look.marks.landmark,
        look.marks.image_px,
        look.marks.east_north_m,
        NO_NOISE * sigma_m,
        NO_NOISE * pixel_sigma,
        look.marks.up_m,
    )
    return passes(find_pose(marks, look.camera, expected_of(wide, marks.sigma_m)), probability)


def joined(parts: Sequence[Spread]) -> Spread:
    """Spreads of equal length and parameters, one above the other."""
    gain = {name: torch.stack([part.gain[name] for part in parts]) for name in parts[0].gain}
    return Spread(torch.stack([part.base for part in parts]), gain)


def _hard(look: Look, parameters: dict[str, torch.Tensor]) -> tuple[Prior, np.ndarray, np.ndarray]:
    """What is expected under these parameters: the prior, and standard deviations of landmarks' places and pixels."""
    with torch.no_grad():
        variance = look.prior.variance(parameters).numpy()
        sigma_m = look.places.variance(parameters).clamp(min=EXACT_M**2).sqrt().numpy()
        pixel_sigma = look.pixels.variance(parameters).sqrt().numpy()
    return Prior(look.reference, np.diag(look.known / np.maximum(variance, _FLOOR))), sigma_m, pixel_sigma


def _prior(flight: Flight | None, camera: Camera, parameters: AerialParameters, focal_known: bool) -> Prior:
    return prior_of(flight, camera, parameters, focal_known=focal_known) or bare_prior(camera, parameters, focal_known)


def _spread_of(flight: Flight | None, camera: Camera, focal_known: bool) -> Spread:
    """What each parameter adds to the variances of the prior."""

    def variance(**parameters: float) -> np.ndarray:
        prior = _prior(
            flight, camera, AerialParameters().model_copy(update=dict.fromkeys(PRIOR, 0.0) | parameters), focal_known
        )
        return np.where(prior.known, 1 / np.maximum(np.diag(prior.information), 1e-300), 0.0)

    base = variance()
    gain = {f"aerial.{name}": np.maximum(variance(**{name: 1.0}) - base, 0.0) for name in PRIOR}
    base = np.where(base <= 2 * _FLOOR, 0.0, base)
    return Spread(_column(base), {name: _column(np.where(part < 1e-9, 0.0, part)) for name, part in gain.items()})


def _column(array: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(np.asarray(array, float))


SPREADS = (
    *(f"aerial.{name}" for name in PRIOR),
    "aerial.target_sigma_px",
    "aerial.own_sigma",
    "landmarks.pixel_sigma",
    "landmarks.sigma_m",
    "landmarks.common_sigma_m",
)
"""All parameters that have a say in where ellipses from the air lie and how large they are."""


def of_settings(settings: Settings) -> dict[str, torch.Tensor]:
    """The values of SPREADS."""
    groups: dict[str, AerialParameters | LandmarkParameters] = {
        "aerial": settings.aerial,
        "landmarks": settings.landmarks,
    }
    values = {}
    for name in SPREADS:
        group, _, parameter = name.partition(".")
        values[name] = torch.tensor(float(getattr(groups[group], parameter)), dtype=torch.float64)
    return values
