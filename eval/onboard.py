"""All figures of the onboard chain by one command: speed, memory, live latency; tables and picture put in their places.

usage: python eval/onboard.py --out FOLDER [DATA...] [--quick] [--realtime] [--write]

On a quiet machine: it takes about half an hour there. FOLDER keeps speed.json, live.json and people.json, and what is
there already is not measured again. --write puts the tables into README.md and eval/README.md (marks `onboard`) and the
picture into docs/onboard.png, else they stay in FOLDER. --quick: few turns and short runs, to see that all works.
--realtime (root): before all other programs, where the machine is not quiet.
"""

import argparse
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent


def main() -> None:
    """Run the studies one after the other; each as a process, as they can be run alone."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="*")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--realtime", action="store_true")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    first = ["--realtime"] * options.realtime
    turns = ["--rounds", "2", "--targets", "0", "30", "--frames", "24", "--ladder"] if options.quick else []
    short = ["--rounds", "1", "--seconds", "6"] if options.quick else []
    live = ["--configs", "fast", "half"] if not options.quick else []
    studies = {
        "speed.json": ["onboard_speed.py", *options.data, *turns],
        "live.json": ["live_latency.py", *options.data, *live, *short],
        "people.json": ["live_latency.py", "--sizes", "1280x720", "--people", "--rates", "10", *short],
    }
    graphs = options.out / "graphs"
    if find_spec("torch") and find_spec("onnxscript") and not options.quick:
        make_graphs(graphs)
    if graphs.exists():
        studies["speed.json"] += ["--graphs", str(graphs)]
    for name, command in studies.items():
        measure(options.out / name, [*command, *first])
    tables = [str(options.out / name) for name in studies]
    if options.write:
        places = ["--readme", str(ROOT / "docs" / "benchmarks.md"), "--details", str(HERE / "README.md")]
        places += ["--plot", str(ROOT / "docs" / "onboard.png")]
    else:
        places = ["--plot", str(options.out / "onboard.png")]
        subprocess.run([sys.executable, str(HERE / "onboard_tables.py"), *tables], check=True)
    subprocess.run([sys.executable, str(HERE / "onboard_tables.py"), *tables, *places], check=True)


def make_graphs(folder: Path) -> None:
    """The whole step as a graph for 640x480, unless it is there; where it cannot be made the rest goes on without."""
    if not folder.exists():
        command = [str(Path(sys.executable).with_name("dddas")), "export", "--graph", "step", "--out", str(folder)]
        if subprocess.run(command, check=False).returncode:
            print("no graph of the whole step: not compared", file=sys.stderr)


def measure(path: Path, command: list[str]) -> None:
    """Run a study into its JSON, which appears when the study has ended well."""
    if path.exists():
        print(f"{path} is there: not measured again")
        return
    print(f"\n{' '.join(command)}", flush=True)
    unfinished = path.with_suffix(".part")
    subprocess.run([sys.executable, str(HERE / command[0]), *command[1:], "--json", str(unfinished)], check=True)
    unfinished.replace(path)


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)
