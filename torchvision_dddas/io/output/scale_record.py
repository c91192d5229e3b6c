"""The size of people in the pictures of a run, and its source: for the screen, run.json and the report."""

from collections.abc import Mapping, Sequence
from typing import Any

from torchvision_dddas.config import is_tiny
from torchvision_dddas.types import Adjustment


class ScaleRecord:
    """Follows the adjustments of `gates.person_px` (px, 0 if unknown) and `gates.tiny` (1 or 0)."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        """settings: settings of the run, as in run.json."""
        gates, kind = settings.get("gates", {}), settings.get("difference", {}).get("kind", "")
        stated_px = gates.get("person_px", 0.0)
        tiny = is_tiny(stated_px, gates.get("tiny_px", 0.0), kind)
        self._now = {"gates.person_px": stated_px, "gates.tiny": float(tiny)}
        self._cause = "as gates.person_px says"
        self._sizes: dict[float, str] = {}  # the source of each size
        self._frames = self._tiny = self._known = 0

    def add(self, adjustments: Sequence[Adjustment]) -> None:
        """Count the next frame after its adjustments."""
        for made in adjustments:
            if made.parameter in self._now:
                self._now[made.parameter], self._cause = made.new, made.cause
        size_px, tiny = self._now.values()
        if size_px:
            self._sizes.setdefault(size_px, self._cause)
        self._frames, self._tiny, self._known = self._frames + 1, self._tiny + bool(tiny), self._known + bool(size_px)

    def facts(self) -> dict[str, Any]:
        """Return the range of sizes, the source of the first size, and in how many frames sizes were known and tiny."""
        sizes = [min(self._sizes), max(self._sizes)] if self._sizes else None
        counts = {"frames": self._frames, "frames_known": self._known, "frames_tiny": self._tiny}
        return {"person_px": sizes, "from": next(iter(self._sizes.values()), None), **counts}

    def line(self) -> str:
        """Return the facts in one line."""
        if not self._sizes:
            return "scale: the size of people is unknown: it needs the height above ground and the focal length"
        low, high = f"{min(self._sizes):.1f}", f"{max(self._sizes):.1f}"
        size, first = (low, "") if low == high else (f"{low} to {high}", "at first ")
        unknown = f"; unknown in {self._frames - self._known} frames" if self._known < self._frames else ""
        which = {0: "the usual settings", self._frames: "the settings for tiny people"}
        used = which.get(self._tiny, f"the settings for tiny people in {self._tiny} of {self._frames} frames")
        return f"scale: a person is about {size} px ({first}{next(iter(self._sizes.values()))}){unknown}; {used}"
