"""One PNG a frame: 0 background, otherwise the number of the target in that frame."""

import re
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.io.atomic_files import write_whole
from torchvision_dddas.types import Scene

NAME = re.compile(r"\d{6,}\.png")


class Masks:
    """masks/000001.png and so on, each whole once it is there. 8 bits, or 16 for frames with over 255 targets."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "masks"
        self._last = 0

    def write(self, scene: Scene) -> None:
        """Write the mask of a frame. Raises OSError if the disk refuses."""
        self.add(scene.frame.number, scene.mask)

    def add(self, number: int, mask: np.ndarray) -> None:
        """The same for the mask (H, W) of any frame."""
        self._folder.mkdir(exist_ok=True)
        kind = np.uint8 if mask.size == 0 or mask.max() <= 255 else np.uint16
        # Level 1: masks are nearly empty, and higher levels cost time for a few bytes.
        ok, png = cv2.imencode(".png", mask.astype(kind, copy=False), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if not ok:
            raise OSError(f"mask of frame {number} could not be encoded")
        write_whole(self._folder / f"{number:06d}.png", png.tobytes())
        self._last = number

    def close(self, complete: bool) -> None:
        """Remove the masks of an earlier, longer clip, so that the folder speaks of one clip only."""
        for path in self._folder.glob("*.png"):
            if NAME.fullmatch(path.name) and int(path.stem) > self._last:
                path.unlink()

    def discard(self) -> None:
        """Nothing to do: each mask is whole already."""
