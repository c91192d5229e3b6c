"""How quick the chains are beside the plain OpenCV chain, all in one run, and how well they register.

usage: python eval/speed.py [CLIP...] [--sizes 640x480 1280x720] [--rounds 12] [--chains NAME...] [--json FILE]

A clip is a video, a folder of pictures, or a folder that holds clips. With none the project's own scene is rendered at
each of --sizes. All chains go through the same decoded frames, forwards and backwards, in turns of eight frames, so
that whatever else the machine does meets them all; the first turns are left out. A ratio is the median over the turns
of a chain's time through the plain chain's in the same turn. Garbage is collected between the turns. The processor's
time, over all threads, is told as well: it says what a chain costs where other programs want the second core.
"""

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import machine
import registration_error
from chains import CHAINS, available, lanes_of, row, timed
from films import clips


def main() -> None:
    """Measure, print a table a clip and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="*")
    parser.add_argument("--sizes", nargs="*", default=["640x480", "1280x720"])
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--chains", nargs="*", help=f"of: {', '.join(CHAINS)}")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    chains = options.chains or available()
    sizes = [(int(w), int(h)) for w, h in (size.split("x") for size in options.sizes)]
    report: dict[str, dict] = {"machine": machine.about(), "clips": {}}
    for name, frames in clips(options.clips, sizes):
        if len(frames) < 10:
            print(f"{name}: {len(frames)} frames are too few", file=sys.stderr)
            continue
        others = machine.Others()
        *_, found = timed(lanes_of(frames, chains, options.rounds), options.rounds)
        rows = {chain: row(taken.whole, found["plain"].whole) for chain, taken in found.items()}
        load = others.cores()
        errors = registration_error.errors(frames)
        height, width = frames[0].shape[:2]
        report["clips"][name] = {"size": [width, height], "chains": rows, "registration_px": errors, "others": load}
        print(f"\n{name}, {width}x{height}: ms a frame, and the ratio to plain (quartiles; of means)")
        print(f"  {machine.load_in_words(load)}")
        for chain, r in rows.items():
            spread = f"{r['ratio']:5.2f} ({r['ratio_25']:.2f} to {r['ratio_75']:.2f}; {r['ratio_of_means']:.2f})"
            busy = f"processor {r['processor_ms']:6.1f} ratio {r['processor_ratio']:.2f}"
            print(f"  {chain:18} median {r['median_ms']:6.1f}  mean {r['mean_ms']:6.1f}  ratio {spread}  {busy}")
        for chain, e in errors.items():
            print(
                f"  registration, {chain:10} median {e['median']:.3f} px  p90 {e['p90']:.3f} px  ({e['pairs']} pairs)"
            )
    if options.json:
        options.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
