"""Examples of places seen from the air: landmarks, telemetry and targets whose places are known."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from torchvision_dddas import geometry
from torchvision_dddas.config import AerialParameters, LandmarkParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.truth import Positions, Truth
from torchvision_dddas.evaluation.studies.scoring import whose_places
from torchvision_dddas.geo import AerialLocator, Targets
from torchvision_dddas.geo.landmark_faults import passes
from torchvision_dddas.geo.landmark_trajectories import LandmarkTrajectories
from torchvision_dddas.geo.pose_estimation import (
    EXACT_M,
    Prior,
    find_pose,
    focal_prior,
    independent_expectation,
    linearize_pose,
    pose_prior,
)
from torchvision_dddas.geo.projection import ground_with_slopes
from torchvision_dddas.geo.terrain import Surface, surface_of
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.tuning.soft_places import Linear, Spread
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
    expected = independent_expectation(prior, sigma_m)
    solution = find_pose(marks, look.camera, expected)
    if solution is None:
        return None
    here = linearize_pose(marks, look.camera, expected, solution.pose, solution.places)
    if here is None:
        return None
    place, by_pose, by_pixel = ground_with_slopes(solution.pose, look.camera, look.targets_px, look.up_m, look.surface)
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
    return passes(find_pose(marks, look.camera, independent_expectation(wide, marks.sigma_m)), probability)


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
    return pose_prior(flight, camera, parameters, focal_known=focal_known) or focal_prior(
        camera, parameters, focal_known
    )


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


if TYPE_CHECKING:
    from torchvision_dddas.io.run_inputs import AerialInput
    from torchvision_dddas.types import DetectionTable

PROBE = 2.0
"""What landmarks.sigma_m adds to a variance is told by what the variance is at so many times the parameter."""


def looks_of(clip: Clip, settings: Settings, backend: str = "auto") -> Iterator[Example]:
    """The looks of a clip with landmarks, in the order of its frames; frames without a target of known place are none.

    Raises InputError where the clip has no true places, or they are not in the metres or degrees of its landmarks.
    """
    truth = clip.truth
    if truth is None or truth.positions is None:
        raise InputError(f"{clip.name} has no true places; ellipses cannot be tuned on it. Give clips with positions")
    found = _along(clip, settings, backend) if clip.pictures else _of_table(clip, settings, backend)
    probes: dict[int, tuple[LandmarkTrajectories, float]] = {}
    for locator, grounded, targets in found:
        if id(locator) not in probes:
            probes[id(locator)] = _probe(locator)
        example = _look(clip, truth, truth.positions, locator, grounded, targets, *probes[id(locator)])
        if example is not None:
            yield example


def _look(
    clip: Clip,
    truth: Truth,
    places: Positions,
    locator: AerialLocator,
    grounded: AerialLocations,
    targets: Targets,
    probe: LandmarkTrajectories,
    added: float,
) -> Example | None:
    """One frame; None where nothing of it is known to be true, or its landmarks are not where they are said to be."""
    settings, marks = locator.settings, grounded.marks
    row = grounded.row
    if grounded.fix.pose is None or not len(row):
        return None
    true_m = _true_m(clip, places, locator.site.origin_deg)
    here = places.frame == grounded.frame
    whose, _ = whose_places(
        truth, places, true_m, np.full(len(row), grounded.frame), grounded.box_px[row], grounded.positions.east_north_m
    )
    known = whose >= 0
    usable = np.isfinite(marks.image_px).all(axis=1) & np.isfinite(marks.east_north_m).all(axis=1)
    if not known.any() or not here.any() or not usable.any():
        return None
    pixels, lift = locator.target_points(grounded.fix, targets)
    kept = row[known]
    box = targets.box_px[kept]
    side = np.sqrt(np.maximum(box[:, 2] * box[:, 3], 0)) if targets.bodies else np.zeros(len(kept))
    reports = probe.at(grounded.frame)
    wider = dict(zip(reports.landmark.tolist(), reports.sigma_m.tolist(), strict=True))
    more = np.array([wider[k] for k in marks.landmark.tolist()]) ** 2 - marks.sigma_m**2
    marks = replace(marks, **{name: column[usable] for name, column in vars(marks).items()})
    look = look_at(
        locator.camera,
        locator.telemetry_at(grounded.time_s),
        marks,
        pixels[kept],
        true_m[whose[known]],
        settings,
        np.maximum(more[usable], 0) / added,
        lift[kept],
        side,
        locator.focal_known,
        surface_of(locator.site.elevation),
    )
    if not only_noise(look, of_settings(settings), settings.aerial.gate_probability):
        return None
    return Example(clip.name, grounded.frame, Seen(look, settings))


def _probe(locator: AerialLocator) -> tuple[LandmarkTrajectories, float]:
    """The landmarks' courses with another landmarks.sigma_m, and by how much its square is more."""
    parameters = locator.settings.landmarks
    wider = max(PROBE * parameters.sigma_m, 1.0)
    other = parameters.model_copy(update={"sigma_m": wider})
    return LandmarkTrajectories(locator.site.landmarks, other, locator.rate_hz), wider**2 - parameters.sigma_m**2


def _true_m(clip: Clip, places: Positions, origin: tuple[float, float] | None) -> np.ndarray:
    """(P, 2) the true places in the metres of the landmarks. Raises InputError where they are of another kind."""
    if origin is None:
        return places.east_north_m
    if places.lonlat_deg is None:
        raise InputError(
            f"{clip.name}: the landmarks are in degrees and the true places in metres alone; give both in one kind"
        )
    return geometry.east_north(places.lonlat_deg, origin)


def _given(clip: Clip) -> "AerialInput":
    from torchvision_dddas.io.run_inputs import AerialInput

    assert clip.landmarks is not None, "asked for clips with landmarks alone"
    return AerialInput(clip.landmarks, clip.telemetry, clip.camera, clip.elevation, None, clip.colours)


def _along(clip: Clip, settings: Settings, backend: str) -> Iterator[tuple[AerialLocator, AerialLocations, Targets]]:
    from torchvision_dddas.evaluation.studies.stages import open_clip
    from torchvision_dddas.io.run_inputs import prepare_run
    from torchvision_dddas.pipeline import Pipeline

    source = open_clip(clip)
    ready = prepare_run(_given(clip), clip.telemetry, settings, source, backend, str(clip.pictures[0]))
    assert ready.watch is not None, "there are landmarks"
    pipeline = Pipeline.from_parts(ready.engine, ready.settings, ready.flight, ready.watch, pictures=False)
    for surveyed in pipeline(source):
        grounded = surveyed.locations
        if grounded is not None:
            count = len(grounded.box_px)
            none = np.zeros(count, bool)
            targets = Targets(grounded.box_px, np.arange(count), none, np.ones(count), bodies=True)
            yield ready.watch.locator, grounded, targets


def _of_table(clip: Clip, settings: Settings, backend: str) -> Iterator[tuple[AerialLocator, AerialLocations, Targets]]:
    from torchvision_dddas.geo import check_table
    from torchvision_dddas.io.detection_tables import read_detections
    from torchvision_dddas.io.run_inputs import read_locator

    if clip.given is None:
        raise InputError(f"{clip.place} has no pictures and no detections: there is nothing to locate")
    table: DetectionTable = read_detections(clip.given)
    span = (table.first, table.last)
    locator, _ = read_locator(
        _given(clip), settings, None, clip.rate_hz, backend, span, "table", None, extent=table.extent
    )
    check_table(table, locator)
    for grounded in locator.locate_table(table):
        rows = table.rows(grounded.frame)
        count = len(grounded.box_px)
        feet = None if table.feet_px is None else table.feet_px[rows]
        none = np.zeros(count, bool)
        yield locator, grounded, Targets(grounded.box_px, np.arange(count), none, np.ones(count), feet, table.ours)
