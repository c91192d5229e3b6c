"""TrackEval's figures, for check.py and table.py: `.venv-peers/bin/python trackeval_figures.py FOLDER OUT.json`.

FOLDER holds gt/NAME/gt/gt.txt, lengths.json (NAME: frames) and results/RESULT/data/NAME.txt. Runs in the environment
that `make peers` makes, and knows nothing of this package. OUT: {RESULT: {NAME or COMBINED: {measure: value}}}.
An optional third word is the benchmark whose preprocessing applies, MOT15 unless said.
"""

import contextlib
import io
import json
import sys
from pathlib import Path

import numpy as np
import trackeval

MEANS = {"HOTA": "hota", "DetA": "deta", "AssA": "assa", "LocA": "loca", "DetRe": "detre", "DetPr": "detpr"}
MEANS |= {"AssRe": "assre", "AssPr": "asspr"}
CLEAR = {"MOTA": "mota", "MOTP": "motp", "CLR_Re": "recall", "CLR_Pr": "precision", "MTR": "mostly_tracked"}
CLEAR |= {"MLR": "mostly_lost", "CLR_TP": "n_tp", "CLR_FN": "n_fn", "CLR_FP": "n_fp", "IDSW": "n_switches"}
CLEAR |= {"Frag": "n_fragmentations", "MT": "n_mostly_tracked", "PT": "n_partly_tracked", "ML": "n_mostly_lost"}
IDENTITY = {"IDF1": "idf1", "IDP": "idp", "IDR": "idr", "IDTP": "n_idtp", "IDFN": "n_idfn", "IDFP": "n_idfp"}


def main(folder: Path, out: Path, benchmark: str = "MOT15") -> None:
    lengths = json.loads((folder / "lengths.json").read_text())
    quiet = {"PRINT_CONFIG": False}
    data = trackeval.datasets.MotChallenge2DBox(
        quiet
        | {"GT_FOLDER": str(folder / "gt"), "TRACKERS_FOLDER": str(folder / "results"), "SKIP_SPLIT_FOL": True}
        | {"BENCHMARK": benchmark, "SEQ_INFO": lengths, "DO_PREPROC": benchmark != "MOT15"}
    )
    silent = {"PRINT_RESULTS": False, "TIME_PROGRESS": False, "OUTPUT_SUMMARY": False, "OUTPUT_DETAILED": False}
    silent |= {"OUTPUT_EMPTY_CLASSES": False, "PLOT_CURVES": False, "BREAK_ON_ERROR": True, "LOG_ON_ERROR": None}
    with contextlib.redirect_stdout(io.StringIO()):
        evaluator = trackeval.Evaluator(quiet | silent)
        measures = [trackeval.metrics.HOTA(), trackeval.metrics.CLEAR(quiet), trackeval.metrics.Identity(quiet)]
        found, _ = evaluator.evaluate([data], measures)
    report = {
        result: {name.replace("COMBINED_SEQ", "COMBINED"): figures(by["pedestrian"]) for name, by in clips.items()}
        for result, clips in found["MotChallenge2DBox"].items()
    }
    out.write_text(json.dumps(report))


def figures(by: dict) -> dict[str, float]:
    values = {ours: float(np.mean(by["HOTA"][theirs])) for theirs, ours in MEANS.items()}
    values |= {ours: float(by["CLEAR"][theirs]) for theirs, ours in CLEAR.items()}
    return values | {ours: float(by["Identity"][theirs]) for theirs, ours in IDENTITY.items()}


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])
