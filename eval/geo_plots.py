"""Plot of geo_error.py: errors against the altitude and the number of landmarks, beside what is possible."""

from pathlib import Path
from typing import Any

Row = dict[str, Any]
COLOURS = {"pose": "#0b6e99", "homography": "#d9730d"}


def draw(rows: list[Row], path: Path) -> None:
    """Above: by altitude, four landmarks; below: by their number, at 50 m. A column for each quality of GPS."""
    try:
        import matplotlib as mpl
    except ModuleNotFoundError:
        raise SystemExit("no plot: it needs matplotlib, the extra `dev`") from None
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    mpl.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
                         "grid.color": "#e6e6e6", "axes.edgecolor": "#888888", "axes.axisbelow": True})  # fmt: skip
    usual = {"layout": "ring", "pixel_sigma": 1.0, "tilt_deg": 0.0, "common_m": 0.0}
    plain = [row for row in rows if all(row[k] == v for k, v in usual.items())]
    qualities = {"exact": "exact places", "1.5 m": "GPS, 1.5 m in 95 %", "3.5 m": "GPS, 3.5 m in 95 %"}
    figure, axes = plt.subplots(2, 3, figsize=(11.5, 6.6), constrained_layout=True)
    for column, (gps, title) in enumerate(qualities.items()):
        here = [r for r in plain if r["gps"] == gps]
        above = sorted((r for r in here if r["landmarks"] == 4), key=lambda r: r["altitude_m"])
        below = sorted((r for r in here if r["altitude_m"] == 50), key=lambda r: r["landmarks"])
        for axis, some, key in ((axes[0, column], above, "altitude_m"), (axes[1, column], below, "landmarks")):
            x = [r[key] for r in some]
            for method, colour in COLOURS.items():
                parts = [r[method]["crowd"] for r in some]
                axis.plot(x, [p["bound"] for p in parts], color=colour, lw=5, alpha=0.25, solid_capstyle="round",
                          label=f"{method}: Cramér–Rao bound")  # fmt: skip
                axis.plot(x, [p["mean"] for p in parts], "o", color=colour, ms=5.5, label=f"{method}: measured mean")
            axis.set_ylim(0, 1.12 * max(r["homography"]["crowd"]["mean"] for r in some))
            axis.margins(x=0.08)
            axis.set_xticks(sorted(set(x)))
        axes[0, column].set(title=title, xlabel="altitude above ground, m (4 landmarks)")
        axes[1, column].set(xlabel="landmarks (50 m above ground)")
    for axis in axes[:, 0]:
        axis.set_ylabel("error of a place, m")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(
        "Places of a crowd located from the air by landmarks in a ring about it", fontsize=13, weight="bold"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
