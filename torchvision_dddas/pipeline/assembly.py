"""Assemble a run before the first picture: settings, engine, telemetry, camera, landmarks, elevation and colours.

`assemble` takes records, as given to `Pipeline`. `assemble_files` reads the files that `dddas run` takes beside
the pictures; `read_locator` reads those of `dddas locate`. `assemble_mission` closes the loop around a source that can
be steered. Commands, live runs, studies, the simulator and tuning all use these functions.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, is_set, with_parameters
from torchvision_dddas.control import Instrument, Mission, build_mission
from torchvision_dddas.detection import Engine, load_engine, with_logged_focal
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import (
    AerialLocator,
    LandmarkWatch,
    build_site,
    check_colours,
    complete_site,
    complete_telemetry,
    describe_no_place,
    describe_unknown_heights,
    has_places,
    load_solver,
    resolve_camera,
    to_local,
    without_pixels,
)
from torchvision_dddas.io.camera_files import read_aerial_camera
from torchvision_dddas.io.colour_files import read_colours
from torchvision_dddas.io.elevation import read_elevation, read_ortho
from torchvision_dddas.io.ground_tables import read_landmarks
from torchvision_dddas.io.images import read_ignored
from torchvision_dddas.io.joined_clips import JoinedSource
from torchvision_dddas.io.output import NONE_LOCATED, MapSite
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.types import Camera, Colours, Elevation, Landmarks, Scene, Source, Telemetry


@dataclass(frozen=True)
class AerialInput:
    """The files beside a clip or a table. landmarks, telemetry, camera, dem: as in the options of `dddas locate`.

    landmarks, telemetry: records, if they do not come from files.
    """

    landmarks: Path | Landmarks | None = None
    telemetry: Path | Telemetry | None = None
    camera: Path | None = None
    dem: Path | None = None
    background: Path | None = None
    colours: Path | None = None

    @property
    def files(self) -> list[Path]:
        """All files that are given."""
        return [file for file in vars(self).values() if isinstance(file, Path)]

    @property
    def facts(self) -> dict[str, Any]:
        """The files as run.json records them."""
        facts = dict(vars(self))
        return {"landmarks_file": facts.pop("landmarks"), **facts}


@dataclass(frozen=True)
class Assembly:
    """The parts of a run, without its pictures.

    settings: with the camera's focal length, if it is known. telemetry: None without a log. watch: None if nothing
    is located; notes say why. mission: steers a source that can be steered. notes: notes for the user.
    """

    settings: Settings
    engine: Engine
    telemetry: Telemetry | None = None
    watch: LandmarkWatch | None = None
    mission: Mission | None = None
    notes: list[str] = field(default_factory=list)


def assemble(
    settings: Settings,
    backend: str,
    size_px: tuple[int, int],
    rate_hz: float,
    telemetry: Telemetry | None = None,
    landmarks: Landmarks | None = None,
    camera: Camera | None = None,
    colours: Colours | None = None,
    elevation: Elevation | None = None,
) -> Assembly:
    """Assemble a run from records; nothing is located without landmarks or telemetry with places.

    Raise InputError as AerialLocator does, and for landmarks that cannot be found.
    """
    if landmarks is None and not has_places(telemetry):
        return Assembly(settings, load_engine(backend, settings), telemetry)
    locator = AerialLocator(
        camera,
        telemetry,
        landmarks,
        elevation=elevation,
        settings=settings,
        rate_hz=rate_hz,
        backend=backend,
        size_px=size_px,
    )
    if landmarks is not None:
        check_colours(landmarks, colours, telemetry is not None and settings.aerial.mode == "pose")
    return _with_locator(locator, colours, settings, backend, list(locator.notes))


def _with_locator(
    locator: AerialLocator, colours: Colours | None, settings: Settings, backend: str, notes: list[str]
) -> Assembly:
    settings, more = with_focal_length(settings, locator)
    watch, engine = LandmarkWatch(locator, colours), load_engine(backend, settings)
    return Assembly(settings, engine, locator.site.telemetry, watch, notes=[*notes, *more])


def assemble_mission(source: Instrument, settings: Settings, backend: str, by_landmarks: bool) -> Assembly:
    """Assemble the closed loop around a source whose first frame was read. Raise InputError as `build_mission` does."""
    mission = build_mission(source, settings, backend, by_landmarks)
    return Assembly(mission.settings, load_engine(backend, mission.settings), None, mission.watch, mission)


def assemble_files(
    given: AerialInput | None,
    telemetry: Path | Telemetry | None,
    settings: Settings,
    source: Source,
    backend: str,
    clip: str,
) -> Assembly:
    """Assemble a run from the files beside a clip. Without `given`, locate nothing. Raise InputError for bad input."""
    flight, of = None, source if isinstance(source, JoinedSource) else clip
    reason = "neither --telemetry nor --landmarks were given"
    if given is not None and given.landmarks is None:
        flight, reason = _read_flight(given, settings, of, source.rate_hz)
    if given is not None and not (given.landmarks is None and reason):
        colours = read_colours(given.colours) if given.colours is not None else None
        frames = None if source.count is None else (1, source.count)
        is_assumed = getattr(source, "assumes_rate", False)
        what = f"clip, whose frame rate is assumed (give --rate), {source.rate_hz:g} Hz:" if is_assumed else "clip"
        locator, notes = read_locator(given, settings, source.size, source.rate_hz, backend, frames, what, of, colours)
        locator.assumes_rate = is_assumed
        landmarks = locator.site.landmarks
        if given.landmarks is not None:
            check_colours(landmarks, colours, locator.site.telemetry is not None and settings.aerial.mode == "pose")
        if colours is not None and (bare := [n for n in landmarks.names if n not in colours.names]):
            notes.append(f"no colour is given for {', '.join(bare)}: not looked for in the pictures")
        return _with_locator(locator, colours, settings, backend, notes + _rate_notes(source))
    if flight is None and telemetry is not None:
        flight = _read_telemetry(telemetry, settings, of, source.rate_hz)
    if given is not None:
        _check_unused(given, source.size)
    settings, more = with_logged_focal(settings, flight, source.size)
    notes = [*(flight.notes if flight is not None else ()), *more, *_rate_notes(source), f"{NONE_LOCATED}{reason}"]
    return Assembly(settings, load_engine(backend, settings), flight, notes=notes)


def completion(
    given: AerialInput | None, settings: Settings, locator: AerialLocator
) -> Callable[[Telemetry], tuple[Telemetry, list[str]]]:
    """Return a function that completes later telemetry as that of the locator's site was, and returns notes."""
    site, size = locator.site, locator.camera.size_px
    known = None if given is None or given.camera is None else read_aerial_camera(given.camera, size)

    def complete(telemetry: Telemetry) -> tuple[Telemetry, list[str]]:
        if telemetry.geographic != (site.origin_deg is not None):
            raise InputError(f"{telemetry.origin}: its places are in other units than before; they are left out")
        local = telemetry if site.origin_deg is None else to_local(telemetry, site.origin_deg)
        completed, notes = complete_telemetry(site, local, known, settings)
        assert completed.telemetry is not None
        return completed.telemetry, notes

    return complete


def with_focal_length(settings: Settings, locator: AerialLocator) -> tuple[Settings, list[str]]:
    """Set gates.focal_px from telemetry, or from the camera if there is telemetry, unless the user has set it.

    Return settings and notes.
    """
    telemetry, camera = locator.site.telemetry, locator.camera
    settings, notes = with_logged_focal(settings, telemetry, camera.size_px)
    if notes or telemetry is None or is_set(settings, "gates.focal_px"):
        return settings, notes
    focal = camera.focal_px[0]
    note = f"gates.focal_px is the camera's {focal:.0f} px, so that sizes in metres hold"
    if not locator.focal_known:
        note = f"gates.focal_px is guessed as {focal:.0f} px: sizes in metres are as uncertain as this focal length"
    return with_parameters(settings, {"gates.focal_px": focal}), [note]


def _check_unused(given: AerialInput, size: tuple[int, int]) -> None:
    """Raise InputError for a faulty file, even if nothing can be located with it."""
    if given.camera is not None:
        read_aerial_camera(given.camera, size)
    for path in (given.dem, given.background):
        if path is not None and not path.is_file():
            raise InputError(f"{path} is not a file; give a GeoTIFF")


def _read_flight(
    given: AerialInput, settings: Settings, clip: str | JoinedSource | None, rate_hz: float
) -> tuple[Telemetry | None, str]:
    """Return the telemetry of a run without landmarks, and why it cannot locate anything; "" if it may."""
    flight = None if given.telemetry is None else _read_telemetry(given.telemetry, settings, clip, rate_hz)
    if not has_places(flight):
        return flight, describe_no_place(flight)
    try:
        build_site(None, flight)
    except InputError as error:
        return flight, str(error)
    return flight, ""


def _read_telemetry(
    given: Path | Telemetry, settings: Settings, clip: str | JoinedSource | None, rate_hz: float | None
) -> Telemetry:
    if isinstance(given, Telemetry):
        return given
    aerial = settings.aerial

    def read(path: Path, clip: str | None) -> Telemetry:
        return read_telemetry(
            path,
            clock_offset_s=aerial.clock_offset_s,
            clip=clip,
            time_zone=aerial.time_zone,
            order=aerial.order,
            rate_hz=rate_hz,
        )

    return clip.read_logs(read) if isinstance(clip, JoinedSource) else read(given, clip)


def _rate_notes(source: Source) -> list[str]:
    """Return a note if the number of pictures a second is unknown, as for a folder of pictures."""
    return [describe_assumed_rate(source.rate_hz)] if getattr(source, "assumes_rate", False) else []


def describe_assumed_rate(rate_hz: float) -> str:
    """Return the note on a clip whose number of pictures a second is unknown."""
    assumed = f"no frame rate is known: {rate_hz:g} frames a second are assumed"
    return f"{assumed}, which affects speeds and the alignment with a log; set --rate (rate_hz) before any clock offset"


def note_uncovered(scenes: Iterable[Scene], telemetry: Telemetry | None, notes: list[str]) -> Iterator[Scene]:
    """Yield the scenes unchanged, and finally note how many lie outside the telemetry's time."""
    covered = [0, 0]
    try:
        for scene in scenes:
            covered[telemetry is None or telemetry.at(scene.frame.time_s) is not None] += 1
            yield scene
    finally:
        if covered[0] and telemetry is not None:
            span = "{:.1f} to {:.1f} s".format(*telemetry.time_s[[0, -1]])
            outside = f"{covered[0]} of {sum(covered)} pictures lie outside the telemetry, which covers {span}"
            notes.append(f"{outside}: they are searched as without telemetry")


def prepare_detection(
    telemetry: Path | None, settings: Settings, source: Source, clip: str
) -> tuple[Settings, Telemetry | None, list[str]]:
    """Return settings with the log's focal length, the telemetry, and notes. Raise InputError as `read_telemetry`."""
    flight = None if telemetry is None else _read_telemetry(telemetry, settings, clip, source.rate_hz)
    settings, more = with_logged_focal(settings, flight, source.size)
    return settings, flight, [*(flight.notes if flight is not None else ()), *more, *_rate_notes(source)]


def clip_notes(source: Source, interval: int, settings: Settings) -> list[str]:
    """Note causes of missing targets in a clip that was read to its end: the interval, its size, or a mask."""
    notes = []
    if settings.difference.ignore:
        share = (read_ignored(Path(settings.difference.ignore), source.size) > 0).mean()
        notes.append(f"{settings.difference.ignore} leaves out {100 * share:.0f} % of every picture")
    if interval > 1 and interval >= source.last:
        notes.append(f"--interval {interval} is beyond the clip's {source.last} frames: only frame 1 was tracked")
    (width, height), least = source.size, settings.gates.min_area_px
    if settings.small.on:
        least = min(least, settings.small.min_area_px)
    if width * height < least:
        notes.append(f"pictures of {width}x{height} px are too small for any target, which has {least} px or more")
    return notes


def read_locator(
    given: AerialInput,
    settings: Settings,
    size: tuple[int, int] | None,
    rate_hz: float | None,
    backend: str,
    frames: tuple[int, int] | None,
    what: str,
    clip: str | JoinedSource | None,
    colours: Colours | None = None,
    extent: tuple[float, float] | None = None,
) -> tuple[AerialLocator, list[str]]:
    """Make the aerial locator from files, and return it with notes for the user.

    size: (width, height) of the pictures. frames: numbers of the first and last frame. size, rate_hz, frames: None if
    unknown. what: name of the clip or table in messages. clip: the video, as for `read_telemetry`. colours: if given,
    find the landmarks by colour in the pictures, even if their table has pixels. extent: as for `resolve_camera`.
    Raise InputError for bad input.
    """
    offset = settings.aerial.clock_offset_s
    notes: list[str] = []
    landmarks = None if isinstance(given.landmarks, Path) else given.landmarks
    if isinstance(given.landmarks, Path):
        landmarks = read_landmarks(given.landmarks, rate_hz=rate_hz, clock_offset_s=offset)
    telemetry = _read_telemetry(given.telemetry, settings, clip, rate_hz) if given.telemetry is not None else None
    if telemetry is not None:
        if rate_hz is None:
            raise InputError(
                "the telemetry has times, but the table has frames; give the number of frames a second with --rate"
            )
        if frames is not None and frames[1] > 0:
            telemetry.check_overlap((frames[1] - 1) / rate_hz, first_s=(frames[0] - 1) / rate_hz, what=what)
        notes += telemetry.notes
    if rate_hz is None:
        notes.append("no --rate was given: 10 frames a second are assumed, and velocities depend on it")
    site = build_site(landmarks if landmarks is None or colours is None else without_pixels(landmarks), telemetry)
    if given.dem is not None:
        site = replace(
            site, elevation=read_elevation(given.dem, site.places, site.origin_deg, margin_m=view_reach_m(telemetry))
        )
    known = read_aerial_camera(given.camera, size) if given.camera is not None else None
    site, more = complete_site(site, known, settings)
    notes += [*more, *describe_unknown_heights(site)]
    camera, focal_known, more = resolve_camera(known, size, site.telemetry, settings, extent)
    locator = AerialLocator.from_site(site, camera, settings, load_solver(backend), rate_hz or 10.0, focal_known)
    return locator, [*notes, *more]


def view_reach_m(telemetry: Telemetry | None) -> float:
    """Return the distance from the vehicle to which its camera sees the ground: 500 m, or more for an oblique view.

    It is the 95th percentile of height over tangent of the pitch, at most 10 km.
    """
    least_m, most_m = 500.0, 10_000.0
    if telemetry is None:
        return least_m
    heights = (telemetry.altitude_m, telemetry.above_sea_m, telemetry.above_ellipsoid_m)
    height_m = next((h for h in heights if np.isfinite(h).any()), np.full(len(telemetry), np.nan))
    reach_m = height_m / np.tan(np.clip(telemetry.pitch_rad, np.radians(3), np.radians(90)))
    reach_m = reach_m[np.isfinite(reach_m)]
    return float(np.clip(np.percentile(reach_m, 95), least_m, most_m)) if len(reach_m) else least_m


def locator_facts(locator: AerialLocator) -> dict[str, Any]:
    """Return an aerial locator in the form of run.json."""
    camera = locator.camera
    return {
        "origin_deg": locator.site.origin_deg,
        "rate_hz": locator.rate_hz,
        "lens": {"size_px": camera.size_px, "focal_px": camera.focal_px, "centre_px": camera.centre_px},
    }


def map_site(locator: AerialLocator, background: Path | None) -> MapSite:
    """Return the data of the ground that maps show. Raise InputError for a background that cannot be read."""
    site = locator.site
    return MapSite(
        names=site.landmarks.names,
        origin_deg=site.origin_deg,
        start_utc_s=site.telemetry.start_utc_s if site.telemetry is not None else math.nan,
        rate_hz=locator.rate_hz,
        background=None if background is None else read_ortho(background, site.places, site.origin_deg),
        camera=locator.camera,
        to_degrees=None if site.origin_deg is None else partial(geometry.lonlat, origin_deg=site.origin_deg),
    )
