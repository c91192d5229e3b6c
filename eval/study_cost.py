"""What a study costs beside the work itself: two workers against one, and what a clip costs that hardly has any frames.

usage: python eval/study_cost.py [--clips 8] [--frames 40] [--rounds 3] [--json FILE]

Workers: a study of clips of the project's own scene at 640x480, computed anew by one worker and by two, in turns; by
the clock, from the first clip done by each to the last, as starting a process is no cost of a clip, and with the start.
Overhead: 60 clips of three frames of tables alone, in this process: all that they cost less the seconds of the stages
themselves: reading, keys, storing, scoring. How much others took of the cores meanwhile is told.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import cv2
import machine
import numpy as np
from films import scene

from torchvision_dddas.evaluation.studies.jobs import Event, Job
from torchvision_dddas.evaluation.studies.runner import plan_study, run_jobs, run_study
from torchvision_dddas.evaluation.studies.spec import Source, Spec
from torchvision_dddas.evaluation.studies.storage import Cache
from torchvision_dddas.evaluation.studies.workers import Workers

SIZE = (640, 480)
SHORT = 60


def film(folder: Path, clips: int, frames: int) -> None:
    """Clips with masks, the same scene in each: the workers' loads are even."""
    images = scene(SIZE, frames)
    for k in range(clips):
        (folder / f"c{k}" / "frames").mkdir(parents=True)
        (folder / f"c{k}" / "masks").mkdir()
        for number, image in enumerate(images, 1):
            shown = np.roll(image, k, axis=1)  # other bytes, so that no clip is another's
            cv2.imwrite(str(folder / f"c{k}" / "frames" / f"{number:06d}.png"), shown)
        cv2.imwrite(str(folder / f"c{k}" / "masks" / "000005.png"), np.zeros(SIZE[::-1], np.uint8))


def table(folder: Path) -> None:
    """Clips of three frames with two targets each, tables alone."""
    for k in range(SHORT):
        (folder / f"t{k:03d}" / "gt").mkdir(parents=True)
        rows = [f"{n},{i},{10 * i + n + k},20,8,8,1,-1,-1,-1\n" for n in (1, 2, 3) for i in (1, 2)]
        (folder / f"t{k:03d}" / "gt" / "gt.txt").write_text("".join(rows))


def study(folder: Path, task: str) -> Spec:
    """Of a folder of clips."""
    return Spec("cost", (Source("folder", folder),), (task,), backend="onboard")


def timed(spec: Spec, workers: int, cache: Path) -> tuple[float, float]:
    """Seconds with the start of the workers, and from the first clip done to the last per clip done since."""
    jobs = plan_study(spec, Path()).jobs
    start = time.perf_counter()
    done = _done(jobs, workers, cache)
    first, last = done[min(workers, len(done)) - 1], done[-1]
    return last - start, (last - first) / (len(done) - workers)


def _done(jobs: Sequence[Job], count: int, cache: Path) -> list[float]:
    ends: list[float] = []

    def tell(event: Event) -> None:
        if event.done is not None:
            assert all(not part.cause for part in event.done), event.done
            ends.append(time.perf_counter())

    with Workers(count) as workers:
        run_jobs(jobs, workers, Cache(cache), tell)
    return ends


def main() -> None:
    """Measure, and tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=int, default=8)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    others = machine.Others()
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        film(root / "clips", asked.clips, asked.frames)
        spec, turns = study(root / "clips", "motion"), []
        for turn in range(asked.rounds):
            one, two = (timed(spec, n, root / f"cache{turn}{n}") for n in (1, 2))
            turns.append((one[0] / two[0], one[1] / two[1]))
            print(f"one {one[0]:.1f} s, two {two[0]:.1f} s: {turns[-1][0]:.2f}, without the start {turns[-1][1]:.2f}")
        table(root / "tables")
        start = time.perf_counter()
        results = run_study(study(root / "tables", "association"), root, cache=root / "cache")
        spent = time.perf_counter() - start
        stages = sum(sum(case.found.seconds.values()) for case in results.cases if case.found is not None)
    whole, steady = (median(turn[k] for turn in turns) for k in (0, 1))
    overhead_ms = 1e3 * (spent - stages) / SHORT
    taken = others.cores()
    print(f"two workers against one: {whole:.2f}, without the start {steady:.2f} (medians of {len(turns)} turns)")
    print(f"overhead of a clip: {overhead_ms:.0f} ms; {machine.load_in_words(taken)}")
    if asked.json:
        figures = {
            "two_to_one": whole,
            "without_start": steady,
            "overhead_ms": overhead_ms,
            "others": taken,
            "machine": machine.about(),
        }
        asked.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
