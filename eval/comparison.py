"""Make a table of the source, plain chains and ours from eval/results, without measuring: `python eval/comparison.py`.

source: our implementation of the source's text, on the same data as the others. plain: the tuned OpenCV chain
(`plain_chain.py`), nearest centres, and OpenCV's findHomography in metres. published: the source's own figures, on its
own data.
"""

from typing import Any

import bench

SETS = {"bms": "BMS, 5 clips", "davis": "DAVIS, 7 clips"}
PIXELS = {"F": "F", "Gmean": "Gmean", "box F1": "F1 of boxes"}
SEQUENCES = ("PETS09-S2L1", "TUD-Stadtmitte")
NONE = "–"


class Tables:
    """The tables of a stored result."""

    def __init__(self, name: str) -> None:
        self._blocks = [block for block in bench.read_result(name)["blocks"] if isinstance(block, dict)]
        self.name = name

    def cell(self, column: str, *words: str) -> str:
        """Return the cell of a column in the row that begins with some words. End the program if there is none."""
        for block in self._blocks:
            for row in block["rows"]:
                if column in block["head"] and tuple(row[: len(words)]) == words:
                    return str(row[block["head"].index(column)])
        raise SystemExit(f"eval/results/{self.name}.json has no {column} of {', '.join(words)}; measure it again")


def mean_of(cell: str) -> str:
    """Return the mean of a cell such as `0.32 ± 0.02 (0.2–0.4)`."""
    return cell.split(" ")[0]


def compare(options: bench.Options) -> tuple[str, Any]:
    """Build the table."""
    accuracy, ratio = Tables("accuracy"), Tables("accuracy-ratio")
    methods, altitude, landmarks = (Tables(name) for name in ("geo-methods", "sim-altitude", "sim-landmarks"))
    rows = []
    for key, data in SETS.items():
        for measure, words in PIXELS.items():
            cells = [accuracy.cell(chain, f"{key}, {measure}") for chain in ("source", "plain", "default")]
            cells[0] += f"; {accuracy.cell('source at t + Δt', f'{key}, {measure}')} at t + Δt"
            rows.append(["detection", data, words, *cells, NONE])
    for sequence in SEQUENCES:
        for measure in ("AR_2", "AR_3"):
            window = "paper, K = 2" if measure == "AR_2" else "paper, K = 3"
            trackers = (window, "plain, nearest centres", "default, with the clip")
            cells = [ratio.cell(measure, sequence, tracker) for tracker in trackers]
            rows.append(["association", f"{sequence}, every 5th frame", f"{measure}, %", *cells, NONE])
    names = ("source: plane homography in raw degrees", "OpenCV: findHomography, in metres")
    for gps in ("exact", "3.5 m"):
        for count in (4, 6):
            column = f"{gps}, {count} landmarks"
            cells = [methods.cell(column, name) for name in (*names, "ours, default: the camera's pose")]
            words = f"geometry alone, GPS {gps}, {count} landmarks, 50 / 200 m"
            rows.append(["localization", words, "error, m: mean (median)", *cells, NONE])
    chains = ("source, raw degrees", "ours, homography in metres", "ours")
    for above in ("50", "200"):
        cells = [mean_of(altitude.cell("targets: mean error m", above, chain, "exact")) for chain in chains]
        published = altitude.cell("published", above, chains[0], "exact")
        rows.append(
            ["localization", f"rendered video, exact GPS, 4 landmarks, {above} m", "error, m", *cells, published]
        )
    for count in ("4", "6"):
        source, ours = (landmarks.cell("targets, all: m", chain, "motion", count) for chain in (chains[0], "ours"))
        published = landmarks.cell("published", chains[0], "motion", count)
        words = f"rendered video, gathering vehicles, {count} landmarks, 50 m"
        rows.append(["localization", words, "error, m", mean_of(source), NONE, mean_of(ours), published])
    head = ["", "data", "measure", "source", "plain", "ours", "published"]
    return bench.format_table(head, rows, words=3), rows


if __name__ == "__main__":
    bench.main(__doc__, {"": (compare, {})})
