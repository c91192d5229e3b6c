"""Detection of crowds against the sizes of the kernels that clean the silhouette: the source's figure 8 of appendix B.

    python eval/sim_kernels.py --jobs 2 --cache FILE --write eval/README.md --plot docs/sim_kernels.png

Each clip is drawn once and searched for what moves with each kernel. Precision, recall and F are those of pixels,
pooled over a clip, against what truly shows of people and vehicles, their shadows not among it: whoever finds shadows
has less precision for it. Beside them, the share of crowds that any blob covers, and blobs a frame that touch nothing.
`morphology.erode_px` is varied with the usual closing, then `morphology.close_px` with the usual erosion.
"""

import sys
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import numpy as np
from sim_runs import Case, Over, finish, options, pyplot, run_all, table
from sim_scenes import Kept, usual, walking

from torchvision_dddas.detection import detect_motion
from torchvision_dddas.evaluation.metrics import pixels as segmentation
from torchvision_dddas.evaluation.metrics.crowds import CrowdScorer
from torchvision_dddas.simulation import SimulatorSource
from torchvision_dddas.types import FrameResult, TrackedFrame, Tracks

KERNELS = {"morphology.erode_px": (1, 2, 3, 4, 5, 7), "morphology.close_px": (1, 7, 13, 19, 25, 31, 41)}
FIXED: dict[str, Case] = {"morphology.erode_px": {}, "morphology.close_px": {"morphology.close_m": 0.0}}
"""What is set beside a kernel: a closing in metres would hide that in pixels."""

SKIPPED = 10
"""Frames at the beginning that do not count: there is no past yet."""


def work(case: Case) -> Case:
    """One clip with all kernels."""
    scenario = walking(
        case["seed"], case["seconds"],
        uav={"altitude_m": case["altitude_m"]},
        camera={"width_px": case["size"][0], "height_px": case["size"][1]},
    )  # fmt: skip
    source = SimulatorSource(scenario)
    clip = Kept(source)
    found = {}
    for parameter, sizes in KERNELS.items():
        for size in sizes:
            settings = usual(source, {"crowds.join_m": 0.0, **FIXED[parameter], **case["set"], parameter: size})
            pixels, scorer = segmentation.Pixels(), CrowdScorer()
            for scene in detect_motion(clip, settings, "onboard", clip.log):
                number = scene.frame.number
                if number <= SKIPPED:
                    continue
                truth = clip.truths[number]
                pixels = pixels.plus(segmentation.count(scene.mask, truth.mask))
                rows = np.arange(len(scene.detections))
                tracks = Tracks(number, rows + 1, scene.detections.box_px, scene.detections.score, rows)
                scorer.feed(truth)
                scorer.feed(FrameResult(TrackedFrame(number, scene.frame, scene.detections, tracks)))
            score = scorer.score()
            more = {"detected": score.detected, "false_blobs": score.false_blobs}
            found[f"{parameter} {size}"] = {**segmentation.measures(pixels), **more}
    return found


def over(results: list[Case], parameter: str, size: int, name: str) -> Over:
    """A figure over seeds."""
    return Over(result[f"{parameter} {size}"][name] for result in results)


def tables(results: list[Case]) -> str:
    """A row a kernel."""
    names = ("precision", "recall", "f", "detected")
    return table(
        ["kernel", "px", "precision %", "recall %", "F %", "crowds detected %", "false blobs a frame"],
        [
            [
                f"`{parameter}`",
                str(size),
                *(over(results, parameter, size, name).text(1, 100) for name in names),
                over(results, parameter, size, "false_blobs").text(),
            ]
            for parameter, sizes in KERNELS.items()
            for size in sizes
        ],
    )


def draw(results: list[Case], path: Path) -> None:
    """A panel a kernel."""
    plt = pyplot()
    figure, axes = plt.subplots(1, 2, figsize=(9.5, 3.8), constrained_layout=True, sharey=True)
    shown = {"precision": "#d9730d", "recall": "#0b6e99", "f": "#444444", "detected": "#448361"}
    for axis, (parameter, sizes) in zip(axes, KERNELS.items(), strict=True):
        for name, colour in shown.items():
            overs = [over(results, parameter, size, name) for size in sizes]
            label = {"f": "F", "detected": "crowds detected"}.get(name, name)
            axis.errorbar(sizes, [100 * o.mean for o in overs], [100 * np.nan_to_num(o.error) for o in overs],
                          fmt="o-", color=colour, ms=4, capsize=3, label=label)  # fmt: skip
        axis.set(xlabel=f"{parameter}, px", ylim=(0, 102))
        axis.set_xticks(sizes)
    axes[0].set_ylabel("%")
    axes[1].legend(frameon=False)
    figure.suptitle("Pixels and crowds found against kernel sizes", fontsize=13, weight="bold")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run what is missing, print the tables, and write what was asked for."""
    parser = options(__doc__, seeds=20, seconds=8.0)
    parser.add_argument("--altitude", type=float, default=50.0, metavar="M")
    parser.add_argument("--size", default="640x480", help="of the pictures; 640x480")
    parser.add_argument("--set", action="append", default=[], metavar="KNOB=VALUE", help="other settings")
    asked = parser.parse_args()
    from torchvision_dddas.config import parse_override

    size, parameters = [int(side) for side in asked.size.split("x")], dict(map(parse_override, asked.set))
    cases = [
        {"seed": seed, "altitude_m": asked.altitude, "seconds": asked.seconds, "size": size, "set": parameters}
        for seed in range(asked.seeds)
    ]
    results = run_all(cases, work, asked.cache, asked.jobs)
    note = (
        f"{asked.seeds} seeds, {asked.seconds:g} s each at {asked.altitude:g} m, {asked.size} px: mean ± standard "
        "error (range over seeds)."
    )
    runs = [{**case, "found": result} for case, result in zip(cases, results, strict=True)]
    finish(asked, "sim-kernels", tables(results) + "\n\n" + note, {"runs": runs}, partial(draw, results))


if __name__ == "__main__":
    main()
