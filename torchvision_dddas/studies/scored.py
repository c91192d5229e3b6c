"""How right what was found in a clip is: counts that add over clips, frame by frame, and what curves are drawn of."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.metrics.clip import Counts


@dataclass(frozen=True)
class Scored:
    """One case's counts, which add over frames and clips.

    frames: (F,) those scored. counts: by group, over the clip. per_frame: by group and count, (F,) float64 each, NaN in
    frames that the group has no use for; for spread, plots and the worst frames. ranked: by group, (M, 3) of each
    detection its score, whether it is right (1, 0) or does not count (NaN), and its frame. samples: by name, (S,) each,
    what is no count: frame, identity, error_m and such of every target that was located. notes: what was left out.
    """

    frames: np.ndarray
    counts: Counts
    per_frame: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    ranked: Mapping[str, np.ndarray] = field(default_factory=dict)
    samples: Mapping[str, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
