"""Centres of landmarks by colour or by motion, four landmarks or six: the source's experiments of figures 8 and 9.

    python eval/sim_landmarks.py --jobs 2 --cache FILE --write eval/README.md --plot docs/sim_landmarks.png

Six ground vehicles gather about two crowds, fast until t = 15 and slow from then on, as the source's do. Each clip is
drawn and searched for what moves once; the same detections are then located in every way: with all six or with four of
them, by the centres of their colours or of what moves, with exact places or receivers of 3.5 m in 95 %, by the camera's
pose or by a bare homography (`landmarks.centre`, `aerial.mode`). So ways differ in nothing but what is compared, and
differences are told for pairs: of one seed each. "picture" is how far off the picture lies on the ground where the
crowds are, which is all that landmarks decide; "targets" are those found in it, from the people in their boxes.
"""

import sys
from functools import partial
from itertools import product
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from sim_runs import Case, Over, finish, options, pyplot, run_all, table
from sim_scenes import Way, located, walking

FOUR = (0, 1, 3, 4)
"""Of six that stand in a ring: a rectangle."""

SLOW_S = 15.0
"""When the vehicles slow down."""

GPS = {"exact": 0.0, "3.5 m": 3.5}
MODES = ("pose", "homography")
PARTS = ("fast", "slow")


def name_of(mode: str, centre: str, count: int, gps: str) -> str:
    """Of a way."""
    return f"{mode}, {centre}, {count}, {gps}"


WAYS = [
    Way(
        name_of(mode, centre, count, gps),
        FOUR if count == 4 else (),
        error95_m,
        {"aerial.mode": mode, "landmarks.centre": centre},
    )
    for gps, error95_m in GPS.items()
    for mode in MODES
    for centre in ("colour", "motion")
    for count in (4, 6)
]


def work(case: Case) -> Case:
    """One clip, located in all ways, in two parts."""
    scenario = walking(
        case["seed"], case["seconds"],
        uav={"altitude_m": case["altitude_m"]},
        team={"ugvs": 6, "patrol": "gather", "ring_m": case["ring_m"]},
    )  # fmt: skip
    scores = located(scenario, WAYS, parts_s=(SLOW_S,))
    return dict(scores)


KINDS = ("picture", "targets")


def errors(results: list[Case], way: str, part: int, kind: str = "picture") -> list[float | None]:
    """Mean errors of each seed, m: of the picture on the ground, or of the targets located in it."""
    parts = [result[way][part] for result in results]
    return [here["picture_m"] if kind == "picture" else here["target_error_m"]["mean"] for here in parts]


def gain(results: list[Case], way: str, other: str, part: int, kind: str) -> Over:
    """How much less the errors of a way are than those of the other, seed by seed; in metres."""
    pairs = zip(errors(results, way, part, kind), errors(results, other, part, kind), strict=True)
    return Over(b - a for a, b in pairs if a is not None and b is not None)


def tables(results: list[Case]) -> str:
    """Errors of all ways, then the two differences that the source asks for."""
    rows = []
    for gps, mode, centre, count in product(GPS, MODES, ("colour", "motion"), (4, 6)):
        way = name_of(mode, centre, count, gps)
        cells = [Over(errors(results, way, part, kind)).text() for kind in KINDS for part in range(2)]
        rows.append([gps, mode, centre, str(count), *cells])
    head = [f"{kind}, {part}: m" for kind in KINDS for part in PARTS]
    whole = table(["GPS", "by", "centres", "landmarks", *head], rows, words=3)
    rows = []
    for gps, mode, (part, name), kind in product(GPS, MODES, enumerate(PARTS), KINDS):

        def less(centre: str, count: int, than: tuple[str, int], *, of: tuple[str, str, int, str]) -> str:
            gps, mode, part, kind = of
            way, other = name_of(mode, centre, count, gps), name_of(mode, *than, gps)
            return gain(results, way, other, part, kind).text(3)

        of = gps, mode, part, kind
        motion = [less("motion", count, ("colour", count), of=of) for count in (4, 6)]
        six = [less(centre, 6, (centre, 4), of=of) for centre in ("colour", "motion")]
        rows.append([gps, mode, name, kind, *motion, *six])
    pairs = table(
        ["GPS", "by", "part", "of", "motion over colour, four: m", "six", "six over four, colour: m", "motion"],
        rows,
        words=4,
    )
    return f"{whole}\n\nBy how much the error is less, in pairs of one seed; above 0 the first is better:\n\n{pairs}"


def draw(results: list[Case], path: Path) -> None:
    """Means of all ways, by part of the run."""
    plt = pyplot()
    figure, axes = plt.subplots(2, 2, figsize=(9.5, 6.4), constrained_layout=True, sharex=True)
    kinds = [("colour", 4), ("colour", 6), ("motion", 4), ("motion", 6)]
    for row, mode in enumerate(MODES):
        for column, gps in enumerate(GPS):
            axis = axes[row, column]
            for part, colour in enumerate(("#d9730d", "#0b6e99")):
                for place, (centre, count) in enumerate(kinds):
                    over = Over(errors(results, name_of(mode, centre, count, gps), part))
                    at = place + 0.2 * (part - 0.5)
                    axis.plot([at] * len(over.values), over.values, "o", color=colour, alpha=0.2, ms=3)
                    axis.errorbar(at, over.mean, over.error, fmt="o", color=colour, ms=6, capsize=3,
                                  label=f"vehicles {PARTS[part]}" if place == 0 else None)  # fmt: skip
            title = "exact places" if gps == "exact" else f"GPS, {gps} in 95 %"
            axis.set(title=f"{mode}, {title}")
            axis.set_xticks(range(4), [f"{centre}\n{count}" for centre, count in kinds])
            top = max(Over(errors(results, name_of(mode, c, n, gps), part)).mean for c, n in kinds for part in range(2))
            axis.set_ylim(0, 1.8 * top if top > 0 else None)
    for axis in axes[:, 0]:
        axis.set_ylabel("error of the picture at the crowds, m")
    axes[0, 0].legend(frameon=False)
    figure.suptitle("Centres of landmarks by colour and by motion, four and six of them", fontsize=13, weight="bold")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run what is missing, print the tables, and write what was asked for."""
    parser = options(__doc__, seeds=20, seconds=30.0)
    parser.add_argument("--altitude", type=float, default=50.0, metavar="M")
    parser.add_argument("--ring", type=float, default=18.0, metavar="M", help="radius of the vehicles' ring at first")
    asked = parser.parse_args()
    cases = [
        {"seed": seed, "altitude_m": asked.altitude, "ring_m": asked.ring, "seconds": asked.seconds}
        for seed in range(asked.seeds)
    ]
    results = run_all(cases, work, asked.cache, asked.jobs)
    note = (
        f"{asked.seeds} seeds, {asked.seconds:g} s each at {asked.altitude:g} m: mean ± standard error (range over "
        f"seeds); the vehicles are fast until {SLOW_S:g} s."
    )
    runs = [{**case, "scores": result} for case, result in zip(cases, results, strict=True)]
    finish(asked, "sim-landmarks", tables(results) + "\n\n" + note, {"runs": runs}, partial(draw, results))


if __name__ == "__main__":
    main()
