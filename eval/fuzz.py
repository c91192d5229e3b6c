"""Damaged inputs for every parser: does one crash or hang?

usage: python eval/fuzz.py [--inputs 100000] [--workers 2] [--seed 0] [--only WORD...] [--limit-s 10] [--keep DIR]

Each input is a whole file with something wrong with it, made from the parser, the seed and a number, so that it can be
made again. Readers run in processes of their own: where one dies (a crash of a decoder) or takes longer than the limit,
seconds of the processor or thirty times as many of the clock, that is told with its input, and another goes on. A
reader may take an input or refuse it with an InputError of one line; anything else, a warning too, is a defect. --keep
is for inputs with defects. Exit code 1 if there are any.
"""

import argparse
import json
import math
import multiprocessing as mp
import os
import resource
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CHUNK = 250
MEMORY_BYTES = 6 << 30
"""Address space of a reader: an input of kilobytes that asks for more is a defect."""

IDLE = 30.0
"""A reader that waits for so many times the limit hangs too; a machine that is busy may keep it waiting for long."""

Found = tuple[str, int, str, str]
"""Parser, number of the input, kind of the defect, and what was said of it."""


def child(connection: Connection, seed: int, started: "mp.sharedctypes.SynchronizedArray[float]") -> None:
    """Reads (parser, first number, end) from the connection until None; answers each with counts and defects.

    started: when the present input was begun, on the monotonic clock and the process's own; 0 between two. Each number
    is told before it is tried.
    """
    sys.path.insert(0, str(ROOT))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # decoders complain there
    from tests.fuzz.parsers import PARSERS

    by_name = {parser.name: parser for parser in PARSERS}
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    with tempfile.TemporaryDirectory() as folder:
        for k, (name, first, end) in enumerate(iter(connection.recv, None)):
            parser = by_name[name]
            path = parser.prepare(Path(folder) / str(k))
            if k == 0:  # what it imports is not its time
                parser.seeds()
            for number in range(first, end):
                content = parser.case(seed, number)
                connection.send(("try", number))
                started[:] = [time.monotonic(), time.process_time()]
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    for outdated in (DeprecationWarning, PendingDeprecationWarning):  # of libraries: theirs to mend
                        warnings.simplefilter("ignore", outdated)
                    try:
                        answer = ("refused" if parser.try_on(path, content) is not None else "taken", "")
                    except BaseException as error:
                        where = [
                            f"{f.filename.split('/')[-1]}:{f.lineno}" for f in traceback.extract_tb(error.__traceback__)
                        ]
                        answer = ("crashed", f"{type(error).__name__} {' '.join(where[-3:])}: {str(error)[:200]}")
                seconds = time.process_time() - started[1]
                started[:] = [0.0, 0.0]
                connection.send((*answer, seconds))
            connection.send(("done", ""))


class Reader:
    """A process that tries inputs; another takes its place when it dies or hangs."""

    def __init__(self, seed: int, limit_s: float) -> None:
        self.seed, self.limit_s = seed, limit_s
        self.context = mp.get_context("spawn")
        self.started = self.context.Array("d", 2)
        self.process: SpawnProcess | None = None

    def tried(self, name: str, first: int, end: int) -> Iterator[tuple[int, str, str, float]]:
        """(number, taken, refused, crashed, died or hung; what was said; seconds) of each input."""
        number = first - 1
        while number + 1 < end:
            if self.process is None or not self.process.is_alive():
                self.connection, theirs = self.context.Pipe()
                self.process = self.context.Process(target=child, args=(theirs, self.seed, self.started), daemon=True)
                self.process.start()
                theirs.close()
            self.connection.send((name, number + 1, end))
            try:
                while (told := self._told())[0] != "done":
                    if told[0] == "try":
                        number = told[1]
                    else:
                        yield number, *told
                return
            except TimeoutError:
                self.process.kill()
                self.process.join()
                yield number, "hung", f"more than {self.limit_s:g} s", self.limit_s
            except EOFError:
                self.process.join()
                yield number, "died", f"exit code {self.process.exitcode}", 0.0
            self.started[:] = [0.0, 0.0]
            self.process = None

    def _told(self) -> tuple:
        while not self.connection.poll(1.0):
            begun, spent_s = self.started[:]
            idle = begun and time.monotonic() - begun > IDLE * self.limit_s
            if idle or (begun and self._spent_s() - spent_s > self.limit_s):
                raise TimeoutError
        return self.connection.recv()

    def _spent_s(self) -> float:
        """Seconds of the processor that the process has had."""
        assert self.process is not None
        try:
            cells = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            return 0.0
        return (int(cells[11]) + int(cells[12])) / os.sysconf("SC_CLK_TCK")

    def close(self) -> None:
        """End the process."""
        if self.process is not None and self.process.is_alive():
            self.connection.send(None)
            self.process.join(10)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--inputs", type=int, default=100_000)
    options.add_argument("--workers", type=int, default=2)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--only", nargs="+", default=[""], help="parsers whose name holds one of these")
    options.add_argument("--limit-s", type=float, default=10.0, help="a reader that takes longer hangs")
    options.add_argument("--keep", type=Path, help="folder for the inputs with defects")
    options.add_argument("--json", type=Path)
    asked = options.parse_args()
    sys.path.insert(0, str(ROOT))
    from tests.fuzz.parsers import PARSERS

    parsers = [p for p in PARSERS if p.there and any(word in p.name for word in asked.only)]
    absent = [p.name for p in PARSERS if not p.there]
    share = asked.inputs / sum(p.share for p in parsers)
    wanted = {p.name: math.ceil(p.share * share) for p in parsers}
    jobs = [(name, k, min(k + CHUNK, n)) for name, n in wanted.items() for k in range(0, n, CHUNK)]
    jobs.reverse()
    counts = {name: Counter[str]() for name in wanted}
    slowest = dict.fromkeys(wanted, 0.0)
    defects: list[Found] = []
    lock = threading.Lock()
    began = time.monotonic()

    def work() -> None:
        reader = Reader(asked.seed, asked.limit_s)
        while True:
            with lock:
                if not jobs:
                    break
                name, first, end = jobs.pop()
            for number, kind, said, seconds in reader.tried(name, first, end):
                with lock:
                    counts[name][kind] += 1
                    slowest[name] = max(slowest[name], seconds)
                    if kind in ("crashed", "died", "hung"):
                        defects.append((name, number, kind, said))
                        print(f"DEFECT {name}, input {number}: {kind}, {said}", flush=True)
            with lock:
                done = sum(count.total() for count in counts.values())
                if counts[name].total() == wanted[name]:
                    print(f"{time.monotonic() - began:6.0f} s, {done} inputs: {name} done", file=sys.stderr, flush=True)
        reader.close()

    threads = [threading.Thread(target=work) for _ in range(asked.workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    print(f"{'parser':28s} {'inputs':>7s} {'taken':>7s} {'refused':>8s} {'crashed':>8s} {'hung':>5s} {'slowest':>9s}")
    for name, count in counts.items():
        crashed = count["crashed"] + count["died"]
        row = f"{count.total():7d} {count['taken']:7d} {count['refused']:8d} {crashed:8d} {count['hung']:5d}"
        print(f"{name:28s} {row} {slowest[name]:7.2f} s")
    total = sum((count for count in counts.values()), Counter[str]())
    crashed, took_s = total["crashed"] + total["died"], time.monotonic() - began
    print(
        f"{total.total()} inputs, {len(parsers)} parsers, seed {asked.seed}: {total['taken']} taken, "
        f"{total['refused']} refused, {crashed} crashed, {total['hung']} hung, in {took_s:.0f} s"
    )
    if absent:
        print(f"not there, for want of what they need: {', '.join(absent)}")
    if asked.keep is not None and defects:
        asked.keep.mkdir(parents=True, exist_ok=True)
        by_name = {p.name: p for p in parsers}
        for name, number, _, _ in defects:
            place = asked.keep / f"{name.replace(' ', '_').replace('/', '_')}-{number}{Path(by_name[name].file).suffix}"
            place.write_bytes(by_name[name].case(asked.seed, number))
    if asked.json is not None:
        record = {"seed": asked.seed, "counts": counts, "slowest_s": slowest, "defects": defects}
        asked.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    sys.exit(bool(defects))


if __name__ == "__main__":
    main()
