"""What a frame costs on the vehicle: whole and stage by stage, against resolution, targets, memory and bandwidth.

usage: python eval/onboard_speed.py [DATA...] [--parts chains targets memory] [--rounds 12] [--realtime]
       [--graphs FOLDER] [--json FILE]

chains: all chains beside the plain OpenCV chain at each of --sizes, the onboard ones at each of --ladder too; each
size's chains take turns of eight frames through the same clip, so that whatever else the machine does meets them all.
Figures are medians over the turns with their quartiles; the processor's time is summed over threads and grows less
than the clock's where other programs want the cores, and a ratio of two in the same turn least of all. How much others
took is told; --realtime (root) goes before them. The limit is the time in which one core, copying a block far larger
than its caches at the speed measured between the same turns, would move what each stage must read and write at least
once (LEAST_BYTES).

targets: 640x480 with so many movers added to the scene, the onboard chains in turns on all of these clips.

memory: the most that a process holds (VmHWM) which takes one chain through a video, and nothing else.

The clips are the project's own scene, filmed at each size; with DATA (videos, folders of pictures, folders of clips)
these too, at each size not larger than their own. Parts that are done stand in the JSON though a later one is stopped.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
import machine
import numpy as np
from chains import CHAINS, ONBOARD, STAGES, STEP, Timed, available, lanes_of, quartiles, row, timed
from films import Size, clips, peopled, resized, scene, size_of, write_video
from memory import measured

SIZES, LADDER = ((640, 480), (1280, 720), (1920, 1080)), ((320, 240), (960, 540))
TARGETS = (0, 10, 30, 60)
FRAMES = 24
LEAST_BYTES = {"prepare": 4, "register": 2, "foreground": 4, "targets": 2}
"""A pixel: colour read, grey written; two greys read; three greys read, mask written; mask read, targets written."""
LARGE_MB, PARTS = 256, ("chains", "targets", "memory")


def compared(frames: list[np.ndarray], chains: list[str], rounds: int, graphs: Path | None) -> dict[str, Any]:
    """All chains on one clip: {"chains": {name: figures}, "copy_gb_s": ..., "others": cores}."""
    others, large, held = machine.Others(), [], []
    height, width = frames[0].shape[:2]
    found: dict[str, Timed] = {}
    for latest in timed(lanes_of(frames, chains, rounds), rounds, graphs):
        found = latest
        large.append(machine.copied_gb_s(LARGE_MB))
        held.append(machine.copied_gb_s(width * height / 1e6))
    rate, plain = float(np.median(large)), found["plain"].whole
    rows = {}
    for name, taken in found.items():
        limits = {stage: size * width * height / rate / 1e6 for stage, size in LEAST_BYTES.items()}  # ms
        stages = {
            stage: {**quartiles("processor_ms", turns[:, 1]), **quartiles("ms", turns[:, 0]), "limit_ms": limits[stage]}
            for stage, turns in taken.stages.items()
        }
        limit = sum(limits.values())
        figures = {**row(taken.whole, plain), "limit_ms": limit, "targets": taken.boxes, "stages": stages}
        figures["over_limit"] = figures["processor_ms"] / limit
        rows[name] = figures
    return {
        "size": [width, height],
        "chains": rows,
        "copy_gb_s": quartiles("large", np.array(large)) | quartiles("picture", np.array(held)),
        "others": others.cores(),
    }


def told(name: str, found: dict[str, Any]) -> None:
    """Print a clip's figures."""
    width, height = found["size"]
    print(f"\n{name}, {width}x{height}: {machine.load_in_words(found['others'])}; ", end="")
    print(f"one core copies {found['copy_gb_s']['large']:.1f} GB/s, pictures {found['copy_gb_s']['picture']:.1f} GB/s")
    for chain, r in found["chains"].items():
        spread = f"{r['processor_ratio']:5.2f} ({r['processor_ratio_25']:.2f} to {r['processor_ratio_75']:.2f})"
        stages = ", ".join(f"{stage} {r['stages'][stage]['processor_ms']:.1f}" for stage in STAGES)
        print(f"  {chain:17} {r['median_ms']:7.1f} ms, ratio {r['ratio']:5.2f}; processor ", end="")
        print(f"{r['processor_ms']:7.1f} ms, ratio {spread}, {r['over_limit']:4.0f} x limit; {stages}", flush=True)


def by_targets(counts: list[int], chains: list[str], rounds: int, size: Size = (640, 480)) -> dict[str, Any]:
    """{"chains": {name: {count: figures}}}: the onboard chains on clips with so many movers more."""
    frames, others = scene(size, FRAMES), machine.Others()
    lanes = {}
    for count in counts:
        of_clip = lanes_of(peopled(frames, count), chains, rounds)
        lanes |= {f"{name}|{count}": lane for name, lane in of_clip.items()}
    *_, found = timed(lanes, rounds)
    rows: dict[str, dict[int, Any]] = {name: {} for name in ("plain", *chains)}
    for lane, taken in found.items():
        name, count = lane.split("|")
        figures = row(taken.whole, found[f"plain|{count}"].whole)
        stages = {stage: float(np.median(turns[:, 1])) for stage, turns in taken.stages.items()}
        rows[name][int(count)] = {**figures, "targets": taken.boxes, "stages_processor_ms": stages}
    print(f"\ntargets, {size[0]}x{size[1]}: {machine.load_in_words(others.cores())}")
    for name, by_count in rows.items():
        texts = (f"+{c}: {r['processor_ms']:.1f} ms ({r['targets']:.0f} found)" for c, r in by_count.items())
        print(f"  {name:17} processor, movers {'; '.join(texts)}", flush=True)
    return {"size": list(size), "chains": rows, "others": others.cores()}


def by_memory(sizes: list[Size], chains: list[str], count: int, graphs: Path | None) -> dict[str, Any]:
    """{"WxH": {chain: {"peak_mb", "second_half_mb", "seconds"}}}: each chain in a process of its own."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for width, height in sizes:
            video = Path(folder) / f"{width}x{height}.mp4"
            write_video(video, scene((width, height), FRAMES), count)
            rows = found[f"{width}x{height}"] = {}
            held = [str(graphs)] if graphs is not None else []
            for name in ("nothing", "plain", *available(chains, [(width, height)], graphs)):
                command = [sys.executable, str(Path(__file__).with_name("chains.py")), name, str(video), *held]
                rows[name] = measured(command)
                print(f"  {width}x{height} {name:17} peak {rows[name]['peak_mb']:6.1f} MB", flush=True)
    return found


def main() -> None:
    """Measure, print and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="*")
    parser.add_argument("--parts", nargs="*", default=PARTS, choices=PARTS)
    parser.add_argument("--sizes", nargs="*", type=size_of, default=SIZES)
    parser.add_argument("--ladder", nargs="*", type=size_of, default=LADDER)
    parser.add_argument("--targets", nargs="*", type=int, default=TARGETS)
    parser.add_argument("--chains", nargs="*", help=f"of: {', '.join(CHAINS)}")
    parser.add_argument(
        "--graphs", type=Path, help="a folder by `dddas export --graph step`: its sizes are compared too"
    )
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--frames", type=int, default=60, help="of the videos that memory is measured on")
    parser.add_argument("--realtime", action="store_true", help="go before all others (SCHED_RR); root")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    graphs, wanted = options.graphs, options.chains or CHAINS
    chains = [*available(wanted), *(name for name in wanted if name == STEP)]
    onboard = [name for name in chains if name in ONBOARD]
    sizes, ladder = list(options.sizes), list(options.ladder)
    report: dict[str, Any] = {"machine": machine.about(), "realtime": options.realtime, "rounds": options.rounds}
    report["clips"] = {}
    print(machine.in_words(report["machine"]) + "; before all others" * options.realtime)
    if options.realtime:
        machine.first_in_line()

    def done(part: str, figures: dict[str, Any]) -> None:
        report[part] = figures
        if options.json:
            options.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")

    if "chains" in options.parts:
        for size in sizes + ladder:
            name = f"scene {size[0]}x{size[1]}"
            here = available(chains, [size], graphs) if size in sizes else onboard
            found = compared(scene(size, FRAMES), here, options.rounds, graphs)
            told("scene", found)
            done("clips", {**report["clips"], name: found})
        for clip, frames in clips(options.data, []) if options.data else ():
            height, width = frames[0].shape[:2]
            for size in (s for s in sizes if s[0] <= width and s[1] <= height):
                here = available(chains, [size], graphs)
                found = compared([resized(frame, size) for frame in frames], here, options.rounds, graphs)
                told(clip, found)
                done("clips", {**report["clips"], f"{clip} {size[0]}x{size[1]}": found})
    if "targets" in options.parts:
        done("targets", by_targets(options.targets, onboard, options.rounds))
    if "memory" in options.parts:
        print("\nmemory, a process each:")
        done("memory", by_memory(sizes, chains, options.frames, graphs))


if __name__ == "__main__":
    main()
