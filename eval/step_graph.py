"""The `step` graph of `dddas export` as a chain among the others: grey pictures in, mask out, then the targets."""

from pathlib import Path

import cv2
import numpy as np
from plain_chain import LEAST_AREA_PX

from torchvision_dddas.settings import load
from torchvision_dddas.vision.cells import cell_side
from torchvision_dddas.vision.graphs import opened

NAME = "graph step"


def file_of(size: tuple[int, int]) -> str:
    """The graph's name for a size of picture."""
    return f"step_{size[0]}x{size[1]}.onnx"


class StepGraph:
    """Each frame against the two after it, as the plain chain does. One thread of ONNX Runtime."""

    def __init__(self, folder: Path, size: tuple[int, int]) -> None:
        self.session = opened(folder, file_of(size))
        knobs = load("fast")
        cell = cell_side(*size, knobs.registration)
        count = (size[0] // cell) * (size[1] // cell)
        hypotheses = next(i.shape[0] for i in self.session.get_inputs() if i.name == "samples")
        rng = np.random.default_rng(0)
        self.given = {
            "samples": np.stack([rng.choice(count, 4, replace=False) for _ in range(hypotheses)]).astype(np.int64),
            "tolerance_px": np.array(knobs.registration.ransac_px, np.float64),
            "threshold": np.array(int(knobs.difference.threshold), np.uint8),
        }
        self.greys: list[np.ndarray] = []

    def mask(self, greys: list[np.ndarray]) -> np.ndarray:
        """(H, W) uint8 of what moves in the first of three grey pictures."""
        found: np.ndarray = self.session.run(
            ["mask"], {"reference": greys[0], "neighbours": np.stack(greys[1:]), **self.given}
        )[0]
        return found

    def grey(self, image: np.ndarray) -> list[np.ndarray]:
        """Take a frame; the latest three, once there are so many."""
        self.greys = [*self.greys[-2:], cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)]
        return self.greys


def boxes(mask: np.ndarray) -> np.ndarray:
    """(N, 4) of the blobs that are large enough."""
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask)
    return stats[1:, :4][stats[1:, cv2.CC_STAT_AREA] >= LEAST_AREA_PX].astype(float)
