"""Plots of association_study.py: the figures of the source's studies, from what was measured here."""

import sys
from pathlib import Path
from typing import Any

import numpy as np

Figures = dict[str, Any]


def draw(found: Figures, folder: Path) -> None:
    """A PNG for each study that has something to draw."""
    try:
        import matplotlib as mpl
    except ModuleNotFoundError:
        print("no plots: they need matplotlib, the extra `dev`", file=sys.stderr)
        return
    mpl.use("Agg")
    for study, draw_one in (("weight", _weight), ("threshold", _threshold), ("dispersion", _dispersion)):
        if study in found:
            draw_one(found[study], folder / f"association_{study}.png")


def _weight(figures: Figures, path: Path) -> None:
    """AR_K against the weight (Fig. 4a): mean above, standard deviation below; dashes mark the rule's."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, len(figures), figsize=(5 * len(figures), 6), sharex=True, squeeze=False)
    for (name, by), above, below in zip(figures.items(), axes[0], axes[1], strict=True):
        for colour, (key, values) in enumerate(by.items()):
            count, gate = key.split()
            label = f"K = {count}, {'gated' if gate != 'off' else 'no gate'}"
            for axis, part in ((above, "mean"), (below, "sd")):
                percent = 100 * np.array(values[part])
                axis.plot(np.linspace(0, 1, len(percent) - 1), percent[:-1], f"C{colour}o-", ms=3, label=label)
                axis.axhline(percent[-1], color=f"C{colour}", ls=":", lw=1)
        above.set(title=name, ylabel="mean of AR, %")
        below.set(xlabel="weight of location (dotted: chosen by the dispersions)", ylabel="standard deviation, %")
        above.legend(fontsize=8)
    _save(figure, path)


def _threshold(figures: Figures, path: Path) -> None:
    """AR_2 against threshold × weight (Fig. 6)."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(figures), figsize=(5 * len(figures), 4), squeeze=False)
    for (name, by), axis in zip(figures.items(), axes[0], strict=True):
        percent = 100 * np.array(by["mean"])
        picture = axis.imshow(percent, origin="lower", extent=(-0.05, 1.05, -0.05, 1.05), vmin=0, vmax=100)
        axis.set(title=f"{name}: mean AR of pairs, %", xlabel="weight of location", ylabel="threshold")
        figure.colorbar(picture, ax=axis)
    _save(figure, path)


def _dispersion(figures: Figures, path: Path) -> None:
    """The dispersions, the weight that follows and what it scores, over time (Fig. 4b and 5)."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(3, len(figures), figsize=(7 * len(figures), 7), sharex="col", squeeze=False)
    for (name, by), (above, middle, below) in zip(figures.items(), axes.T, strict=True):
        above.plot(by["frame"], by["location"], lw=1, label="locations")
        above.plot(by["frame"], by["appearance"], lw=1, label="histograms")
        above.axhline(by["lowest"], color="k", ls=":", lw=1)
        above.set(title=name, ylabel="normalised entropy", ylim=(-0.02, 1.02))
        above.legend(fontsize=8)
        middle.step(by["frame"], by["weight"], lw=1)
        middle.set(ylabel="chosen weight", ylim=(-0.05, 1.05))
        for key, label in (("ruled", "by the dispersions"), ("fixed", f"w = {by['best']:g} for good")):
            smooth = np.convolve(by[key], np.ones(15) / 15, "valid")
            below.plot(by["frame"][7 : 7 + len(smooth)], 100 * smooth, lw=1, label=label)
        below.set(xlabel="frame", ylabel="AR of pairs, mean of 15, %")
        below.legend(fontsize=8)
    _save(figure, path)


def _save(figure: Any, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    print(path)
