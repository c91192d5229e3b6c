"""How far ranging from the ground errs, against the world positions of PETS09-S2L1 and TUD-Stadtmitte.

    python eval/ranging_error.py DATA [--detections PETS.csv] [--interval 5] [--plot FILE] [--write FILE]

DATA is a folder of MOTChallenge 2015 sequences whose gt.txt has world metres in columns 8 to 10. Distances go from the
camera's ground point to each person. The body's height is calibrated on one half of the frames and used on the other,
both ways. --detections: boxes of a detector on the PETS clip, each compared with the true box that it overlaps best;
--interval: its frame n is the clip's frame 1 + (n - 1) interval.

PETS comes with its camera (Tsai); that of TUD is fitted to the true feet and their world positions. The world positions
of both were made from the true boxes' lower edges through these cameras: so for true boxes the foot row errs by nothing
but the camera's model. The height of true boxes, and both for detections, are fair.
"""

import argparse
import sys
import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import report
from footage import truth_of
from scipy.optimize import least_squares, linear_sum_assignment

from torchvision_dddas.config import GroundParameters
from torchvision_dddas.evaluation.metrics.boxes import iou
from torchvision_dddas.geo.ranging import range_people, touches_border
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.types import Camera, Poses, Sightings

SIZES = {"PETS09-S2L1": (768, 576), "TUD-Stadtmitte": (640, 480)}
SURVEYED = {
    "focal_sigma": 0.002,
    "height_sigma_m": 0.03,
    "pitch_sigma_rad": float(np.radians(0.1)),
    "heading_sigma_rad": float(np.radians(0.1)),
    "position_sigma_m": 0.05,
}
"""How well such cameras are known, one standard deviation."""


@dataclass(frozen=True)
class People:
    """Boxes and the truth of the people in them: frame (N,), box_px (N, 4), cut (N,), east_north_m (N, 2)."""

    frame: np.ndarray
    box_px: np.ndarray
    cut: np.ndarray
    east_north_m: np.ndarray


def read_truth(place: Path, size: tuple[int, int]) -> People:
    """The true boxes of a sequence, whose pixels count from 1, and where their people stand."""
    truth = truth_of(place)
    assert truth.tracks is not None and truth.positions is not None
    assert (truth.positions.identity == truth.tracks.identity).all(), "people without a place"
    box = truth.tracks.box_px - (1, 1, 0, 0)
    return People(truth.tracks.frame, box, touches_border(box, size), truth.positions.east_north_m)


def identities(place: Path) -> np.ndarray:
    """(N,) of the people of `read_truth`."""
    tracks = truth_of(place).tracks
    assert tracks is not None
    return tracks.identity


def tsai(path: Path) -> Camera:
    """The camera of a Tsai calibration file, in metres. Its distortion is turned into OpenCV's, to the fourth power."""
    root = ET.parse(path).getroot()
    part = {kind: {k: float(v) for k, v in node.attrib.items()} for kind in ("Geometry", "Intrinsic", "Extrinsic")
            if (node := root.find(kind)) is not None}  # fmt: skip
    geometry, inner, outer = part["Geometry"], part["Intrinsic"], part["Extrinsic"]
    (sa, sb, sg), (ca, cb, cg) = (f([outer["rx"], outer["ry"], outer["rz"]]) for f in (np.sin, np.cos))
    about_x = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    about_y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    about_z = np.array([[cg, -sg, 0], [sg, cg, 0], [0, 0, 1]])
    camera_from_world = about_z @ about_y @ about_x
    east, north, up = -camera_from_world.T @ [outer["tx"], outer["ty"], outer["tz"]] / 1000
    right, down, ahead = camera_from_world
    bend = inner["kappa1"] * inner["focal"] ** 2
    return Camera(
        path.stem,
        (int(geometry["width"]), int(geometry["height"])),
        (inner["focal"] * inner["sx"] / geometry["dpx"], inner["focal"] / geometry["dpy"]),
        (inner["cx"], inner["cy"]),
        (east, north),
        heading_rad=np.arctan2(ahead[0], ahead[1]),
        pitch_rad=np.arcsin(-ahead[2]),
        roll_rad=np.arctan2(-right[2], -down[2]),
        height_m=up,
        k1=-bend,
        k2=3 * bend**2,
        **SURVEYED,
    )


def fitted(people: People, size: tuple[int, int]) -> Camera:
    """The camera with square pixels, its axis through the middle, that puts the feet on their rows and columns."""
    box, middle = people.box_px, (np.array(size) - 1) / 2
    feet = box[:, :2] + box[:, 2:] * (0.5, 1) - 0.5
    centre = people.east_north_m.mean(axis=0)

    def miss(p: np.ndarray) -> np.ndarray:
        focal, place, height, (heading, pitch, roll) = np.exp(p[0]), p[1:3], np.exp(p[3]), p[4:7]
        away = people.east_north_m - place
        ahead = away @ [np.sin(heading), np.cos(heading)]
        depth = ahead * np.cos(pitch) + height * np.sin(pitch)
        x = away @ [np.cos(heading), -np.sin(heading)] / depth
        y = (height * np.cos(pitch) - ahead * np.sin(pitch)) / depth
        turned = np.stack([x * np.cos(roll) + y * np.sin(roll), y * np.cos(roll) - x * np.sin(roll)], axis=1)
        return (turned * focal + middle - feet).ravel()

    best = None
    for turn in np.radians(range(0, 360, 30)):
        place = centre - 25 * np.array([np.sin(turn), np.cos(turn)])
        start = [np.log(2 * size[0]), *place, np.log(2.0), turn, 0.05, 0.0]
        found = least_squares(miss, start, x_scale=[0.1, 1, 1, 0.1, 0.1, 0.1, 0.1], loss="soft_l1", max_nfev=300)
        best = found if best is None or found.cost < best.cost else best
    assert best is not None
    focal, height = np.exp(best.x[[0, 3]])
    heading, pitch, roll = best.x[4:7]
    return Camera(
        "fitted", size, (focal, focal), (middle[0], middle[1]), (best.x[1], best.x[2]),
        heading_rad=heading, pitch_rad=pitch, roll_rad=roll, height_m=height, **SURVEYED,
    )  # fmt: skip


def detected(path: Path, interval: int, truth: People, size: tuple[int, int], least: float = 0.5) -> People:
    """A detector's boxes that overlap a true one (IoU at least `least`, one to one), with the truth of that."""
    table = read_detections(path)
    cut = touches_border(table.box_px, size) if table.cut is None else table.cut
    ours, theirs = [], []
    for number in np.unique(table.frame):
        rows = np.arange(len(table))[table.rows(number)]
        there = np.flatnonzero(truth.frame == 1 + (number - 1) * interval)
        shared = iou(table.box_px[rows], truth.box_px[there])
        for a, b in zip(*linear_sum_assignment(-np.where(shared < least, 0, shared)), strict=True):
            if shared[a, b] >= least:
                ours.append(rows[a])
                theirs.append(there[b])
    return People(truth.frame[theirs], table.box_px[ours], cut[ours], truth.east_north_m[theirs])


def seen(people: People, camera: Camera, parameters: GroundParameters) -> Sightings:
    """What ranging says of them."""
    n = len(people.frame)
    poses = Poses(np.tile(camera.place, (n, 1)), np.full(n, camera.heading_rad), np.full(n, camera.pitch_rad))
    return range_people(people.box_px, people.cut, camera, poses, poses.place, parameters)


def body_height(people: People, camera: Camera, use: np.ndarray) -> float:
    """The height with which the median person stands where it should."""
    found = seen(people, camera, GroundParameters(use="height", body_height_m=1.75))
    return float(np.nanmedian((1.75 * distance(people, camera) / found.distance_m)[use & ~people.cut]))


def distance(people: People, camera: Camera) -> np.ndarray:
    """Metres from the camera's ground point."""
    return np.linalg.norm(people.east_north_m - camera.place, axis=1)


def measure(people: People, camera: Camera) -> tuple[dict[str, dict[str, float]], dict[str, np.ndarray]]:
    """Figures and relative errors of each way to range."""
    early = people.frame <= np.median(people.frame)
    ways: dict[str, tuple[GroundParameters, bool]] = {
        "eq. 13–15, 1.8 m": (GroundParameters(mode="paper", body_height_m=1.8), False),
        "height, 1.8 m": (GroundParameters(use="height", body_height_m=1.8), False),
        "height, 1.7 m": (GroundParameters(use="height", body_height_m=1.7), False),
        "height, calibrated": (GroundParameters(use="height"), True),
        "foot row": (GroundParameters(use="feet"), False),
        "both, calibrated": (GroundParameters(), True),
    }
    far, figures, errors = distance(people, camera), {}, {}
    for way, (parameters, calibrated) in ways.items():
        error, covered, heights = np.full(len(far), np.nan), np.full(len(far), np.nan), []
        for half in (early, ~early):
            height = body_height(people, camera, ~half) if calibrated else parameters.body_height_m
            found = seen(people, camera, parameters.model_copy(update={"body_height_m": height}))
            off = found.east_north_m - people.east_north_m
            squared = np.einsum("ni,nij,nj->n", off, np.linalg.pinv(np.nan_to_num(found.covariance_m2)), off)
            error[half] = (found.distance_m / far - 1)[half]
            covered[half] = np.where(np.isfinite(found.covariance_m2[:, 0, 0]), squared < 5.991, np.nan)[half]
            heights.append(height)
        error[people.cut] = np.nan
        known = np.isfinite(error)
        figures[way] = {
            "people": int(known.sum()),
            "median": float(np.median(np.abs(error[known]))),
            "bias": float(error[known].mean()),
            "middle": float(np.median(error[known])),
            "coverage": float(np.nanmean(covered[known])) if np.isfinite(covered[known]).any() else np.nan,
            "body_height_m": float(np.mean(heights)),
        }
        errors[way] = error
    return figures, errors


def table(name: str, figures: dict[str, dict[str, float]]) -> str:
    """Markdown."""
    lines = [
        f"| {name} | people | median error | bias (mean) | bias (median) | inside the 95 % ellipse | body height |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for way, f in figures.items():
        inside = "–" if np.isnan(f["coverage"]) else f"{f['coverage']:.1%}"
        height = "–" if way == "foot row" else f"{f['body_height_m']:.2f} m"
        rest = f"{f['bias']:+.1%} | {f['middle']:+.1%} | {inside} | {height}"
        lines.append(f"| {way} | {f['people']} | {f['median']:.1%} | {rest} |")
    return "\n".join([*lines[:2], *(line.replace("%", " %") for line in lines[2:])])


def draw(parts: dict[str, tuple[np.ndarray, dict[str, np.ndarray]]], path: Path) -> None:
    """Median absolute error against distance, a panel each."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(parts), figsize=(6 * len(parts), 4), squeeze=False)
    for axis, (name, (far, errors)) in zip(axes[0], parts.items(), strict=True):
        bins = np.quantile(far, np.linspace(0, 1, 9))
        which = np.clip(np.searchsorted(bins, far, side="right") - 1, 0, len(bins) - 2)
        for way, error in errors.items():
            middle = [np.nanmedian(np.abs(error[which == n])) * 100 for n in range(len(bins) - 1)]
            axis.plot((bins[1:] + bins[:-1]) / 2, middle, "o-", ms=3, label=way)
        axis.set(title=name, xlabel="distance, m", ylabel="median error of the distance, %", ylim=(0, None))
        axis.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=100)


def main() -> None:
    """Measure, print, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of the sequences")
    parser.add_argument("--detections", type=Path, help="boxes of a detector on the PETS clip")
    parser.add_argument("--interval", type=int, default=1, help="frames from one of its frames to the next")
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--write", type=Path, help="a text whose marks <!-- ranging --> take the tables")
    options = parser.parse_args()
    tables, plots = [], {}
    for name, size in SIZES.items():
        folder = options.data / name
        if not (folder / "gt" / "gt.txt").is_file():
            print(f"{folder} has no gt/gt.txt: skipped", file=sys.stderr)
            continue
        truth = read_truth(folder, size)
        camera = tsai(folder / "View_001.xml") if name.startswith("PETS") else fitted(truth, size)
        print(
            f"{name}: camera {camera.height_m:.2f} m high, {np.degrees(camera.pitch_rad):.2f}° down, focal "
            f"{camera.focal_px[0]:.0f} px, at {camera.place[0]:.2f}, {camera.place[1]:.2f}"
        )
        kinds = {f"{name}, true boxes": truth}
        if name.startswith("PETS") and options.detections is not None:
            kinds[f"{name}, detections"] = detected(options.detections, options.interval, truth, size)
        for kind, people in kinds.items():
            figures, errors = measure(people, replace(camera, name=name))
            tables.append(table(kind, figures))
            plots[kind] = distance(people, camera), errors
            print(tables[-1] + "\n")
    if not tables:
        sys.exit("nothing to measure: no sequence with world positions was found")
    if options.plot:
        draw(plots, options.plot)
    if options.write:
        report.put(options.write, "ranging", "\n\n".join(tables))


if __name__ == "__main__":
    main()
