"""The record of what the feedback moved, so that a run can be explained afterwards."""

from torchvision_dddas.types import Adjustment


class Record:
    """The values in force by name, and the adjustments of the present frame."""

    def __init__(self) -> None:
        self.frame = 0
        self._values: dict[str, float] = {}
        self._made: list[Adjustment] = []

    def begin(self, frame: int) -> None:
        """All that is set from here on happened at this frame."""
        self.frame, self._made = frame, []

    def set(self, parameter: str, new: float, cause: str, old: float = 0.0, least: float = 0.0) -> None:
        """Write a value down where it differs by more than `least` from the one in force; old: the one at first."""
        now = self._values.setdefault(parameter, old)
        if abs(new - now) > least:
            self._values[parameter] = new
            self._made.append(Adjustment(self.frame, parameter, float(now), float(new), cause))

    def know(self, parameter: str, value: float) -> None:
        """A value that another line tells."""
        self._values[parameter] = value

    def add(self, adjustments: tuple[Adjustment, ...]) -> None:
        """Take over what another rule wrote."""
        self._made.extend(adjustments)

    def made(self) -> tuple[Adjustment, ...]:
        """The adjustments of the present frame, in order."""
        return tuple(self._made)


def counted(n: int, what: str) -> str:
    """1 target, 2 targets."""
    return f"{n} {what}" + ("" if n == 1 else "s")
