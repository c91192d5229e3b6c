"""What goes wrong, when, and how it is said."""

from dataclasses import dataclass, field

from torchvision_dddas.simulation.scenario import Fault

_WORDS = {
    "ugv_lost": ("{who} is lost", "{who} is back"),
    "gps_dropout": ("{who} has no GPS", "{who} has GPS again"),
    "gps_jump": ("the GPS of {who} is off by {size:g} m", "the GPS of {who} is as before"),
    "frozen": ("the UAV's camera repeats a picture", "the UAV's camera sees again"),
    "dropped": ("pictures of the UAV are missing", "the UAV's pictures come again"),
    "gust": ("a gust pushes the UAV with {size:g} m/s", "the gust is over"),
    "landmark_hidden": ("the marker of {who} is covered", "the marker of {who} is seen again"),
    "telemetry_silent": ("the UAV says nothing of itself", "the UAV reports again"),
}


@dataclass(frozen=True)
class Wrong:
    """What is wrong at a moment; vehicles by their rows, from 0. jumped: metres, by vehicle."""

    lost: frozenset[int] = frozenset()
    silent: frozenset[int] = frozenset()
    covered: frozenset[int] = frozenset()
    jumped: dict[int, float] = field(default_factory=dict)
    picture: str = ""
    mute: bool = False


class Faults:
    """The faults of a scenario; a fault lasts from its time until, but not at, its end."""

    def __init__(self, faults: tuple[Fault, ...]) -> None:
        self._faults = faults

    def at(self, time_s: float) -> Wrong:
        """What is wrong at a time."""
        now = [fault for fault in self._faults if _on(fault, time_s)]

        def vehicles(what: str) -> frozenset[int]:
            return frozenset(fault.vehicle - 1 for fault in now if fault.what == what)

        kinds = {fault.what for fault in now}
        return Wrong(
            vehicles("ugv_lost"),
            vehicles("gps_dropout"),
            vehicles("landmark_hidden"),
            {fault.vehicle - 1: fault.size for fault in now if fault.what == "gps_jump"},
            "dropped" if "dropped" in kinds else "frozen" if "frozen" in kinds else "",
            "telemetry_silent" in kinds,
        )

    def gusts(self, time_s: float) -> list[tuple[int, float, float]]:
        """(row of the fault, seconds since it began, size) of the gusts that blow."""
        return [
            (row, time_s - fault.time_s, fault.size)
            for row, fault in enumerate(self._faults)
            if fault.what == "gust" and _on(fault, time_s)
        ]

    def events(self, before_s: float, now_s: float) -> list[str]:
        """What began or ended after the one time, and until the other, in words."""
        said = []
        for fault in self._faults:
            who = f"ugv{fault.vehicle}"
            for words, time_s in zip(_WORDS[fault.what], (fault.time_s, fault.time_s + fault.seconds), strict=True):
                if before_s < time_s - _EARLY_S <= now_s:
                    said.append((time_s, words.format(who=who, size=fault.size)))
        return [words for _, words in sorted(said)]


_EARLY_S = 1e-9
"""Times of frames are rounded; a fault begins at the frame of its time, not one later."""


def _on(fault: Fault, time_s: float) -> bool:
    return fault.time_s - _EARLY_S <= time_s < fault.time_s + fault.seconds - _EARLY_S
