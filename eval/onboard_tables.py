"""What a frame costs onboard and how late live results are: tables for the READMEs, and one picture.

usage: python eval/onboard_tables.py SPEED.json LIVE.json [PEOPLE.json] [--readme README.md] [--details eval/README.md]
       [--plot docs/onboard.png]

SPEED is made by onboard_speed.py --json, LIVE and PEOPLE by live_latency.py --json. The texts need the marks `onboard`.
"""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
import machine
import report
import results
from chains import ONBOARD, STAGES, TURN
from sim_runs import pyplot, table

Figures = dict[str, Any]
GOAL_MS, GOALS = 80.0, (0.3, 0.2)
COLOURS = {
    "plain": "#888888",
    "onboard fast": "#448361",
    "onboard half": "#0b6e99",
    "onboard default": "#d9730d",
    "graph step": "#37352f",
    "torch fast b1": "#b39ddb",
    "torch fast b8": "#6940a5",
    "torch default b1": "#e8a0bf",
    "torch default b8": "#ad1a72",
}
STAGE_COLOURS = dict(zip(STAGES, ("#c9c5bd", "#0b6e99", "#448361", "#d9730d"), strict=True))


def summary(speed: Figures, live: Figures, people: Figures | None) -> str:
    """For the README: whole chains and live runs."""
    return "\n\n".join([chains_table(speed), live_table(live), *([live_table(people)] if people else [])])


def details(speed: Figures, live: Figures, people: Figures | None) -> str:
    """For eval/README.md: all of it."""
    parts = [chains_table(speed), stages_table(speed), targets_table(speed), memory_table(speed)]
    return "\n\n".join(
        [*(p for p in parts if p), live_table(live, True), *([live_table(people, True)] if people else [])]
    )


def conditions(figures: Figures, others: float) -> str:
    """What was measured where, and how busy it was."""
    first = ", and these runs went before them" if figures.get("realtime") else ""
    return f"{machine.in_words(figures['machine'])}; {machine.load_in_words(others)}{first}"


def busiest(speed: Figures) -> float:
    """How many cores others took while most was measured."""
    return max((clip["others"] for clip in speed["clips"].values()), default=math.nan)


def chains_table(speed: Figures) -> str:
    """A row a chain, a column a clip."""
    clips = speed["clips"]
    if not clips:
        return ""
    names = list(dict.fromkeys(name for clip in clips.values() for name in clip["chains"]))
    rows = [[name, *(_cost(clip["chains"].get(name)) for clip in clips.values())] for name in names]
    about = f"{conditions(speed, busiest(speed))}. Milliseconds a frame by the clock, processor milliseconds over all "
    about += "threads / their ratio to the plain chain's in the same turn (quartiles); medians of "
    about += f"{speed['rounds']} turns of {TURN} frames:"
    return f"{about}\n\n{table(['chain', *map(_title, clips)], rows)}"


def _cost(row: Figures | None) -> str:
    if row is None:
        return "–"
    spread = f"{row['processor_ratio_25']:.2f}–{row['processor_ratio_75']:.2f}"
    return f"{row['median_ms']:.1f}, {row['processor_ms']:.1f} / {row['processor_ratio']:.2f} ({spread})"


def _title(clip: str) -> str:
    name, _, size = clip.rpartition(" ")
    return (f"{name}, " * (name != "scene")) + size.replace("x", "×")


def stages_table(speed: Figures) -> str:
    """Processor time of the stages, and how far they are from what memory allows."""
    rows, rates = [], []
    for clip, found in speed["clips"].items():
        rates.append(f"{_title(clip)}: {found['copy_gb_s']['large']:.1f}")
        for name, figures in found["chains"].items():
            of = figures["stages"]
            cells = [f"{of[s]['processor_ms']:.2f} ({of[s]['processor_ms'] / of[s]['limit_ms']:.0f})" for s in STAGES]
            whole = f"{figures['processor_ms']:.1f} ({figures['over_limit']:.0f})"
            rows.append([_title(clip), name, *cells, whole])
    if not rows:
        return ""
    about = (
        "Processor milliseconds a frame by stage, and in brackets how many times as long as one core needs to move the "
    )
    about += (
        "bytes that the stage must read and write at least once (4, 2, 4 and 2 a pixel), at the speed with which it "
    )
    about += f"copied blocks of 256 MB between the turns (GB/s, reading and writing: {'; '.join(rates)}); of "
    about += "`graph step` the registration is in its foreground:"
    return f"{about}\n\n{table(['clip', 'chain', *STAGES, 'whole'], rows, words=2)}"


def targets_table(speed: Figures) -> str:
    """Cost against the number of targets."""
    if "targets" not in speed:
        return ""
    found = speed["targets"]
    counts = list(found["chains"]["plain"])
    rows = [
        [name, *(f"{by[c]['processor_ms']:.1f} ({by[c]['targets']:.0f})" for c in counts)]
        for name, by in found["chains"].items()
    ]
    about = f"Processor milliseconds a frame of {found['size'][0]}×{found['size'][1]} with so many movers added to the "
    about += "scene's seven, and in brackets how many targets were found "
    about += f"({machine.load_in_words(found['others'])}):"
    return f"{about}\n\n{table(['chain', *(f'+{c}' for c in counts)], rows)}"


def memory_table(speed: Figures) -> str:
    """Peak memory of processes."""
    if "memory" not in speed:
        return ""
    sizes = speed["memory"]
    names = list(dict.fromkeys(name for by in sizes.values() for name in by))
    rows = [[name, *(f"{by[name]['peak_mb']:.0f}" if name in by else "–" for by in sizes.values())] for name in names]
    about = "Peak memory in MB of a process that takes one chain through a video; `nothing` reads it only:"
    return f"{about}\n\n{table(['chain', *(size.replace('x', '×') for size in sizes)], rows)}"


def live_table(live: Figures, ages: bool = False) -> str:
    """A row a setting."""
    head = ["clip", "configuration", "frames/s", "cores", "latency 50 / 95 / 99 %, ms", "dropped", "processor ms"]
    head += ["first result, s", "MB"] + ["age 50 / 99 %, ms", "growth, ms a minute", "waited", "every"] * ages
    rows = []
    for run in live["runs"]:
        config = run["config"] + ", people" * run["people"]
        row = [_title(run["clip"]), config, f"{run['rate_hz']:g}", str(run["cores"])]
        row += [_three(run, "latency"), f"{_number(run, 'dropped')} of {_number(run, 'captured')}"]
        row += [_number(run, "processor_ms", 1), _number(run, "first_result_s", 2), _number(run, "peak_mb")]
        if ages:
            row += [f"{_number(run, 'age_p50_ms')} / {_number(run, 'age_p99_ms')}", _number(run, "growth_ms_a_minute")]
            row += [_number(run, "waited", 2), _number(run, "every")]
        rows.append(row)
    about = f"`dddas run --live`, {conditions(live, live['others'])}; {live['seconds']:g} s each, medians over "
    about += f"{max((run['rounds'] for run in live['runs']), default=0)} rounds (99 %: lowest to highest):"
    return f"{about}\n\n{table(head, rows, words=2)}"


def _number(run: Figures, name: str, digits: int = 0) -> str:
    value = run[name]["median"]
    return "–" if value is None else f"{value:.{digits}f}"


def _three(run: Figures, name: str) -> str:
    worst = run[f"{name}_p99_ms"]
    spread = "" if worst["median"] is None else f" ({worst['lowest']:.0f}–{worst['highest']:.0f})"
    return " / ".join(_number(run, f"{name}_{p}_ms") for p in ("p50", "p95", "p99")) + spread


def draw(speed: Figures, live: Figures, path: Path) -> None:
    """Stages, ratio, resolution and latency, a panel each."""
    plt = pyplot()
    figure, axes = plt.subplots(2, 2, figsize=(11, 7.4), constrained_layout=True)
    scenes = {tuple(c["size"]): c["chains"] for name, c in speed["clips"].items() if name.startswith("scene ")}
    if scenes:
        _draw_stages(axes[0, 0], scenes)
        _draw_ratios(axes[0, 1], scenes)
        _draw_sizes(axes[1, 0], scenes)
    _draw_latency(axes[1, 1], live["runs"])
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _draw_stages(axis: Any, scenes: dict[tuple[int, int], Figures]) -> None:
    size = (640, 480) if (640, 480) in scenes else next(iter(scenes))
    chains = {name: f for name, f in scenes[size].items() if not name.startswith("torch default")}
    names = list(chains)[::-1]
    left = [0.0] * len(names)
    for stage in STAGES:
        wide = [max(chains[name]["stages"][stage]["processor_ms"], 0) for name in names]
        axis.barh(names, wide, left=left, color=STAGE_COLOURS[stage], label=stage)
        left = [a + b for a, b in zip(left, wide, strict=True)]
    axis.set_xlabel("processor time of a frame, ms")
    axis.grid(axis="y", visible=False)
    axis.legend(frameon=False, fontsize=9, loc="upper right")
    axis.set_title(f"Stages, {size[0]}×{size[1]}", fontsize=12, weight="bold")


def _draw_ratios(axis: Any, scenes: dict[tuple[int, int], Figures]) -> None:
    sizes = sorted(scenes, key=lambda s: s[0] * s[1])
    compared = [size for size in sizes if any(n.startswith("torch") for n in scenes[size])] or sizes
    names = [name for name in scenes[compared[0]] if name != "plain"]
    for k, name in enumerate(names):
        rows = [scenes[size].get(name) for size in compared]
        places = [i + 0.8 * ((k + 0.5) / len(names) - 0.5) for i, row in enumerate(rows) if row]
        held = [row for row in rows if row]
        middle = [row["processor_ratio"] for row in held]
        spread = [[r["processor_ratio"] - r["processor_ratio_25"] for r in held],
                  [r["processor_ratio_75"] - r["processor_ratio"] for r in held]]  # fmt: skip
        axis.errorbar(places, middle, spread, fmt="o", ms=5, capsize=3, color=COLOURS.get(name, "#000000"), label=name)
    for goal in GOALS:
        axis.axhline(goal, color="#888888", lw=1, ls=":")
    axis.axhline(1, color="#888888", lw=1)
    axis.set_yscale("log")
    axis.set_ylim(0.025, None)
    axis.set_yticks([0.1, 0.2, 0.3, 0.5, 1, 2, 5], ["0.1", "0.2", "0.3", "0.5", "1", "2", "5"])
    axis.minorticks_off()
    axis.set_xticks(range(len(compared)), [f"{w}×{h}" for w, h in compared])
    axis.set_ylabel("processor time beside the plain chain's")
    axis.legend(frameon=False, fontsize=8, ncols=3, loc="lower center")
    axis.set_title("Ratio to plain OpenCV", fontsize=12, weight="bold")


def _draw_sizes(axis: Any, scenes: dict[tuple[int, int], Figures]) -> None:
    sizes = sorted(scenes, key=lambda s: s[0] * s[1])
    pixels = [w * h / 1e6 for w, h in sizes]
    for name in ("plain", *ONBOARD):
        rows = [(p, scenes[s][name]) for p, s in zip(pixels, sizes, strict=True) if name in scenes[s]]
        if rows:
            at, middle = [p for p, _ in rows], [r["processor_ms"] for _, r in rows]
            spread = [[r["processor_ms"] - r["processor_ms_25"] for _, r in rows],
                      [r["processor_ms_75"] - r["processor_ms"] for _, r in rows]]  # fmt: skip
            axis.errorbar(at, middle, spread, fmt="o-", ms=5, capsize=3, color=COLOURS[name], label=name)
    axis.set(xlim=(0, None), ylim=(0, None), ylabel="processor time of a frame, ms")
    axis.set_xticks(pixels, [f"{w}×{h}" for w, h in sizes], rotation=30, ha="right", fontsize=8)
    axis.legend(frameon=False, fontsize=9)
    axis.set_title("Against the resolution", fontsize=12, weight="bold")


def _draw_latency(axis: Any, runs: list[Figures]) -> None:
    first = [r for r in runs if (r["clip"], r["config"]) == (runs[0]["clip"], runs[0]["config"])]
    shown = [r for r in first if r["latency_p99_ms"]["median"] is not None]
    labels = [f"{r['rate_hz']:g}/s\n{r['cores']} core" + "s" * (r["cores"] > 1) for r in shown]
    for p, marker, colour in (("p50", "o", "#448361"), ("p95", "s", "#d9730d"), ("p99", "^", "#ad1a72")):
        found = [run[f"latency_{p}_ms"] for run in shown]
        middle = [f["median"] for f in found]
        spread = [[f["median"] - f["lowest"] for f in found], [f["highest"] - f["median"] for f in found]]
        axis.errorbar(range(len(shown)), middle, spread, fmt=marker, ms=6, capsize=3, color=colour, label=f"{p[1:]} %")
    axis.axhline(GOAL_MS, color="#888888", lw=1, ls=":")
    axis.set_xticks(range(len(shown)), labels, fontsize=8)
    axis.set(ylim=(0, 1.4 * max(axis.get_ylim()[1], GOAL_MS)), ylabel="latency, ms")
    axis.legend(frameon=False, fontsize=9, ncols=3, loc="upper center")
    about = f"{_title(runs[0]['clip'])}, {runs[0]['config']}" if runs else ""
    axis.set_title(f"Live, {about}", fontsize=12, weight="bold")


def main() -> None:
    """Write what was asked for; print the details where nothing was."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figures", nargs="+", type=Path, metavar="JSON")
    parser.add_argument("--readme", type=Path)
    parser.add_argument("--details", type=Path)
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    if len(options.figures) not in (2, 3):
        parser.error("give SPEED.json LIVE.json [PEOPLE.json]")
    try:
        speed, live, *rest = (json.loads(path.read_text(encoding="utf-8")) for path in options.figures)
    except (OSError, ValueError) as error:
        sys.exit(str(error))
    people = rest[0] if rest else None
    if options.readme and options.readme.resolve() == results.ROOT / "docs" / "benchmarks.md":
        for name, content in (("speed", speed), ("live", live), *([("people", people)] if people else [])):
            results.keep(f"onboard-{name}", {"command": results.command(), "day": results.today(), **content})
    if options.readme:
        report.place(options.readme, "onboard", summary(speed, live, people))
    if options.details:
        report.place(options.details, "onboard", details(speed, live, people))
    if options.plot:
        draw(speed, live, options.plot)
    if not (options.readme or options.details or options.plot):
        print(details(speed, live, people))


if __name__ == "__main__":
    main()
