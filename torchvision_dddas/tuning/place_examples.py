"""Examples of places from clips: from the air along pictures or tables, and from the ground."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.truth import Positions, Truth
from torchvision_dddas.evaluation.studies.placing_score import whose_places
from torchvision_dddas.geo import Locator, Targets
from torchvision_dddas.geo.elevation import surface
from torchvision_dddas.geo.landmark_trajectories import Courses
from torchvision_dddas.geo.ranging import sight
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.tuning.places import Seen, gaussian_nll, look_at, of_settings, only_noise
from torchvision_dddas.types import AerialLocations, Camera, Poses

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
    probes: dict[int, tuple[Courses, float]] = {}
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
    locator: Locator,
    grounded: AerialLocations,
    targets: Targets,
    probe: Courses,
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
    pixels, lift = locator.points(grounded.fix, targets)
    kept = row[known]
    box = targets.box_px[kept]
    side = np.sqrt(np.maximum(box[:, 2] * box[:, 3], 0)) if targets.bodies else np.zeros(len(kept))
    reports = probe.at(grounded.frame)
    wider = dict(zip(reports.landmark.tolist(), reports.sigma_m.tolist(), strict=True))
    more = np.array([wider[k] for k in marks.landmark.tolist()]) ** 2 - marks.sigma_m**2
    marks = replace(marks, **{name: column[usable] for name, column in vars(marks).items()})
    look = look_at(
        locator.camera,
        locator.flight(grounded.time_s),
        marks,
        pixels[kept],
        true_m[whose[known]],
        settings,
        np.maximum(more[usable], 0) / added,
        lift[kept],
        side,
        locator.focal_known,
        None if locator.site.elevation is None else surface(locator.site.elevation),
    )
    if not only_noise(look, of_settings(settings), settings.aerial.gate_probability):
        return None
    return Example(clip.name, grounded.frame, Seen(look, settings))


def _probe(locator: Locator) -> tuple[Courses, float]:
    """The landmarks' courses with another landmarks.sigma_m, and by how much its square is more."""
    parameters = locator.settings.landmarks
    wider = max(PROBE * parameters.sigma_m, 1.0)
    other = parameters.model_copy(update={"sigma_m": wider})
    return Courses(locator.site.landmarks, other, locator.rate_hz), wider**2 - parameters.sigma_m**2


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


def _along(clip: Clip, settings: Settings, backend: str) -> Iterator[tuple[Locator, AerialLocations, Targets]]:
    from torchvision_dddas.evaluation.studies.stages import opened
    from torchvision_dddas.io.run_inputs import prepare_run
    from torchvision_dddas.pipeline import survey

    source = opened(clip)
    ready = prepare_run(_given(clip), clip.telemetry, settings, source, backend, str(clip.pictures[0]))
    assert ready.watch is not None, "there are landmarks"
    for surveyed in survey(source, ready.engine, ready.settings, ready.flight, ready.watch, pictures=False):
        grounded = surveyed.grounded
        if grounded is not None:
            count = len(grounded.box_px)
            none = np.zeros(count, bool)
            targets = Targets(grounded.box_px, np.arange(count), none, np.ones(count), bodies=True)
            yield ready.watch.locator, grounded, targets


def _of_table(clip: Clip, settings: Settings, backend: str) -> Iterator[tuple[Locator, AerialLocations, Targets]]:
    from torchvision_dddas.geo import check_table, locate
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
    for grounded in locate(table, locator):
        rows = table.rows(grounded.frame)
        count = len(grounded.box_px)
        feet = None if table.feet_px is None else table.feet_px[rows]
        none = np.zeros(count, bool)
        yield locator, grounded, Targets(grounded.box_px, np.arange(count), none, np.ones(count), feet, table.ours)


KNOBS = ("ground.body_height_sigma_m", "ground.height_sigma", "ground.feet_sigma")

_STEP = 1e-4
"""Of a difference, as a share of the parameter, or of the least that counts."""

_LEAST = 1e-3


@dataclass(frozen=True)
class Sighted:
    """People whom one camera saw in a picture. box_px: (N, 4). cut: (N,). true_m: (N, 2) in the camera's metres."""

    camera: Camera
    box_px: np.ndarray
    cut: np.ndarray
    poses: Poses
    here_m: np.ndarray
    true_m: np.ndarray


def sightings_of(clip: Clip, settings: Settings) -> Iterator[Example]:
    """Those of a clip with a camera on the ground and detections, frame by frame; metres alone.

    Raises InputError where the clip lacks them or true places, and for ground.mode = paper, which knows no errors.
    """
    from torchvision_dddas.geo.ground_locator import survey
    from torchvision_dddas.io.camera_files import read_camera
    from torchvision_dddas.io.detection_tables import read_detections

    truth = clip.truth
    if truth is None or truth.positions is None:
        raise InputError(f"{clip.name} has no true places; ellipses cannot be tuned on it. Give clips with positions")
    if settings.ground.mode == "paper":
        raise InputError("ground.mode = paper knows no errors that could be tuned; take ground.mode = default")
    if clip.given is None or clip.camera is None:
        raise InputError(f"{clip.place} has no detections and camera: locating from the ground needs both")
    camera = read_camera(clip.camera)
    if camera.geographic:
        raise InputError(f"{clip.name}: the camera stands at degrees; wanted local metres, as the true places are")
    table = read_detections(clip.given)
    found = survey([table], [camera], [None], settings, clip.rate_hz)
    (view,) = found.views
    places = truth.positions
    whose, _ = whose_places(truth, places, places.east_north_m, table.frame, table.box_px, view.sightings.east_north_m)
    whose = np.where(np.isfinite(view.sightings.east_north_m).all(axis=1), whose, -1)
    for frame in np.unique(table.frame).tolist():
        rows = np.flatnonzero((table.frame == frame) & (whose >= 0))
        if len(rows):
            true_m = places.east_north_m[whose[rows]]
            yield Example(clip.name, frame, (sighted(camera, table.box_px[rows], view.cut[rows], true_m), settings))


def sighted(camera: Camera, box_px: np.ndarray, cut: np.ndarray, true_m: np.ndarray) -> Sighted:
    """People in a picture of a camera that stands still."""
    n = len(box_px)
    place = np.tile(camera.place, (n, 1))
    poses = Poses(place, np.full(n, camera.heading_rad), np.full(n, camera.pitch_rad))
    return Sighted(camera, box_px, cut, poses, place, true_m)


def person_lost(seen: Sighted, settings: Settings, parameters: Mapping[str, Tensor], unplaced: float) -> Tensor:
    """() nats a person; those whom the parameters leave without a place cost `unplaced`, without a slope."""
    values = {name: parameters[name] for name in KNOBS if name in parameters}

    def hard(*given: float) -> np.ndarray:
        changed = dict(zip((name.partition(".")[2] for name in values), given, strict=True))
        found = sight(
            seen.box_px, seen.cut, seen.camera, seen.poses, seen.here_m, settings.ground.model_copy(update=changed)
        )
        off = found.east_north_m - seen.true_m
        return np.concatenate([off, found.covariance_m2.reshape(-1, 4)], axis=1)

    rows: Tensor = _ByDifferences.apply(hard, *values.values())
    known = torch.isfinite(rows).all(dim=1)
    told = rows[known]
    total = gaussian_nll(told[:, :2], told[:, 2:].reshape(-1, 2, 2)).sum() + unplaced * (~known).sum()
    return total / len(rows)


class _ByDifferences(torch.autograd.Function):
    """A function of numbers in NumPy, with the slope of its central differences."""

    @staticmethod
    def forward(ctx: Any, hard: Callable[..., np.ndarray], *values: Tensor) -> Tensor:
        at = [float(value) for value in values]
        slopes = []
        for k in range(len(values)):
            step = _STEP * max(abs(at[k]), _LEAST)
            if ctx.needs_input_grad[k + 1]:
                more, less = (hard(*at[:k], at[k] + side, *at[k + 1 :]) for side in (step, -step))
                slope = np.nan_to_num((more - less) / (2 * step), posinf=0.0, neginf=0.0)
            else:
                slope = np.zeros(0)
            slopes.append(torch.as_tensor(slope))
        ctx.slopes, ctx.kinds = slopes, [(value.dtype, value.device) for value in values]
        return torch.as_tensor(hard(*at))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:
        (grad,) = grads
        found: list[Any] = [None]
        for k, slope in enumerate(ctx.slopes):
            dtype, device = ctx.kinds[k]
            wanted = ctx.needs_input_grad[k + 1]
            found.append((grad * slope).sum().to(device=device, dtype=dtype) if wanted else None)
        return tuple(found)
