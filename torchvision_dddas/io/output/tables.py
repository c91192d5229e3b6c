"""The tables that runs write: their schemas, and their rows for one frame."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.geometry import circular_error_90, error_category, lonlat
from torchvision_dddas.io.maps.grids import COLUMNS, check_grid, grid_rows
from torchvision_dddas.io.maps.ground_tracks import semi_axes
from torchvision_dddas.io.overlay import Trails
from torchvision_dddas.io.tables import (
    BOX,
    CLASS_COLUMNS,
    COVARIANCE,
    DEGREES,
    EAST_NORTH,
    FRAME,
    IDENTITY,
    KIND,
    MOT,
    MOT_TRACKS,
    MOTION,
    PRECISE_SCORE,
    SCORE,
    TARGET,
    Column,
    Rows,
    Schema,
    TableFiles,
    class_rows,
    compass_deg,
    mot_rows,
)
from torchvision_dddas.types import (
    AerialLocations,
    CameraPose,
    Confirmation,
    FrameResult,
    FusedTargets,
    GroundLocations,
    PeopleFrame,
    Positions,
    SharedFrame,
    TrackedFrame,
)

TRACKS = Schema(
    "tracks",
    *(FRAME, IDENTITY, *BOX, PRECISE_SCORE, KIND, Column("row", "d"), *MOTION),
    *(Column("link", ".3f", may_be_empty=True), *CLASS_COLUMNS),
)
"""tracks.csv. kind: `detection`, `bridge` (a box between two detections), or `untracked` (without identity).

row: the detection's line in its file, or its number in the frame. Heading and speed are over the ground.
link: as in Tracks, empty if unknown. class, class_id: the detection's; for a bridge, those of the box before.
"""

_FEET = (Column("feet_u_px", ".2f"), Column("feet_v_px", ".2f"))
PEOPLE = Schema("people", FRAME, TARGET, *BOX, SCORE, KIND, Column("margin", ".4f"), *_FEET, Column("cut", "d"))
"""detections.csv of `dddas people`. The box bounds the body. margin: the classifier's score. feet: between the feet.

cut: 1 if the picture's border cuts the body, so that its height is unreliable.
"""

_POSE = (
    *(*EAST_NORTH, Column("up_m", ".4f")),
    *(Column(name, ".4f") for name in ("heading_deg", "pitch_deg", "roll_deg", "upper_edge_deg")),
    Column("focal", ".6f"),
)
FIXES = Schema(
    "fixes",
    *(FRAME, Column("time_s", ".4f"), Column("by"), Column("landmarks_seen", "d"), Column("landmarks_used", "d")),
    *(Column("chi2", ".3f"), Column("freedom", "d"), *_POSE, Column("cause"), Column("changes")),
)
"""fixes.csv. If the camera looks nearly straight down, heading and roll are ill-determined, but the bearing of the
picture's upper edge is stable. focal: the focal length as a multiple of the value in the camera's file.
"""

SIGHTINGS = Schema(
    "sightings",
    *(FRAME, Column("camera"), TARGET, *BOX, PRECISE_SCORE, Column("cut", "d"), Column("by")),
    *(Column("distance_m", ".4f"), Column("bearing_deg", ".4f"), *EAST_NORTH, *COVARIANCE),
)

APPEARANCE = Schema(
    "decisions",
    *(FRAME, Column("looked", "d"), Column("weight", ".4g")),
    *(Column("location_dispersion", ".4f"), Column("appearance_dispersion", ".4f"), Column("cause")),
)
"""appearance.csv: one row per decision whether to use appearance, with the fields of AppearanceUse."""

CONFIRMATION = (
    *(KIND, Column("probability", ".4f"), Column("seen_by"), Column("people", "d")),
    *(Column("nearest_m", ".3f"), Column("nearest_sigmas", ".3f"), Column("best_score", ".4f")),
)
"""Columns that confirmed.csv adds to the columns of the blobs. They replace columns of the same names."""
CONFIRMATION_NAMES = tuple(column.name for column in CONFIRMATION)

_HEIGHTS = (Column("above_sea_m", ".2f"), Column("above_ellipsoid_m", ".2f"))
_ERROR = (Column("circular_error90_m", ".2f"), Column("error_category"))
_VELOCITY = (Column("velocity_east_m_s", ".4f"), Column("velocity_north_m_s", ".4f"))
_AERIAL = (
    *(Column("time_s", ".4f"), Column("relative_sigma_m", ".6g"), *_VELOCITY),
    *(Column("by"), Column("landmarks", "d")),
)


def track_tables(folder: Path) -> TableFiles[TrackedFrame]:
    """Open tracks.txt and tracks.csv. Heading and speed are computed from an identity's last two boxes."""
    trails = Trails(length=2)

    def motion(identity: int) -> tuple[float, float]:
        trail = trails.places[identity]
        if len(trail) < 2:
            return math.nan, math.nan
        (_, u0, v0), (_, u1, v1) = trail
        return compass_deg(math.atan2(v1 - v0, u1 - u0)), trails.speed(identity)

    def rows(tracked: TrackedFrame) -> Rows:
        trails.add(tracked)
        tracks, given, loose = tracked.tracks, tracked.detections, tracked.untracked
        lines = tracked.lines if len(tracked.lines) else np.arange(1, len(given) + 1)
        moves = [motion(identity) for identity in tracks.identity.tolist()] + [(math.nan, math.nan)] * len(loose)
        return {
            **_named(BOX, np.concatenate([tracks.box_px, given.box_px[loose]])),
            "frame": tracked.number,
            "identity": [*tracks.identity.tolist(), *[None] * len(loose)],
            "score": [*tracks.score.tolist(), *given.score[loose].tolist()],
            "kind": [*("detection" if row >= 0 else "bridge" for row in tracks.row), *["untracked"] * len(loose)],
            "row": [*(lines[row] if row >= 0 else None for row in tracks.row), *(lines[row] for row in loose)],
            "heading_deg": [heading for heading, _ in moves],
            "speed_px_per_frame": [speed for _, speed in moves],
            "link": [*tracks.link.tolist(), *[None] * len(loose)],
            **class_rows(np.r_[tracks.label, given.label[loose]], np.r_[tracks.class_id, given.class_id[loose]]),
        }

    return TableFiles({folder / "tracks.txt": (MOT_TRACKS, track_rows), folder / "tracks.csv": (TRACKS, rows)})


def track_rows(tracked: TrackedFrame) -> Rows:
    """Return the boxes with an identity as rows of MOTChallenge text."""
    tracks = tracked.tracks
    return mot_rows(tracked.number, tracks.box_px, tracks.score, tracks.identity)


def people_tables(folder: Path) -> TableFiles[PeopleFrame]:
    """Open detections.txt and detections.csv of people."""

    def rows(found: PeopleFrame) -> Rows:
        people = found.people
        return {
            **mot_rows(found.frame.number, people.box_px, people.score),
            **_named(_FEET, people.feet_px),
            "target": np.arange(1, len(people) + 1),
            "kind": "person",
            "margin": people.margin,
            "cut": people.cut,
        }

    return TableFiles({folder / "detections.txt": (MOT, rows), folder / "detections.csv": (PEOPLE, rows)})


def aerial_tables(folder: Path, has_degrees: bool, grid: str = "") -> TableFiles[AerialLocations]:
    """Open positions.csv and fixes.csv. has_degrees: whether longitudes and latitudes are known. grid: as in `grids`.

    Raise InputError as `check_grid` does.
    """
    check_grid(grid, has_degrees)
    columns = *_AERIAL, *CLASS_COLUMNS, *_HEIGHTS, *_ERROR, *COLUMNS[grid]
    schema = Schema("positions", *_position_columns(has_degrees), PRECISE_SCORE, *columns)

    def rows(located: AerialLocations) -> Rows:
        return {
            **_position_rows(located.positions),
            **(grid_rows(grid, located.positions.lonlat_deg) if located.positions.lonlat_deg is not None else {}),
            **_named(_VELOCITY, located.velocity_m_s),
            "time_s": located.time_s,
            "relative_sigma_m": np.sqrt(np.trace(located.relative_m2, axis1=1, axis2=2)),
            "by": located.fix.by,
            "landmarks": sum(located.fix.is_used),
        }

    return TableFiles({folder / "positions.csv": (schema, rows), folder / "fixes.csv": (FIXES, fix_row)})


def fix_row(located: AerialLocations) -> Rows:
    """Return the row of a frame in fixes.csv."""
    fix = located.fix
    pose = [math.nan] * len(_POSE)
    if fix.pose is not None:
        pose = [*fix.pose.place_m, *angles_deg(fix.pose), upper_edge_deg(fix.pose), fix.pose.focal]
    return {
        **_named(_POSE, np.array(pose)),
        "frame": located.frame,
        "time_s": located.time_s,
        "by": fix.by,
        "landmarks_seen": len(fix.landmark),
        "landmarks_used": sum(fix.is_used),
        "chi2": fix.chi2,
        "freedom": fix.freedom,
        "cause": " ".join(fix.cause.split()),
        "changes": " ".join("; ".join(fix.changes).split()),
    }


def angles_deg(pose: CameraPose) -> tuple[float, float, float]:
    """Return heading in [0, 360), pitch below the horizon and roll clockwise. All are in degrees."""
    heading, pitch, roll = pose.angles_rad
    # Round first, so that a heading just below 360 is written as 0.
    return round(math.degrees(heading), 4) % 360, math.degrees(pitch), math.degrees(roll)


def upper_edge_deg(pose: CameraPose) -> float:
    """Return the bearing from the picture's middle to its upper edge, in [0, 360); NaN if the edge is overhead."""
    east, north, _ = -np.asarray(pose.axes, float)[:, 1]
    return round(math.degrees(math.atan2(east, north)), 4) % 360 if math.hypot(east, north) > 1e-9 else math.nan


def ground_tables(folder: Path, cameras: Sequence[str], has_degrees: bool) -> TableFiles[GroundLocations]:
    """Open positions.csv and sightings.csv. cameras: names of the cameras."""
    schema = Schema(
        "positions",
        *(*_position_columns(has_degrees), PRECISE_SCORE, Column("cameras", "d"), *CLASS_COLUMNS, *_HEIGHTS, *_ERROR),
    )

    def rows(located: GroundLocations) -> Rows:
        return {**_position_rows(located.positions), "cameras": (located.members >= 0).sum(axis=1)}

    def sightings(located: GroundLocations) -> Rows:
        seen = located.sightings
        return {
            **_named(BOX, located.box_px),
            **_named(EAST_NORTH, seen.east_north_m),
            **_named(COVARIANCE, _variances(seen.covariance_m2)),
            "frame": located.frame,
            "camera": [cameras[which] for which in located.vehicle.tolist()],
            "target": located.target,
            "score": located.score,
            "cut": located.cut,
            "by": seen.by,
            "distance_m": seen.distance_m,
            "bearing_deg": np.degrees(seen.bearing_rad),
        }

    return TableFiles({folder / "positions.csv": (schema, rows), folder / "sightings.csv": (SIGHTINGS, sightings)})


def landmark_table(folder: Path, names: Sequence[str], has_degrees: bool) -> TableFiles[FrameResult]:
    """Open landmarks.csv, in the format of `dddas locate aerial --landmarks`. names: names of the landmarks."""
    place = DEGREES if has_degrees else EAST_NORTH
    pixel = (Column("u_px", ".3f"), Column("v_px", ".3f"))
    own = (Column("sigma_m", ".4g"), Column("seen_by"), Column("state"))
    schema = Schema("landmarks", FRAME, Column("landmark"), *pixel, *place, *own)

    def rows(result: FrameResult) -> Rows:
        located = result.locations
        if located is None:
            return dict.fromkeys(schema.names, ())
        marks, fix = located.marks, located.fix
        shown = np.flatnonzero(np.isfinite(marks.image_px).all(axis=1))
        places = marks.east_north_m if result.mark_lonlat_deg is None else result.mark_lonlat_deg
        state = dict(zip(fix.landmark.tolist(), fix.state, strict=True))
        seen_by = result.sighted_by or ("",) * len(marks)
        landmark = marks.landmark[shown].tolist()
        return {
            **_named(pixel, marks.image_px[shown]),
            **_named(place, places[shown]),
            "frame": located.frame,
            "landmark": [names[which] for which in landmark],
            "sigma_m": marks.sigma_m[shown],
            "seen_by": [seen_by[row] for row in shown.tolist()],
            "state": [state.get(which, "") for which in landmark],
        }

    return TableFiles({folder / "landmarks.csv": (schema, rows)})


def confirmed_table(folder: Path, header: Sequence[str], cells: Sequence[Sequence[str]]) -> TableFiles[Confirmation]:
    """Open confirmed.csv of a table of blobs. header, cells: columns and cells of the table, sorted by frame."""
    schema = Schema("blobs", *(Column(name) for name in header), *CONFIRMATION)

    def rows(confirmed: Confirmation) -> Rows:
        own = [[cells[row][k] for row in confirmed.row.tolist()] for k in range(len(header))]
        return {**dict(zip(header, own, strict=True)), **_confirmation_rows(confirmed)}

    return TableFiles({folder / "confirmed.csv": (schema, rows)})


def view_table(
    folder: Path, view: int, own: str, header: Sequence[str], cells: Sequence[Sequence[str]]
) -> TableFiles[SharedFrame]:
    """Open view1.csv and so on: the rows of a view's table, sorted by frame, with shared and own identities."""
    names = [f"own_{name}" if name == own else name for name in header if name != "frame"]
    schema = Schema("views", FRAME, Column(own, "d"), *(Column(name) for name in names))
    columns = [[row[k] for row in cells] for k, name in enumerate(header) if name != "frame"]
    frames, done = [int(float(row[header.index("frame")])) for row in cells], 0

    def rows(item: SharedFrame) -> Rows:
        nonlocal done
        here = slice(done, done := done + len(item.views[view]))
        return {
            "frame": frames[here],
            own: item.shared[view],
            **{n: c[here] for n, c in zip(names, columns, strict=True)},
        }

    return TableFiles({folder / f"view{view + 1}.csv": (schema, rows)})


def pair_table(folder: Path) -> TableFiles[SharedFrame]:
    """Open pairs.csv: the targets that two views see at one moment."""
    names = ("moment", "view", "other_view", "identity", "own_identity", "other_identity")

    def rows(item: SharedFrame) -> Rows:
        found = []
        for i, j in item.maps:
            numbers, a, b = np.intersect1d(item.shared[i], item.shared[j], return_indices=True)
            found += [
                (item.moment, i + 1, j + 1, *row) for row in zip(numbers, item.own[i][a], item.own[j][b], strict=True)
            ]
        return dict(zip(names, np.array(found, np.int64).reshape(-1, 6).T, strict=True))

    return TableFiles({folder / "pairs.csv": (Schema("pairs", *(Column(name, "d") for name in names)), rows)})


def map_table(folder: Path) -> TableFiles[SharedFrame]:
    """Open maps.csv: the homography from a view to the other view, row by row, at each moment with a known map."""
    terms = [f"h{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)]
    whole = [Column(name, "d") for name in ("moment", "view", "other_view")]
    schema = Schema("maps", *whole, Column("quality", ".3f"), *(Column(name, ".9g") for name in terms))

    def rows(item: SharedFrame) -> Rows:
        known = [
            (item.moment, i + 1, j + 1, found.quality, *found.b_from_a.ravel())
            for (i, j), found in item.maps.items()
            if found.b_from_a is not None
        ]
        cells = np.array(known, float).reshape(-1, 13).T.tolist()
        return dict(zip(schema.names, [*(list(map(int, column)) for column in cells[:3]), *cells[3:]], strict=True))

    return TableFiles({folder / "maps.csv": (schema, rows)})


def confirmed_positions(folder: Path, has_degrees: bool) -> TableFiles[FrameResult]:
    """Open confirmed.csv of targets located from the air. No file is made if ground vehicles confirm nothing."""

    def rows(result: FrameResult) -> Rows | None:
        confirmed, located = result.confirmed, result.locations
        if confirmed is None or located is None:
            return None
        own = _position_rows(located.positions)
        return {name: np.asarray(values)[confirmed.row] for name, values in own.items()} | _confirmation_rows(confirmed)

    schema = Schema("positions", *_position_columns(has_degrees), *CONFIRMATION, *CLASS_COLUMNS, *_HEIGHTS, *_ERROR)
    return TableFiles({folder / "confirmed.csv": (schema, rows)}, is_optional=True)


def fused_table(folder: Path, has_degrees: bool) -> TableFiles[FusedTargets | None]:
    """Open fused.csv: targets fused from all platforms. No file is made without further platforms."""
    own = (Column("speed_m_s", ".4f"), Column("speed_sigma_m_s", ".4f"), Column("class"), Column("probability", ".4f"))
    places = (*EAST_NORTH, *COVARIANCE, *(DEGREES if has_degrees else ()), *_VELOCITY)
    schema = Schema("fused", Column("time_s", ".4f"), FRAME, TARGET, *places, *own, Column("seen_by"))

    def rows(fused: FusedTargets | None) -> Rows | None:
        if fused is None or not len(fused):
            return None
        place = fused.state[:, :2]
        degrees = np.full(place.shape, np.nan) if fused.origin_deg is None else lonlat(place, fused.origin_deg)
        speed, sigma = fused.speed_m_s
        best = fused.probability.argmax(axis=1)
        return {
            **_named(EAST_NORTH, place),
            **_named(COVARIANCE, _variances(fused.covariance[:, :2, :2])),
            **_named(DEGREES, degrees),
            **_named(_VELOCITY, fused.state[:, 2:]),
            "time_s": fused.time_s,
            "frame": fused.frame,
            "target": fused.target,
            "speed_m_s": speed,
            "speed_sigma_m_s": sigma,
            "class": [fused.classes[k] for k in best],
            "probability": fused.probability[np.arange(len(best)), best],
            "seen_by": [
                ";".join(f"{name}:{number}" if number > 0 else name for name, number in seen.items())
                for seen in fused.seen_by
            ],
        }

    return TableFiles({folder / "fused.csv": (schema, rows)}, is_optional=True)


def crowd_table(folder: Path, has_degrees: bool) -> TableFiles[FrameResult]:
    """Open crowds.csv: crowds seen by ground vehicles. No file is made if no crowd was seen."""
    own = (Column("people", "d"), *_VELOCITY, Column("seen_by"), Column("steers", "d"))
    schema = Schema("crowds", FRAME, TARGET, *EAST_NORTH, *(DEGREES if has_degrees else ()), *own)

    def rows(result: FrameResult) -> Rows | None:
        crowds, located = result.crowds, result.locations
        if crowds is None or located is None or not len(crowds):
            return None
        origin = located.positions.origin_deg
        degrees = np.full((len(crowds), 2), np.nan) if origin is None else lonlat(crowds.east_north_m, origin)
        return {
            **_named(EAST_NORTH, crowds.east_north_m),
            **_named(DEGREES, degrees),
            **_named(_VELOCITY, crowds.velocity_m_s),
            "frame": located.frame,
            "target": crowds.target,
            "people": crowds.people,
            "seen_by": crowds.seen_by,
            "steers": crowds.steers,
        }

    return TableFiles({folder / "crowds.csv": (schema, rows)}, is_optional=True)


def appearance_table(folder: Path) -> TableFiles[TrackedFrame]:
    """Open appearance.csv. No file is made without decisions, as in a run without pictures."""

    def rows(tracked: TrackedFrame) -> Rows | None:
        use = tracked.tracks.appearance
        return None if use is None else {"frame": tracked.number, **asdict(use)}

    return TableFiles({folder / "appearance.csv": (APPEARANCE, rows)}, is_optional=True)


def _confirmation_rows(confirmed: Confirmation) -> dict[str, Any]:
    return {
        "kind": confirmed.kind,
        "probability": confirmed.probability,
        "seen_by": [";".join(names) for names in confirmed.seen_by],
        "people": confirmed.people,
        "nearest_m": confirmed.nearest_m,
        "nearest_sigmas": confirmed.nearest_sigmas,
        "best_score": confirmed.best,
    }


def _position_columns(has_degrees: bool) -> tuple[Column, ...]:
    return (FRAME, TARGET, *EAST_NORTH, *COVARIANCE, *(DEGREES if has_degrees else ()))


def _position_rows(positions: Positions) -> dict[str, Any]:
    degrees, error_m = positions.lonlat_deg, circular_error_90(semi_axes(positions.covariance_m2, 1.0)[0])
    return {
        **_named(EAST_NORTH, positions.east_north_m),
        **_named(COVARIANCE, _variances(positions.covariance_m2)),
        **_named(DEGREES, np.full((len(positions), 2), np.nan) if degrees is None else degrees),
        "frame": positions.frame,
        "target": positions.target,
        "score": positions.score,
        "above_sea_m": positions.above_sea_m,
        "above_ellipsoid_m": positions.above_ellipsoid_m,
        "circular_error90_m": error_m,
        "error_category": error_category(error_m),
        **class_rows(positions.label, positions.class_id),
    }


def _variances(covariance_m2: np.ndarray) -> np.ndarray:
    """Return (N, 3): variance of east, covariance, variance of north."""
    return covariance_m2.reshape(-1, 4)[:, [0, 1, 3]]


def _named(columns: Sequence[Column], values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of (N, K) values by their names."""
    named = np.reshape(values, (-1, len(columns))).T
    return {column.name: cells for column, cells in zip(columns, named, strict=True)}
