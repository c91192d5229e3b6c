"""Whether rendered clips are as hard as real ones.

    python eval/sim_realism.py [DATA] [--frames 24] [--write eval/README.md]

DATA is a folder of clips (NAME/frames, NAME/masks or none). Simulated flights of several altitudes and pitches are
drawn at the size of the real clips from a UAV, uav123_*, and both go through the project's onboard engine: successive
frames are registered, keypoints are followed, and what is left of the difference of the two frames is looked at. Then
the detector runs on what holds no movers: uav123_building4, and the flights, over ground on which nothing moves.
Clips of hand-held cameras, bms_*, stand beside them for comparison; nothing is judged by them.

A statistic fits where the middle of the simulated flights is within a factor of 2 of the real UAV clips, their
smallest or their largest; false blobs fit as well where both have at most 0.2 a frame. Without DATA the simulated
flights alone are measured.
"""

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import report

from torchvision_dddas.config import Settings
from torchvision_dddas.detection import cell_side, detect_motion, load_engine
from torchvision_dddas.detection.opencv_registration import detect_keypoints
from torchvision_dddas.geometry import transfer
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.simulation import (
    AircraftParameters,
    CameraParameters,
    ClipParameters,
    Scenario,
    SimulatorSource,
    TeamParameters,
    WorldParameters,
)
from torchvision_dddas.types import Frame

FLIGHTS = ((50.0, 90.0, 0), (50.0, 45.0, 1), (100.0, 60.0, 2), (200.0, 90.0, 3), (20.0, 35.0, 4))
"""Altitude in metres, pitch in degrees below the horizon, and the seed."""

STATISTICS = {
    "residual_median": ("residual of inliers, px, median", 3),
    "residual_p90": ("residual of inliers, px, 90 %", 3),
    "inliers": ("share of inliers", 3),
    "followed": ("share of keypoints that were followed", 3),
    "keypoints": ("share of cells that have a keypoint", 3),
    "difference_median": ("difference after registration, grey levels, median", 2),
    "difference_p90": ("difference, 90 %", 2),
    "difference_p99": ("difference, 99 %", 2),
    "false_blobs": ("false blobs a frame where nothing moves", 3),
}
FEW_BLOBS = 0.2  # a frame: so many are few enough whatever the ratio
_CUT_PX = 8  # of the border, which the other frame may not hold


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="of real clips")
    parser.add_argument("--frames", type=int, default=24, help="of each clip")
    parser.add_argument("--size", default="1280x720", help="of the simulated pictures")
    parser.add_argument("--write", type=Path, help="a text file with the sim-realism marks")
    parser.add_argument("--pictures", type=Path, help="a folder for the middle frame of each simulated flight")
    options = parser.parse_args()
    size = tuple(int(side) for side in options.size.split("x"))
    real = clips(options.folder)
    if not real:
        print(f"no real clips in {options.folder}: nothing to compare the simulated flights with", file=sys.stderr)
    columns: dict[str, dict[str, float]] = {}
    for place in real:
        frames = list(first(open_source(place / "frames"), options.frames))
        columns[place.name] = statistics(frames)
        if place.name == "uav123_building4":
            columns[place.name]["false_blobs"] = blobs(Clip(list(open_source(place / "frames"))))
        said(place.name, columns[place.name])
    for altitude, pitch, seed in FLIGHTS:
        name = f"sim {altitude:g} m, {pitch:g}°"
        frames = list(first(SimulatorSource(flight(altitude, pitch, seed, size, options.frames)), options.frames))
        if options.pictures:
            options.pictures.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(options.pictures / f"{altitude:g}_{pitch:g}.png"), frames[len(frames) // 2].image)
        columns[name] = statistics(frames)
        columns[name]["false_blobs"] = blobs(Clip(frames))
        said(name, columns[name])
    text = table(columns)
    print(text)
    if options.write:
        report.put(options.write, "sim-realism", text)


def clips(folder: Path | None) -> list[Path]:
    """The clips of a real camera in a folder, those from UAVs first."""
    if folder is None or not folder.is_dir():
        return []
    return [
        place for kind in ("uav123_*", "bms_*") for place in sorted(folder.glob(kind)) if (place / "frames").is_dir()
    ]


def first(source: Iterable[Frame], count: int) -> Iterator[Frame]:
    """The first frames of a source, no more of them read or drawn."""
    for frame, _ in zip(source, range(count), strict=False):
        yield frame


# -- simulated flights ------------------------------------------------------------------------------------------------


def flight(altitude_m: float, pitch_deg: float, seed: int, size: Sequence[int], frames: int) -> Scenario:
    """A flight over ground on which nothing moves."""
    side = float(np.clip(3 * altitude_m, 160, 600))
    return Scenario(
        seed=seed,
        clip=ClipParameters(seconds=frames / 10, located_by="nothing"),
        world=WorldParameters(side_m=side, texel_m=0.05 if altitude_m < 40 else 0.1),
        uav=AircraftParameters(altitude_m=altitude_m, pitch_deg=pitch_deg, way_m=((30.0, 10.0),)),
        camera=CameraParameters(width_px=size[0], height_px=size[1]),
        team=TeamParameters(ugvs=0),
    )


# -- statistics -------------------------------------------------------------------------------------------------------


def statistics(frames: Sequence[Frame]) -> dict[str, float]:
    """Medians over the pairs of successive frames."""
    settings = Settings()
    engine = load_engine("onboard", settings)
    rows = []
    for earlier, later in pairwise(frames):
        views = engine.prepare(earlier.image), engine.prepare(later.image)
        found = engine.register([views])[0]
        if found.reliable:
            rows.append(followed(views[0].grey, views[1].grey, found.later_from_earlier, settings))
    if not rows:
        return {}
    return {name: float(np.median([row[name] for row in rows])) for name in rows[0]}


def followed(
    earlier: np.ndarray, later: np.ndarray, later_from_earlier: np.ndarray, settings: Settings
) -> dict[str, float]:
    """Keypoints of the earlier frame in the later one, and the difference of the two once they are registered."""
    parameters = settings.registration
    start = detect_keypoints(earlier, parameters)
    guess = transfer(later_from_earlier, start).astype(np.float32)
    search = {"winSize": (21, 21), "maxLevel": 1, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    end, seen, _ = cv2.calcOpticalFlowPyrLK(earlier, later, start, guess.copy(), **search)
    back, again, _ = cv2.calcOpticalFlowPyrLK(later, earlier, end, start.copy(), **search)
    height, width = later.shape
    inside = ((guess >= 0) & (guess <= (width - 1, height - 1))).all(axis=1)
    kept = inside & (seen.ravel() == 1) & (again.ravel() == 1) & (np.linalg.norm(back - start, axis=1) < 1)
    miss = np.linalg.norm(guess - end, axis=1)[kept]
    inliers = miss < parameters.ransac_px
    size = (width, height)
    moved = cv2.warpPerspective(earlier.astype(np.float32), later_from_earlier, size, flags=cv2.INTER_CUBIC)
    whole = cv2.warpPerspective(np.full_like(earlier, 255), later_from_earlier, size)
    whole = cv2.erode(whole, np.ones((2 * _CUT_PX + 1,) * 2, np.uint8), borderValue=0) > 0
    gain = float((later[whole].mean() + 1) / (moved[whole].mean() + 1))
    difference = np.abs(later[whole] - gain * moved[whole])
    cell = cell_side(width, height, parameters)
    return {
        "residual_median": float(np.median(miss[inliers])),
        "residual_p90": float(np.percentile(miss[inliers], 90)),
        "inliers": float(inliers.mean()),
        "followed": float(kept.sum() / max(inside.sum(), 1)),
        "keypoints": float(len(start) / ((width // cell) * (height // cell))),
        **{f"difference_{name}": float(np.percentile(difference, at))
           for name, at in (("median", 50), ("p90", 90), ("p99", 99))},
    }  # fmt: skip


@dataclass(frozen=True)
class Clip:
    """Frames at hand, as `run` wants them."""

    frames: list[Frame]
    rate_hz: float = 10.0

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)


def blobs(clip: Clip) -> float:
    """What the detector finds in a frame, in the mean."""
    settings = Settings()
    counts = [len(scene.detections) for scene in detect_motion(clip, settings, "onboard")]
    return float(np.mean(counts))


# -- the table --------------------------------------------------------------------------------------------------------


def said(name: str, found: dict[str, float]) -> None:
    """A line for who waits."""
    print(name, *(f"{key} {value:.3g}" for key, value in found.items()), sep="; ", file=sys.stderr, flush=True)


def table(columns: dict[str, dict[str, float]]) -> str:
    """Markdown: a statistic a row; real clips, simulated flights, and whether they are alike."""
    drones, flights = ([name for name in columns if name.startswith(kind)] for kind in ("uav123", "sim"))
    hands = [name for name in columns if name.startswith("bms")]
    rows = []
    for key, (words, digits) in STATISTICS.items():
        values = {name: found[key] for name, found in columns.items() if key in found}

        def some(names: Sequence[str], values: dict[str, float] = values, digits: int = digits) -> str:
            there = [values[name] for name in names if name in values]
            if not there:
                return "–"
            low, middle, high = (f"{x:.{digits}f}" for x in (min(there), np.median(there), max(there)))
            return middle if len(there) == 1 else f"{middle} ({low}–{high})"

        ratio, fits = alike(
            key, [values[n] for n in drones if n in values], [values[n] for n in flights if n in values]
        )
        rows.append([words, some(drones), some(hands), some(flights), ratio, fits])
    head = ["median (smallest–largest) of the clips", "real, UAV", "real, hand-held", "simulated", "ratio", "within 2"]
    lines = [head, ["---"] + ["---:"] * (len(head) - 1), *rows]
    flown = ", ".join(f"{altitude:g} m at {pitch:g}°" for altitude, pitch, _ in FLIGHTS)
    named = f"Real: {', '.join(drones)}; hand-held: {', '.join(hands)}. " if drones or hands else ""
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + f"\n\n{named}Simulated: {flown}."


def alike(key: str, real: Sequence[float], simulated: Sequence[float]) -> tuple[str, str]:
    """The ratio of the simulated flights' median to the nearest of the real ones' range, and the verdict."""
    if not real or not simulated:
        return "–", "–"
    middle = float(np.median(simulated))
    nearest = float(np.clip(middle, min(real), max(real)))
    if key == "false_blobs" and max(middle, nearest) <= FEW_BLOBS:
        return "–", "yes: both few"
    ratio = middle / nearest if nearest > 0 else float("inf")
    return f"{ratio:.2f}", "yes" if 0.5 <= ratio <= 2 else "no"


if __name__ == "__main__":
    main()
