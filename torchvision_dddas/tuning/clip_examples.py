"""What clips tell of places: looks from the air along their pictures or their tables, and sightings from the ground.

Landmarks, targets and fixes are found once, as `dddas run` and `dddas locate` find them; who a target is tells the
truth as the study's score does.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.truth import Positions, Truth
from torchvision_dddas.evaluation.studies.placing_score import whose_places
from torchvision_dddas.geo import Locator, Targets
from torchvision_dddas.geo.elevation import surface
from torchvision_dddas.geo.landmark_trajectories import Courses
from torchvision_dddas.tuning.aerial_examples import Seen, look_at, of_settings, only_noise
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.types import AerialLocations

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
