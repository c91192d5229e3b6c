"""What labelled pictures make of the ranges of landmarks' colours: `python eval/tune_colours.py [--repeats N]`.

Each repeat simulates scenes seen from 30 m, of four vehicles with plates of their own colours among people and cars, in
the light of a low, a middle and a high sun, with an exposure that drifts. Which pixels are a plate is known to the
pixel: the same scene is drawn again with the plates covered. Ranges are found in some scenes and judged, by the onboard
finder, in those and in others. Ways to find them: as `dddas colours` does, without labels; tuned by
`tuning.colours.fit_colours`; and the simulator's own, which know the paint. Told are the share of the plates' pixels
found, how many pixels a picture and colour are false, and F of all pixels. Prints Markdown.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import report

from torchvision_dddas.config import load_config
from torchvision_dddas.evaluation.metrics.pixels import ratio
from torchvision_dddas.geo.colour_calibration import build_ranges, find_samples, hue_difference, pool_samples, to_hsv
from torchvision_dddas.geo.colours import OpenCVColourFinder
from torchvision_dddas.simulation import CarPlan, CrowdPlan, Fault, Scenario, Shot, Simulator
from torchvision_dddas.simulation.ground_vehicles import marker_plates
from torchvision_dddas.tuning.colours import fit_colours
from torchvision_dddas.types import Colours

TEAM = 4
SUNS_DEG = (12.0, 35.0, 75.0)
QUALITY = 75
# A pixel is a plate's where covering it changes the picture by more than this, grey levels: most of it is plate.
_CHANGED = 20


@dataclass(frozen=True)
class Seen:
    """image: (H, W, 3) uint8 BGR. labels: (H, W), 0, or which plate, from 1."""

    image: np.ndarray
    labels: np.ndarray


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=4)
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--write", type=Path, help="a text with marks for the table")
    given = parser.parse_args()
    rows: dict[str, list[np.ndarray]] = {}
    for repeat in range(given.repeats):
        learned, other = (
            [one for k, sun in enumerate(SUNS_DEG) for one in scene(100 * repeat + 10 * part + k, sun)]
            for part in (0, 1)
        )
        for name, colours in ways(learned, given.steps).items():
            rows.setdefault(name, []).append(np.array([judged(colours, part) for part in (learned, other)]))
            told = " ".join(f"{value:.3f}" for value in rows[name][-1].ravel())
            print(f"repeat {repeat}, {name}: {told}", file=sys.stderr, flush=True)
    lines = table(rows)
    print("\n".join(lines))
    if given.write is not None:
        report.put(given.write, "tune_colours", "\n".join(lines))


def ways(learned: Sequence[Seen], steps: int) -> dict[str, Colours]:
    """Ranges by the way they were found."""
    names, _, own = marker_plates(TEAM)
    pictures, labels = [one.image for one in learned], [one.labels for one in learned]
    clicked = unlabelled(pictures, own)
    found = {"as `dddas colours` does": clicked} if clicked is not None else {}
    found["tuned"] = fit_colours(pictures, labels, names, steps)
    if clicked is not None:
        found["tuned, beginning with those of `dddas colours`"] = fit_colours(
            pictures, labels, names, steps, start=clicked
        )
    return {**found, "the simulator's own": own}


def unlabelled(pictures: Sequence[np.ndarray], own: Colours) -> Colours | None:
    """What `dddas colours --count 4` finds, in the order of the team; None where a colour does not stand out."""
    hsv, least = [to_hsv(picture) for picture in pictures], load_config().landmarks.least_area_px
    groups = pool_samples([find_samples(one, least, k) for k, one in enumerate(hsv)], TEAM)
    middle = own.low[:, 0] + 7
    order = [min(range(len(groups)), key=lambda k: abs(hue_difference(groups[k][0].hue, hue))) for hue in middle]
    if len(set(order)) < TEAM:
        return None
    low, high, _ = build_ranges([groups[k] for k in order], hsv, least)
    return Colours(own.names, low, high)


def judged(colours: Colours, pictures: Sequence[Seen]) -> tuple[float, float, float]:
    """Share of the plates' pixels found, false pixels a picture and colour, F; over all pictures and colours."""
    hit = told = true = 0
    for one in pictures:
        masks = OpenCVColourFinder().masks(one.image, colours.low, colours.high) > 0
        right = np.stack([one.labels == k + 1 for k in range(TEAM)])
        hit, told, true = hit + int((masks & right).sum()), told + int(masks.sum()), true + int(right.sum())
    return ratio(hit, true), (told - hit) / (TEAM * len(pictures)), ratio(2 * hit, told + true)


def scene(seed: int, sun_deg: float) -> list[Seen]:
    """A few pictures of a scene."""
    shown, covered = shots(seed, sun_deg, False), shots(seed, sun_deg, True)
    found = []
    for a, b in zip(shown, covered, strict=True):
        assert a.frame is not None and b.frame is not None, "no fault drops a picture"
        image = a.frame.image
        changed = np.abs(image.astype(int) - b.frame.image).max(axis=2) > _CHANGED
        labels = np.zeros(changed.shape, np.int64)
        for k, number in enumerate(a.truth.bodies.target[a.truth.bodies.kind == "ugv"].tolist(), 1):
            labels[changed & (a.truth.mask == number)] = k
        coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
        found.append(Seen(cv2.imdecode(coded, cv2.IMREAD_COLOR), labels))
    return found


def shots(seed: int, sun_deg: float, covered: bool) -> list[Shot]:
    """The scene's pictures, without compression."""
    usual = Scenario()
    faults = [Fault(what="landmark_hidden", vehicle=k + 1, time_s=0.0, seconds=1e3) for k in range(TEAM)]
    run = Simulator(
        usual.model_copy(
            update={
                "seed": seed,
                "world": usual.world.model_copy(update={"side_m": 120.0, "buildings": 0, "sun_height_deg": sun_deg}),
                "team": usual.team.model_copy(update={"ugvs": TEAM, "ring_m": 10.0}),
                "uav": usual.uav.model_copy(update={"altitude_m": 30.0}),
                "camera": usual.camera.model_copy(
                    update={"width_px": 480, "height_px": 360, "drift": 0.2, "quality": 100}
                ),
                "clip": usual.clip.model_copy(update={"seconds": 4.0, "rate_hz": 1.0}),
                "crowd": (CrowdPlan(people=8), CrowdPlan(people=6, start_m=(5.0, 6.0))),
                "car": (CarPlan(start_m=(-6.0, -6.0), speed_m_s=2.0), CarPlan(start_m=(8.0, -4.0), speed_m_s=1.0)),
                "fault": tuple(faults) if covered else (),
            }
        )
    )
    return list(iter(run.next, None))


def table(rows: dict[str, list[np.ndarray]]) -> list[str]:
    """Markdown: means over the repeats."""
    heads = "ranges | scenes | found | false pixels | F | least F"
    lines = [f"| {heads} |", "| --- | --- |" + " ---: |" * 4]
    for name, found in rows.items():
        values = np.stack(found)
        for k, part in enumerate(("learned from", "not learned from")):
            share, false, f = values[:, k].mean(axis=0)
            cells = f"{100 * share:.1f} % | {false:.1f} | {f:.3f} | {values[:, k, 2].min():.3f}"
            lines.append(f"| {name} | {part} | {cells} |")
    return lines


if __name__ == "__main__":
    main()
