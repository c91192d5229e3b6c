"""What a sweep has found, in files: sweep.json after every trial, best.toml at the end."""

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchvision_dddas.config import Settings, changes, with_parameters
from torchvision_dddas.evaluation.studies.goals import Goal
from torchvision_dddas.evaluation.studies.sweep import Trial, as_toml, told
from torchvision_dddas.io.atomic_files import cannot_write, write_whole


@dataclass
class Swept:
    """What a sweep has found so far, as its files tell it."""

    folder: Path
    settings: Settings
    goal: Goal
    search: dict[str, Any]
    tuned: tuple[str, ...]
    held: tuple[str, ...]
    trials: list[Trial] = field(default_factory=list)
    best: Trial | None = None
    on_held: tuple[tuple[float, str], tuple[float, str]] | None = None

    def add(self, trial: Trial) -> None:
        """One trial more. Raises InputError where it cannot be written."""
        self.trials.append(trial)
        self._write("sweep.json", json.dumps(self._told(), indent=2) + "\n")

    def choose(self, best: Trial, on_held: tuple[tuple[float, str], tuple[float, str]] | None) -> None:
        """The sweep is over. on_held: the measure of the clips held out, of the settings as they were and the best."""
        self.best, self.on_held = best, on_held
        before = number(self.trials[0].value)
        about = [f"dddas sweep: {self.heading}: {number(best.value)}, with the settings as they were {before}."]
        about += [f"{parameter}: {value}" for parameter, value in best.parameters.items()]
        if on_held is not None:
            about.append(f"On the clips held out: {number(on_held[1][0])}, before {number(on_held[0][0])}.")
        self._write("sweep.json", json.dumps(self._told(), indent=2) + "\n")
        self._write("best.toml", as_toml(with_parameters(self.settings, best.parameters), about))

    @property
    def heading(self) -> str:
        """What is measured, in words."""
        return f"{self.goal.name}, {self.goal.by} over {len(self.tuned)} clip{'s' * (len(self.tuned) != 1)}"

    def _told(self) -> dict[str, Any]:
        held = None
        if self.on_held is not None:
            held = {"before": _nulled(self.on_held[0][0]), "best": _nulled(self.on_held[1][0])}
        return {
            "format": 1,
            "measure": self.goal.name,
            "by": self.goal.by,
            "better": "less" if self.goal.least else "more",
            "search": self.search,
            "settings": changes(self.settings),
            "clips": self.tuned,
            "held_out": self.held,
            "trials": told(self.trials),
            "best": None if self.best is None else self.best.number,
            "on_held_out": held,
        }

    def _write(self, name: str, text: str) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_whole(self.folder / name, text.encode())
        except OSError as error:
            raise cannot_write(self.folder / name, error) from error


def number(value: float) -> str:
    """A measure to four digits, or that there is none."""
    return "–" if math.isnan(value) else f"{value:.4f}"


def _nulled(value: float) -> float | None:
    return None if math.isnan(value) else value
