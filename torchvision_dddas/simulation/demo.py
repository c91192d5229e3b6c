"""The demo's clip on disk: frames that a user could have filmed, and the masks that are true."""

from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.io.atomic_files import cannot_write, write_whole
from torchvision_dddas.simulation.scene import FRAMES, SIZE, film


def make_room(folder: Path) -> None:
    """Make the folders of a clip. Raises InputError if the disk refuses."""
    try:
        for name in ("frames", "masks"):
            (folder / name).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(Path(error.filename or folder), error) from error


def film_into(folder: Path, seed: int = 0, frames: int = FRAMES, size: tuple[int, int] = SIZE) -> Path:
    """Write frames/000001.jpg ... and masks/000001.png ... into a folder, which is returned. Raises InputError."""
    make_room(folder)
    try:
        for number, picture in enumerate(film(seed, frames, size), 1):
            jpg = cv2.imencode(".jpg", picture.image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
            png = cv2.imencode(".png", picture.mask.astype(np.uint8))[1]
            write_whole(folder / "frames" / f"{number:06d}.jpg", jpg.tobytes())
            write_whole(folder / "masks" / f"{number:06d}.png", png.tobytes())
    except OSError as error:
        raise cannot_write(Path(error.filename or folder), error) from error
    return folder
