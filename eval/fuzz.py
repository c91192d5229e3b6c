"""Test every reader with damaged inputs: `python eval/fuzz.py run [--inputs 100000] [--workers 2]`.

Each input is a complete file with damage. The reader, the seed and a number determine it, so that it can be made again.
Readers run in separate processes, a few hundred inputs each. If a process dies (a decoder crashes) or takes longer than
the limit for an input, the number is reported, and the next process continues after it. A reader may accept an input or
refuse it with an InputError of one line. Everything else, including a warning, is a defect. The exit code is 1 if there
are defects.
"""

import math
import os
import resource
import subprocess
import sys
import tempfile
import threading
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import bench

sys.path.insert(0, str(bench.ROOT))
from tests.fuzz.parsers import PARSERS

CHUNK = 250
MEMORY_BYTES = 6 << 30
"""Address space of a reader. A small input that needs more memory is a defect."""


def run_readers(options: bench.Options) -> tuple[str, Any]:
    """Try all readers, or the readers with one of --only in their names."""
    parsers = [p for p in PARSERS if p.there and any(word in p.name for word in options.only)]
    share = options.inputs / sum(p.share for p in parsers)
    wanted = {p.name: math.ceil(p.share * share) for p in parsers}
    chunks = [(name, k, min(k + CHUNK, n)) for name, n in wanted.items() for k in range(0, n, CHUNK)]
    counts, defects = {name: Counter[str]() for name in wanted}, []
    with ThreadPoolExecutor(options.workers) as pool:
        for (name, *_), answers in zip(chunks, pool.map(lambda c: list(try_chunk(*c, options)), chunks), strict=True):
            for number, kind, words in answers:
                counts[name][kind] += 1
                if kind not in ("taken", "refused"):
                    defects.append([name, number, kind, words])
                    bench.log("DEFECT", *defects[-1])
    kinds = ("taken", "refused", "crashed", "died", "hung")
    rows = [[name, count.total(), *(count[kind] for kind in kinds)] for name, count in counts.items()]
    text = bench.format_table(["reader", "inputs", *kinds], rows)
    absent = ", ".join(p.name for p in PARSERS if not p.there)
    text += f"\n\nNot there, for want of what they need: {absent}." * bool(absent)
    if defects:
        sys.exit(f"{text}\n\n{len(defects)} defects")
    return text, {"seed": options.seed, "counts": counts}


def try_chunk(name: str, first: int, end: int, options: bench.Options) -> Iterator[tuple[int, str, str]]:
    """Yield the number, kind and message of each input of a chunk."""
    while first < end:
        command = [sys.executable, __file__, "chunk", "--reader", name, "--first", str(first), "--end", str(end)]
        process = subprocess.Popen(
            [*command, "--seed", str(options.seed)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert process.stdout is not None
        is_hung = threading.Event()
        timer = _start_timer(process, 60 + options.limit_s, is_hung)  # extra time for the imports
        for line in process.stdout:
            timer.cancel()
            timer = _start_timer(process, options.limit_s, is_hung)
            kind, _, words = line.rstrip("\n").partition(" ")
            yield first, kind, words
            first += 1
        timer.cancel()
        code = process.wait()
        if first < end:
            yield first, "hung" if is_hung.is_set() else "died", f"exit code {code}"
            first += 1


def _start_timer(process: "subprocess.Popen[str]", seconds: float, is_hung: threading.Event) -> threading.Timer:
    def kill() -> None:
        is_hung.set()
        process.kill()

    timer = threading.Timer(seconds, kill)
    timer.start()
    return timer


def read_chunk(options: bench.Options) -> tuple[str, Any]:
    """Try the inputs of one reader and print a line for each (used by `run`)."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    parser = next(p for p in PARSERS if p.name == options.reader)
    parser.seeds()
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("error")
        for outdated in (DeprecationWarning, PendingDeprecationWarning):  # warnings of libraries
            warnings.simplefilter("ignore", outdated)
        path = parser.prepare(Path(folder) / "input")
        for number in range(options.first, options.end):
            try:
                refused = parser.try_on(path, parser.case(options.seed, number)) is not None
                answers.write("refused\n" if refused else "taken\n")
            except BaseException as error:
                frames = traceback.extract_tb(error.__traceback__)[-3:]
                where = " ".join(f"{Path(f.filename).name}:{f.lineno}" for f in frames)
                words = " ".join(f"{type(error).__name__} {where}: {str(error)[:200]}".split())
                answers.write(f"crashed {words}\n")
    answers.close()
    return "", None


if __name__ == "__main__":
    run = {"--inputs": 100_000, "--workers": 2, "--seed": 0, "--only": [""], "--limit-s": 30.0}
    chunk = {"--reader": "", "--first": 0, "--end": 1, "--seed": 0}
    bench.main(__doc__, {"run": (run_readers, run), "chunk": (read_chunk, chunk)})
