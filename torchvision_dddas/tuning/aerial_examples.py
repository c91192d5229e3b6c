"""Examples of targets seen from the air: landmarks, telemetry and targets whose true positions are known."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.truth import Positions, Truth
from torchvision_dddas.evaluation.studies.scoring import whose_places
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.geo import AerialLocator, Targets, check_table
from torchvision_dddas.geo.landmark_trajectories import LandmarkTrajectories
from torchvision_dddas.geo.projection import surface_of
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.io.run_inputs import AerialInput, prepare_run, read_locator
from torchvision_dddas.pipeline import Pipeline
from torchvision_dddas.tuning.aerial_location import AerialExample, build_view, default_values, is_only_noise
from torchvision_dddas.types import AerialLocations

PROBE = 2.0
"""The share of landmarks.sigma_m in a variance is found from the variance at this many times the parameter."""


def aerial_examples(clip: Clip, settings: Settings) -> Iterator[tuple[int, AerialExample]]:
    """The frames of a clip with landmarks in which the true position of a target is known.

    Raises InputError where the clip has no true positions, or they are in other units than its landmarks.
    """
    truth = clip.truth
    assert truth is not None and truth.positions is not None
    found = _locate_pictures(clip, settings) if clip.pictures else _locate_detections(clip, settings)
    probes: dict[int, tuple[LandmarkTrajectories, float]] = {}
    for locator, grounded, targets in found:
        if id(locator) not in probes:
            probes[id(locator)] = _probe(locator)
        example = _example(clip, truth, truth.positions, locator, grounded, targets, *probes[id(locator)])
        if example is not None:
            yield grounded.frame, example


def _example(
    clip: Clip,
    truth: Truth,
    places: Positions,
    locator: AerialLocator,
    grounded: AerialLocations,
    targets: Targets,
    probe: LandmarkTrajectories,
    added: float,
) -> AerialExample | None:
    """One frame; None where no true position is known, or its landmarks do not fit at any noise level."""
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
    view = build_view(
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
    if not is_only_noise(view, default_values(settings), settings.aerial.gate_probability):
        return None
    return AerialExample(view, settings)


def _probe(locator: AerialLocator) -> tuple[LandmarkTrajectories, float]:
    """The landmarks' trajectories with a larger landmarks.sigma_m, and the difference of its squares."""
    parameters = locator.settings.landmarks
    wider = max(PROBE * parameters.sigma_m, 1.0)
    other = parameters.model_copy(update={"sigma_m": wider})
    return LandmarkTrajectories(locator.site.landmarks, other, locator.rate_hz), wider**2 - parameters.sigma_m**2


def _true_m(clip: Clip, places: Positions, origin: tuple[float, float] | None) -> np.ndarray:
    """(P, 2) the true positions in the metres of the landmarks. Raises InputError for other units."""
    if origin is None:
        return places.east_north_m
    if places.lonlat_deg is None:
        raise InputError(
            f"{clip.name}: the landmarks are in degrees and the true positions in metres only; give both in one unit"
        )
    return geometry.east_north(places.lonlat_deg, origin)


def _input(clip: Clip) -> AerialInput:
    assert clip.landmarks is not None
    return AerialInput(clip.landmarks, clip.telemetry, clip.camera, clip.elevation, None, clip.colours)


def _locate_pictures(clip: Clip, settings: Settings) -> Iterator[tuple[AerialLocator, AerialLocations, Targets]]:
    source = open_clip(clip)
    ready = prepare_run(_input(clip), clip.telemetry, settings, source, "auto", str(clip.pictures[0]))
    assert ready.watch is not None
    pipeline = Pipeline.from_parts(ready.engine, ready.settings, ready.flight, ready.watch, pictures=False)
    for result in pipeline(source):
        grounded = result.locations
        if grounded is not None:
            count = len(grounded.box_px)
            none = np.zeros(count, bool)
            targets = Targets(grounded.box_px, np.arange(count), none, np.ones(count), bodies=True)
            yield ready.watch.locator, grounded, targets


def _locate_detections(clip: Clip, settings: Settings) -> Iterator[tuple[AerialLocator, AerialLocations, Targets]]:
    if clip.given is None:
        raise InputError(f"{clip.place} has no pictures and no detections: there is nothing to locate")
    table = read_detections(clip.given)
    span = (table.first, table.last)
    locator, _ = read_locator(
        _input(clip), settings, None, clip.rate_hz, "auto", span, "table", None, extent=table.extent
    )
    check_table(table, locator)
    for grounded in locator.locate_table(table):
        rows = table.rows(grounded.frame)
        count = len(grounded.box_px)
        feet = None if table.feet_px is None else table.feet_px[rows]
        none = np.zeros(count, bool)
        yield locator, grounded, Targets(grounded.box_px, np.arange(count), none, np.ones(count), feet, table.ours)
