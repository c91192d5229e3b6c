"""What was read of a log so far: values at times, each with its place in the file, and what the user should know."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError

OWN = "table"
"""The kind of our own tables, which may leave out what they like."""


@dataclass
class Log:
    """What was read so far. path: of the file. kind: in words, for messages. where: what samples are counted in.

    bridge_s: how long a column may be silent beside others and still be taken to go on; 0 where silence means unknown.
    jitter_s: how far time may run back; more is another recording, or damage.
    said: time, value and place in the file of what was said of each quantity. moments: time and place of the rows of
    a log that says everything at once, whether or not there was anything to say. columns: (N, 3), as in said.
    """

    path: Path
    kind: str
    where: str = "line"
    bridge_s: float = 0.0
    jitter_s: float = 1.0
    notes: list[str] = field(default_factory=list)
    said: dict[str, list[tuple[float, float, int]]] = field(default_factory=dict)
    moments: list[tuple[float, int]] = field(default_factory=list)
    columns: dict[str, np.ndarray] = field(default_factory=dict)

    def say(self, quantity: str, time_s: float, value: float, where: int) -> None:
        """One value at a time; NaN says that it is unknown there. where: the line, or what `where` names.

        quantity: a column of the record; of the place longitude_deg and latitude_deg, or east_m and north_m.
        """
        self.said.setdefault(quantity, []).append((time_s, value, where))

    def say_all(self, quantity: str, times: np.ndarray, values: np.ndarray, where: np.ndarray) -> None:
        """Many at once."""
        self.columns[quantity] = np.stack([times, values, where], axis=1).astype(float)

    def note(self, text: str) -> None:
        """What the user should know, once."""
        if text not in self.notes:
            self.notes.append(text)

    def refuse(self, text: str, where: int | None = None) -> InputError:
        """The error to raise, with the file and the place."""
        place = f", {self.where} {where}" if where is not None else ""
        return InputError(f"telemetry {self.path}{place}: {text}")
