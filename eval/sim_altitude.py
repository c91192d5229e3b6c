"""Places of crowds from rendered video by altitude: the source's experiment of figure 7, and the whole chain's errors.

    python eval/sim_altitude.py --jobs 2 --cache FILE --write eval/README.md --plot docs/sim_altitude.png

For each seed and altitude a clip is drawn, searched for what moves, and located by four landmarks that are found by
their colours and motion; once with their exact places, once with receivers of 3.5 m in 95 %. Two crowds walk through
the ring of landmarks, a car passes. The errors are those of CrowdScore: of each located target from the people in its
box, and of each crowd from what was located of it, in one piece, in several, or together with another. "picture" is how
far off the picture itself lies on the ground where the crowds are: landmarks and telemetry alone, without detection.
"""

import sys
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from sim_runs import Case, Over, finish, options, pyplot, run_all, table
from sim_scenes import Way, located, walking

WAYS = (Way("exact"), Way("3.5 m", gps95_m=3.5))
SOURCE = {50.0: 1.3, 200.0: 3.5}
"""The source's mean errors in metres, simulated (appendix A, figure 7)."""


def work(case: Case) -> Case:
    """One clip, located in both ways."""
    scenario = walking(
        case["seed"], case["seconds"],
        uav={"altitude_m": case["altitude_m"]},
        camera={"width_px": case["size"][0], "height_px": case["size"][1]},
    )  # fmt: skip
    return {name: parts[0] for name, parts in located(scenario, WAYS).items()}


def figure(results: list[Case], way: str, *names: str) -> Over:
    """A figure over seeds, by the names of its field and what is in it."""

    def value(result: Case) -> float | None:
        here = result[way]
        for name in names:
            here = here[name]
        return here

    return Over(value(result) for result in results)


def tables(found: dict[float, list[Case]]) -> str:
    """Errors, then what was found."""
    errors = table(
        [
            "AGL m",
            "GPS",
            "targets: mean error m",
            "median",
            "95 %",
            "in 95 % ellipses",
            "crowds: mean error m",
            "picture m",
            "source",
        ],
        [
            [
                f"{altitude:g}",
                way.name,
                figure(results, way.name, "target_error_m", "mean").text(),
                figure(results, way.name, "target_error_m", "median").text(spread=False),
                figure(results, way.name, "target_error_m", "p95").text(spread=False),
                figure(results, way.name, "inside").text(0, 100, spread=False) + " %",
                figure(results, way.name, "crowd_error_m", "mean").text(),
                figure(results, way.name, "picture_m").text(),
                f"{SOURCE[altitude]:g}" if altitude in SOURCE and way.name == "exact" else "–",
            ]
            for altitude, results in found.items()
            for way in WAYS
        ],
        words=2,
    )
    seen = table(
        ["AGL m", "recall %", "of moving crowds %", "detected %", "false blobs a frame", "landmarks taken for targets"],
        [
            [
                f"{altitude:g}",
                *(figure(results, "exact", name).text(1, 100) for name in ("recall", "recall_moving", "detected")),
                *(figure(results, "exact", name).text() for name in ("false_blobs", "landmark_blobs")),
            ]
            for altitude, results in found.items()
        ],
    )
    return errors + "\n\n" + seen


def draw(found: dict[float, list[Case]], path: Path) -> None:
    """Errors of each seed and their means, by altitude."""
    plt = pyplot()
    figures, axes = plt.subplots(1, 2, figsize=(9, 3.8), constrained_layout=True, sharey=True)
    for axis, way in zip(axes, WAYS, strict=True):
        for place, (altitude, results) in enumerate(found.items()):
            over = figure(results, way.name, "target_error_m", "mean")
            axis.plot([place] * len(over.values), over.values, "o", color="#0b6e99", alpha=0.25, ms=4)
            axis.errorbar(place, over.mean, over.error, fmt="o", color="#0b6e99", ms=7, capsize=4,
                          label="mean ± standard error; each seed" if place == 0 else None)  # fmt: skip
            if altitude in SOURCE and way.name == "exact":
                axis.plot(place, SOURCE[altitude], "D", color="#d9730d",
                          label="source" if altitude == min(SOURCE) else None)  # fmt: skip
        title = "exact places" if way.name == "exact" else f"GPS, {way.name} in 95 %"
        axis.set(xlabel="altitude above ground, m", title=f"landmarks: {title}", xlim=(-0.5, len(found) - 0.5))
        axis.set_xticks(range(len(found)), [f"{altitude:g}" for altitude in found])
        axis.set_ylim(bottom=0)
    axes[0].set_ylabel("mean error of a target's place, m")
    axes[0].legend(frameon=False)
    figures.suptitle("Crowds located from rendered video", fontsize=13, weight="bold")
    figures.savefig(path, dpi=110)


def main() -> None:
    """Run what is missing, print the tables, and write what was asked for."""
    parser = options(__doc__, seeds=20, seconds=15.0)
    parser.add_argument("--altitudes", type=float, nargs="+", default=[50.0, 100.0, 200.0], metavar="M")
    parser.add_argument("--size", default="640x480", help="of the pictures; 640x480")
    asked = parser.parse_args()
    size = [int(side) for side in asked.size.split("x")]
    cases = [
        {"seed": seed, "altitude_m": altitude, "seconds": asked.seconds, "size": size}
        for seed in range(asked.seeds)
        for altitude in asked.altitudes
    ]
    results = run_all(cases, work, asked.cache, asked.jobs)
    found = {
        altitude: [r for c, r in zip(cases, results, strict=True) if c["altitude_m"] == altitude]
        for altitude in asked.altitudes
    }
    sums = {
        f"{altitude:g} m, {way.name}": {
            "target_error_m": figure(here, way.name, "target_error_m", "mean").as_json(),
            "picture_m": figure(here, way.name, "picture_m").as_json(),
            "crowd_error_m": figure(here, way.name, "crowd_error_m", "mean").as_json(),
            "recall": figure(here, way.name, "recall").as_json(),
            "false_blobs": figure(here, way.name, "false_blobs").as_json(),
        }
        for altitude, here in found.items()
        for way in WAYS
    }
    note = f"{asked.seeds} seeds, {asked.seconds:g} s each, {asked.size} px: mean ± standard error (range over seeds)."
    runs = [{**case, "scores": result} for case, result in zip(cases, results, strict=True)]
    figures = {"figures": sums, "runs": runs}
    finish(asked, "sim-altitude", tables(found) + "\n\n" + note, figures, partial(draw, found))


if __name__ == "__main__":
    main()
