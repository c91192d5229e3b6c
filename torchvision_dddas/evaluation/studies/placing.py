"""Places on the ground: by landmarks along the whole path, of a table by landmarks, or by a camera on the ground."""

from typing import TYPE_CHECKING

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.rows import Rows, Tick, written
from torchvision_dddas.types import AerialLocations, Positions

if TYPE_CHECKING:
    from torchvision_dddas.io.run_inputs import AerialInput


def location(clip: Clip, settings: Settings, backend: str, interval: int, tick: Tick) -> Rows:
    """`dddas run` where there are pictures and landmarks, else `dddas locate` of the data set's own detections."""
    if clip.landmarks is None:
        return _from_ground(clip, settings, tick)
    if clip.pictures:
        return _along(clip, settings, backend, interval, tick)
    return _of_table(clip, settings, backend, tick)


def _given(clip: Clip) -> "AerialInput":
    from torchvision_dddas.io.run_inputs import AerialInput

    assert clip.landmarks is not None, "location() asks for it"
    return AerialInput(clip.landmarks, clip.telemetry, clip.camera, clip.elevation, None, clip.colours)


def _along(clip: Clip, settings: Settings, backend: str, interval: int, tick: Tick) -> Rows:
    from torchvision_dddas.evaluation.studies.stages import opened
    from torchvision_dddas.io.run_inputs import prepare_run
    from torchvision_dddas.pipeline import survey

    source, rows = opened(clip), Rows()
    ready = prepare_run(_given(clip), clip.telemetry, settings, source, backend, str(clip.pictures[0]))
    for surveyed in survey(source, ready.engine, ready.settings, ready.flight, ready.watch, interval, pictures=False):
        tracks, grounded = surveyed.followed.tracks, surveyed.grounded
        seen = tracks.row >= 0
        box_px, identity, score = (column[seen] for column in (tracks.box_px, tracks.identity, tracks.score))
        seconds = surveyed.followed.seconds if grounded is None else grounded.seconds
        _add(rows, surveyed.followed.number, seconds, box_px, identity, score, grounded)
        tick()
    rows.notes += [*ready.notes, *map(str, source.problems)]
    return rows


def _of_table(clip: Clip, settings: Settings, backend: str, tick: Tick) -> Rows:
    from torchvision_dddas.geo import check_table
    from torchvision_dddas.io.detection_tables import read_detections
    from torchvision_dddas.io.run_inputs import read_locator

    if clip.given is None:
        raise InputError(f"{clip.place} has no pictures and no detections: there is nothing to locate")
    rows, table = Rows(), read_detections(clip.given)
    span = (table.first, table.last)
    locator, notes = read_locator(
        _given(clip), settings, None, clip.rate_hz, backend, span, "table", None, extent=table.extent
    )
    check_table(table, locator)
    for grounded in locator.locate_table(table):
        here = table.rows(grounded.frame)
        identity = np.full(here.stop - here.start, -1) if table.identity is None else table.identity[here]
        score = table.score[here].clip(0, 1)
        _add(rows, grounded.frame, grounded.seconds, grounded.box_px, identity, score, grounded)
        tick()
    rows.notes += notes
    return rows


def _from_ground(clip: Clip, settings: Settings, tick: Tick) -> Rows:
    from torchvision_dddas.geo.ground_locator import GroundLocator
    from torchvision_dddas.io.camera_files import read_camera
    from torchvision_dddas.io.detection_tables import read_detections

    if clip.given is None or clip.camera is None:
        raise InputError(f"{clip.place} has no detections and camera: locating from the ground needs both")
    rows, table = Rows(), read_detections(clip.given)
    for found in GroundLocator(read_camera(clip.camera), settings, rate_hz=clip.rate_hz).locate_tables([table]):
        count, here = len(found.box_px), found.sightings.by != "bearing"
        identity = np.full(count, -1) if table.identity is None else table.identity[table.rows(found.frame)]
        places = _placed(count, np.flatnonzero(here), found.positions)
        score = found.score.clip(0, 1)
        rows.add(found.frame, {}, box_px=written(found.box_px), score=score, identity=identity, **places)
        tick()
    return rows


def _add(
    rows: Rows,
    number: int,
    seconds: dict[str, float],
    box_px: np.ndarray,
    identity: np.ndarray,
    score: np.ndarray,
    grounded: AerialLocations | None,
) -> None:
    """A frame's targets, those that were located under the names that they have on the ground."""
    count = len(box_px)
    found = Positions() if grounded is None else grounded.positions
    row = np.zeros(0, np.int64) if grounded is None else grounded.row
    places, relative_m2 = _placed(count, row, found), np.full((count, 2, 2), np.nan)
    if grounded is not None:
        relative_m2[row] = grounded.relative_m2
    rows.add(number, seconds, box_px=written(box_px), score=score, identity=identity, relative_m2=relative_m2, **places)


def _placed(count: int, row: np.ndarray, found: Positions) -> dict[str, np.ndarray]:
    """The columns of places of a frame's boxes. row: which of them each position is of."""
    shapes = {"east_north_m": (2,), "covariance_m2": (2, 2), "lonlat_deg": (2,)}
    places = {name: np.full((count, *shape), np.nan) for name, shape in shapes.items()}
    places["east_north_m"][row], places["covariance_m2"][row] = found.east_north_m, found.covariance_m2
    if found.lonlat_deg is not None:
        places["lonlat_deg"][row] = found.lonlat_deg
    return places
