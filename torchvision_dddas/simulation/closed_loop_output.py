"""The folder of a run in a simulated world: what a run of the whole path leaves, and the truth beside it."""

import math
from collections import deque
from pathlib import Path
from typing import ClassVar

from torchvision_dddas.io.atomic_files import remove
from torchvision_dddas.io.output.detection_output import uninterrupted
from torchvision_dddas.io.output.pipeline_output import ALL, SurveyOutput
from torchvision_dddas.io.output.pipeline_output import SAVED as MADE
from torchvision_dddas.simulation.truth_output import LonLat, TruthOutput
from torchvision_dddas.types import FrameResult, Truth

SAVED = (*MADE, "truth")
"""What --save may name. The tables and run.json are always written."""


class FlownOutput(SurveyOutput):
    """As SurveyOutput, with truth/ for `dddas evaluate`: the tables of TruthOutput, without masks."""

    files: ClassVar[tuple[str, ...]] = (*ALL, *TruthOutput.files)

    def knows(self, lonlat: LonLat) -> None:
        """After `also`. lonlat: (N, 2) longitudes and latitudes of (N, 2) metres of the world."""
        self._truth = TruthOutput(self.folder, lonlat, masks=False) if "truth" in self._save else None
        self._ahead: deque[Truth] = deque()

    def true(self, truth: Truth) -> None:
        """What is true of a frame, before it is surveyed: it is written then, so that both end at one frame."""
        if self._truth is not None:
            self._ahead.append(truth)

    def survey(self, item: FrameResult) -> None:
        """Write a frame and what is true until then. Raises InputError if the disk refuses."""
        with uninterrupted():
            super().survey(item)
            self._write(item.followed.number)

    def close(self, complete: bool) -> None:
        """Put everything in its place, as SurveyOutput; the truth of an earlier run here goes."""
        with uninterrupted():
            with self._refusals():
                if self._truth is None:
                    _without(self.folder)
                else:
                    if complete:
                        self._write(math.inf)
                    self._truth.close(complete)
            super().close(complete)

    def discard(self) -> None:
        """Leave only what is whole."""
        with uninterrupted():
            truth = getattr(self, "_truth", None)
            if truth is not None:
                truth.discard()
            super().discard()

    def _write(self, until: float) -> None:
        """The truths that wait, up to a frame."""
        with self._refusals():
            while self._truth is not None and self._ahead and self._ahead[0].frame <= until:
                self._truth.write(self._ahead.popleft())


def _without(folder: Path) -> None:
    """Remove an earlier run's truth."""
    for name in TruthOutput.files:
        remove(folder / name)
