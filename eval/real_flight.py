"""Measure places by telemetry alone on a real flight over surveyed cones, by the datum of its heights.

python eval/real_flight.py ../shared/data/telemetry/thunderstorm

The README of that folder describes the picks and their traps. The log's heights above the ellipsoid and its terrain
heights are both 2 x 28 m too high, as after a geoid of the wrong sign. Each pick is located separately, over level
ground. Shares have 90 % intervals of a bootstrap by picture.

For `dddas calibrate-flight`, pictures are left out in turn. The other pictures give the errors of the log, and the left
out pictures are located by corrected telemetry alone.

With landmarks, each pick is located by the other picks of its picture, in the order of the pictures. Estimates of the
landmarks' errors carry over to later pictures. The true error is about 0.2 m; the study also states wrong errors.
"""

import copy
import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bench
import numpy as np
from ellipses import CHI2, share_of

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.geo import (
    OFFSETS,
    PART_OF_OFFSET,
    AerialLocator,
    FlightErrors,
    Look,
    estimate_flight_errors,
    pose_prior,
)
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.plane_homography import load_solver, locate_pixels
from torchvision_dddas.geometry import east_north, geoid_height, ground_with_slopes
from torchvision_dddas.types import Camera, Elevation, Flight, LandmarkObservations, Telemetry, Tracks

DRONE_ABOVE_CONES_M = 54.4
"""Offset of the drone's logged height from its height above the cones' datum, by the data's README."""
Pick = Mapping[str, float]

INPUTS = (
    "ellipsoid as altitude_m",
    "ellipsoid and terrain",
    "ellipsoid with the sign mended, true terrain",
    "sea, ellipsoid and terrain",
    "true heights and terrain",
)
"""Heights that a user gives. Terrain: above the sea, as the log's own program had it before its geoid."""
STATED: dict[str, dict[str, float]] = {
    "defaults": {},
    "terrain 3 m, datum 3 m": {"aerial.terrain_sigma_m": 3.0, "aerial.datum_sigma_m": 3.0},
    "the flight's misfits": {
        "aerial.heading_sigma_deg": 2.0, "aerial.tilt_sigma_deg": 0.6, "aerial.position_sigma_m": 1.2,
    },
    "the flight's misfits, terrain 3 m, datum 3 m": {
        "aerial.heading_sigma_deg": 2.0, "aerial.tilt_sigma_deg": 0.6, "aerial.position_sigma_m": 1.2,
        "aerial.terrain_sigma_m": 3.0, "aerial.datum_sigma_m": 3.0,
    },
}  # fmt: skip
"""Errors that the user states. The misfits are those in the data's README, which were found on the same flight."""


def read_picks(folder: Path) -> list[Pick]:
    """Read the picks, with the camera's heading from the other program's answers in a picture."""
    with (folder / "picks.csv").open(encoding="utf-8") as file:
        picks = [{k: float(v) for k, v in row.items() if k != "cone"} for row in csv.DictReader(file)]
    turns: dict[float, list[complex]] = {}
    for pick in picks:
        answer = np.array([[pick["their_longitude"], pick["their_latitude"]]])
        east, north = east_north(answer, (pick["drone_longitude"], pick["drone_latitude"]))[0]
        turn = np.exp(1j * (np.arctan2(east, north) - np.radians(pick["yaw_offset_deg"])))
        turns.setdefault(pick["picture"], []).append(turn)
    return [{**pick, "heading_rad": float(np.angle(np.sum(turns[pick["picture"]])))} for pick in picks]


def locate_pick(pick: Pick, given: str, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Return the error (2,) east, north in metres, and its covariance; NaN without a place."""
    size = int(pick["width_px"]), int(pick["height_px"])
    centre = (size[0] - 1) / 2, (size[1] - 1) / 2
    camera = Camera("drone", size, (pick["f_x_px"],) * 2, centre, k1=pick["k1"], k2=pick["k2"])
    place = np.array([[pick["drone_longitude"], pick["drone_latitude"]]])
    geoid_m = float(geoid_height(place)[0])
    up_m, unknown = pick["drone_height_ellipsoid_m"], np.nan
    heights = {  # altitude, above the sea, above the ellipsoid, terrain
        INPUTS[0]: (up_m, unknown, unknown, None),
        INPUTS[1]: (unknown, unknown, up_m, pick["their_height_ellipsoid_m"] + geoid_m),
        INPUTS[2]: (unknown, unknown, up_m + 2 * geoid_m, pick["cone_height_m"] - geoid_m),
        INPUTS[3]: (unknown, up_m + geoid_m, up_m, pick["their_height_ellipsoid_m"] + geoid_m),
        INPUTS[4]: (unknown, up_m - DRONE_ABOVE_CONES_M - geoid_m, unknown, pick["cone_height_m"] - geoid_m),
    }
    altitude, sea, ellipsoid, terrain = heights[given]
    angles = (
        pick["heading_rad"] % (2 * np.pi),
        np.radians(pick["camera_slant_deg"]),
        np.radians(pick["camera_roll_deg"]),
    )
    two = np.ones(2)
    telemetry = Telemetry(
        np.array([0.0, 1.0]), altitude * two, 0 * two, np.repeat(place, 2, axis=0), True, sea * two,
        *(angle * two for angle in angles), above_ellipsoid_m=ellipsoid * two,
    )  # fmt: skip
    ground = None if terrain is None else Elevation(np.zeros((101, 101)), (-5000.0, -5000.0), 100.0, terrain)
    pixel = np.array([pick["u_share"] * size[0] - 0.5, pick["v_share"] * size[1] - 0.5])
    tracks = Tracks(1, np.array([1]), np.array([[*(pixel - 2), 5.0, 5.0]]), np.ones(1), np.zeros(1, int))
    found = AerialLocator(camera, telemetry, elevation=ground, settings=settings).locate(tracks).positions
    if not len(found):
        return np.full(2, np.nan), np.full((2, 2), np.nan)
    cone = np.array([[pick["cone_longitude"], pick["cone_latitude"]]])
    assert found.origin_deg is not None
    return found.east_north_m[0] - east_north(cone, found.origin_deg)[0], found.covariance_m2[0]


def see_pictures(picks: list[Pick], stated_m: float) -> list[tuple[float, Camera, Flight, LandmarkObservations]]:
    """Return number, camera, log with true heights and picks of each picture, in metres about the first pick."""
    origin = picks[0]["cone_longitude"], picks[0]["cone_latitude"]
    base_m, seen = np.mean([pick["cone_height_m"] for pick in picks]), []
    for number, picture in enumerate(dict.fromkeys(pick["picture"] for pick in picks)):
        mine = [pick for pick in picks if pick["picture"] == picture]
        pick, size = mine[0], (int(mine[0]["width_px"]), int(mine[0]["height_px"]))
        centre = (size[0] - 1) / 2, (size[1] - 1) / 2
        camera = Camera("drone", size, (pick["f_x_px"],) * 2, centre, k1=pick["k1"], k2=pick["k2"])
        drone = east_north(np.array([[pick["drone_longitude"], pick["drone_latitude"]]]), origin)[0]
        flight = Flight(
            altitude_m=pick["drone_height_ellipsoid_m"] - DRONE_ABOVE_CONES_M - base_m,
            place=(drone[0], drone[1]),
            heading_rad=pick["heading_rad"],
            pitch_rad=np.radians(pick["camera_slant_deg"]),
            roll_rad=np.radians(pick["camera_roll_deg"]),
        )
        pixels = np.array([[p["u_share"], p["v_share"]] for p in mine]) * size - 0.5
        cones = east_north(np.array([[p["cone_longitude"], p["cone_latitude"]] for p in mine]), origin)
        up_m = np.array([p["cone_height_m"] - base_m for p in mine])
        names, n = np.arange(len(mine)) + 100 * number, len(mine)
        marks = LandmarkObservations(names, pixels, cones, np.full(n, stated_m), np.ones(n), up_m)
        seen.append((picture, camera, flight, marks))
    return seen


def locate_by_landmarks(picks: list[Pick], stated_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return errors (N, 2), covariances (N, 2, 2), pictures (N,) of picks located by the others of their picture."""
    georeferencer, found = None, []
    for number, (picture, camera, flight, marks) in enumerate(see_pictures(picks, stated_m)):
        georeferencer = georeferencer or Georeferencer(camera, Settings(), load_solver("onboard"))
        when, n = (number + 1, 60.0 * number), len(marks)
        for k in range(n) if n > 1 else ():
            fix = copy.deepcopy(georeferencer).update(*when, flight, marks[np.arange(n) != k])
            place, covariance = locate_pixels(fix, camera, marks.image_px[[k]], 1.0, marks.up_m[[k]])
            found.append((place[0] - marks.east_north_m[k], covariance[0], picture))
        georeferencer.update(*when, flight, marks)
    off, covariance, pictures = zip(*found, strict=True)
    return np.array(off), np.array(covariance), np.array(pictures)


def find_errors(picks: list[Pick]) -> FlightErrors:
    """Return the result of `dddas calibrate-flight` for some picks, with 60 s between pictures."""
    looks = [
        Look(number, 60.0 * number, pose_prior(flight, camera, Settings().aerial), marks)
        for number, (_, camera, flight, marks) in enumerate(see_pictures(picks, 0.2), 1)
    ]
    return estimate_flight_errors(looks, see_pictures(picks[:1], 0.2)[0][1], Settings().aerial)


def list_errors(picks: list[Pick]) -> str:
    """Format the errors over all pictures: offsets (truth minus log), and sigmas from picture to picture."""
    found, rows = find_errors(picks), []
    for k, name in enumerate(OFFSETS[:6]):
        part, scale, unit = PART_OF_OFFSET[k], np.degrees(1) if k < 3 else 1, "°" if k < 3 else "m"
        numbers = found.offset[k], found.offset_sigma[k], found.sigma[part], found.sigma[part] * found.relative[part]
        rows.append([f"{name} {unit}", "{:+.2f} ± {:.2f}".format(*np.multiply(numbers[:2], scale))])
        rows[-1] += ["{:.2f} ± {:.2f}".format(*np.multiply(numbers[2:], scale)), f"{found.stated[part] * scale:.2f}"]
    return bench.format_table(["error of the log", "offset", "sigma by picture", "default"], rows)


FOLDS = 5


def locate_left_out(picks: list[Pick], in_a_row: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return errors and covariances of picks by telemetry alone, calibrated by the pictures of the other folds.

    in_a_row: a fold is a consecutive part of the flight, else every fifth picture.
    """
    names = list(dict.fromkeys(pick["picture"] for pick in picks))
    fold_of = {name: k * FOLDS // len(names) if in_a_row else k % FOLDS for k, name in enumerate(names)}
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for fold in range(FOLDS):
        values = find_errors([pick for pick in picks if fold_of[pick["picture"]] != fold]).settings(Settings().aerial)
        bench.log(fold, values)
        settings = with_parameters(Settings(), {"aerial.point": "centre", "aerial.own_sigma": 0.0, **values})
        for k, pick in enumerate(picks):
            if fold_of[pick["picture"]] == fold:
                found[k] = locate_pick(pick, INPUTS[4], settings)
    off, covariance = zip(*(found[k] for k in range(len(picks))), strict=True)
    return np.array(off), np.array(covariance)


def scale_by_others(squares: np.ndarray, pictures: np.ndarray) -> np.ndarray:
    """Return (N,) factors of the covariances for which 50 % ellipses hold half of the errors in other pictures."""
    return np.array([np.median(squares[pictures != own]) for own in pictures]) / (-2 * np.log(0.5))


PARTS = {
    "heading 5°": {"aerial.heading_sigma_deg": 5.0},
    "tilt 1°": {"aerial.tilt_sigma_deg": 1.0},
    "position 1.43 m": {"aerial.position_sigma_m": 1.43},
    "altitude 2 %": {"aerial.altitude_sigma": 0.02},
    "focal length 1 %": {"aerial.focal_sigma": 0.01},
    "pixel 1 px": {"aerial.target_sigma_px": 1.0},
}
"""The errors of the defaults, one at a time."""


def list_parts(picks: list[Pick]) -> str:
    """Format the part of the ellipses that comes from each stated error, as the root of the mean variance."""
    none = {name: 0.0 for values in PARTS.values() for name in values}
    parts = {**PARTS, "all": {name: value for values in PARTS.values() for name, value in values.items()}}
    rows = []
    for name, values in parts.items():
        settings = with_parameters(Settings(), {"aerial.point": "centre", "aerial.own_sigma": 0.0, **none, **values})
        covariance = np.array([locate_pick(pick, INPUTS[4], settings)[1] for pick in picks])
        rows.append([name, f"{np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean()):.2f}"])
    off = np.array([locate_pick(pick, INPUTS[4], Settings())[0] for pick in picks])
    rows.append(["errors seen", f"{np.sqrt((off**2).sum(axis=1).mean()):.2f}"])
    return bench.format_table(["stated error", "rms m"], rows)


FLIGHTS = 4000


def list_chances(picks: list[Pick]) -> str:
    """Format the coverage of ellipses in simulated flights with the defaults' errors, by the errors' lasting share.

    The picks, poses and ellipses are those of the flight. A share of each error's variance is drawn once per flight,
    the rest is drawn for each picture (seed 0).
    """
    slopes, picture = [], []
    for number, (_, camera, flight, marks) in enumerate(see_pictures(picks, 0.2)):
        prior = pose_prior(flight, camera, Settings().aerial)
        heading, sigma = prior.pose.angles_rad[0], 1 / np.sqrt(prior.information.diagonal())
        level = np.eye(7)
        level[:2, :2] = [[-np.cos(heading), np.sin(heading)], [np.sin(heading), np.cos(heading)]]
        by_pose = ground_with_slopes(prior.pose, camera, marks.image_px, marks.up_m)[1]
        slopes.append(by_pose @ level.T * sigma)  # tilts to the left and ahead instead of east and north
        picture += [number] * len(marks)
    slope, rng, rows = np.concatenate(slopes), np.random.default_rng(0), []
    inverse = np.linalg.inv(slope @ slope.swapaxes(1, 2))
    for lasting in (0.0, 0.5, 0.9, 1.0):
        once, anew = rng.normal(size=(FLIGHTS, 1, 7)), rng.normal(size=(FLIGHTS, picture[-1] + 1, 7))
        error = np.sqrt(lasting) * once + np.sqrt(1 - lasting) * anew
        off = np.einsum("nij,fnj->fni", slope, error[:, picture])
        squares = np.einsum("fni,nij,fnj->fn", off, inverse, off)
        shares = 100 * np.array([(squares < most).mean(axis=1) for most in CHI2.values()])
        cells = ["{1:.0f} % [{0:.0f}, {2:.0f}]".format(*np.quantile(one, (0.05, 0.5, 0.95))) for one in shares]
        (small, large), seen = shares, (88.5, 99.9)
        good = (small >= 62) & (small <= 75) & (large >= 92) & (large <= 98)
        wide = (small >= seen[0]) & (large >= seen[1])
        rows.append([f"{100 * lasting:.0f} %", *cells, f"{100 * good.mean():.0f} %", f"{100 * wide.mean():.0f} %"])
    head = [f"in {name} ellipses" for name in CHI2]
    return bench.format_table(["lasts for the flight", *head, "both in the goals", "as wide as this flight"], rows)


def list_distributions(picks: list[Pick]) -> str:
    """Format the fit of distributions with the defaults' 95 % ellipses to the errors of the flight."""
    settings = with_parameters(Settings(), {"aerial.point": "centre", "aerial.own_sigma": 0.0})
    off, covariance = (
        np.array(p) for p in zip(*(locate_pick(pick, INPUTS[4], settings) for pick in picks), strict=True)
    )
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
    rest, rows = -np.log(2 * np.pi) - np.log(np.linalg.det(covariance)) / 2, []
    for freedom in (np.inf, 20.0, 8.0, 4.0):
        if freedom == np.inf:
            density, most = rest - squares / 2, CHI2["68 %"]
        else:
            scale = CHI2["95 %"] / (freedom * (20 ** (2 / freedom) - 1))
            density = rest - np.log(scale) - (freedom / 2 + 1) * np.log1p(squares / scale / freedom)
            most = scale * freedom * (0.32 ** (-2 / freedom) - 1)
        name = "normal" if freedom == np.inf else f"Student's t, {freedom:.0f} degrees of freedom"
        inside = share_of(squares < most, np.array([pick["picture"] for pick in picks]))
        rows.append([name, f"{density.mean():.2f}", inside])
    return bench.format_table(["distribution, all with the same 95 % ellipse", "mean log density", "in its 68 %"], rows)


def measure_flight(options: bench.Options) -> tuple[str, Any]:
    """Measure errors and ellipses by the datum of the heights and by the stated errors."""
    picks = read_picks(options.data)
    pictures, rows = np.array([pick["picture"] for pick in picks]), []
    for given in INPUTS:
        for name, values in STATED.items() if given in INPUTS[2:] else [("defaults", {})]:
            settings = with_parameters(Settings(), {"aerial.point": "centre", "aerial.own_sigma": 0.0, **values})
            found = [locate_pick(pick, given, settings) for pick in picks]
            off, covariance = (np.array(part) for part in zip(*found, strict=True))
            known = np.isfinite(off).all(axis=1)
            cells = [given, name, int(known.sum())]
            if known.any():
                far = np.linalg.norm(off[known], axis=1)
                squares = np.einsum("ni,nij,nj->n", off[known], np.linalg.inv(covariance[known]), off[known])
                shares = [share_of(squares < most, pictures[known]) for most in CHI2.values()]
                cells += [f"{np.median(far):.1f}", f"{np.quantile(far, 0.9):.1f}", *shares]
            rows.append([*cells, *["-"] * (7 - len(cells))])
            bench.log(*rows[-1])
            if given == INPUTS[4] and name == "defaults":
                scale = scale_by_others(squares, pictures[known])
                shares = [share_of(squares / scale < most, pictures[known]) for most in CHI2.values()]
                sigmas = f"defaults, all times {np.median(np.sqrt(scale)):.2f} by the other pictures"
                rows.append([given, sigmas, *cells[2:5], *shares])
    for words, in_a_row in (("every fifth picture", False), ("a fifth of the flight", True)):
        off, covariance = locate_left_out(picks, in_a_row)
        far = np.linalg.norm(off, axis=1)
        squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
        shares = [share_of(squares < most, pictures) for most in CHI2.values()]
        numbers = [len(off), f"{np.median(far):.1f}", f"{np.quantile(far, 0.9):.1f}"]
        rows.append([INPUTS[4], f"calibrate-flight without {words}", *numbers, *shares])
        bench.log(*rows[-1])
    for words, stated_m in (("0.2 m", 0.2), ("0.06 m, 3 times too small", 0.06), ("0.02 m, 10 times too small", 0.02)):
        off, covariance, pictures = locate_by_landmarks(picks, stated_m)
        far = np.linalg.norm(off, axis=1)
        squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
        shares = [share_of(squares < most, pictures) for most in CHI2.values()]
        numbers = [len(off), f"{np.median(far):.2f}", f"{np.quantile(far, 0.9):.2f}"]
        rows.append(["true heights and terrain, other picks as landmarks", f"landmarks {words}", *numbers, *shares])
        bench.log(*rows[-1])
    head = [
        "heights given",
        "errors stated",
        "located",
        "median m",
        "90 % below m",
        *(f"in {name} ellipses" for name in CHI2),
    ]
    tables = list_parts(picks), list_errors(picks), list_chances(picks), list_distributions(picks)
    text = "\n\n".join([bench.format_table(head, rows, words=2), *tables])
    return text, {"picks": len(picks), "rows": rows}


if __name__ == "__main__":
    bench.main(__doc__, {"": (measure_flight, {"data": Path})})
