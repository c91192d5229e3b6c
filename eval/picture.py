"""The README's picture: `python eval/picture.py DEMO_FOLDER FRAME PICTURE.jpg`, as filmed and with its targets."""

import sys
from pathlib import Path

import cv2
import numpy as np


def main(folder: Path, number: int, picture: Path) -> None:
    """Join the filmed frame and the same frame of overlay.mp4."""
    filmed = cv2.imread(str(folder / "clip" / "frames" / f"{number:06d}.jpg"))
    film = cv2.VideoCapture(str(folder / "overlay.mp4"))
    film.set(cv2.CAP_PROP_POS_FRAMES, number - 1)
    read, drawn = film.read()
    if filmed is None or not read:
        sys.exit(f"{folder} has no frame {number}; run dddas demo --out {folder}")
    gap = np.full((filmed.shape[0], 8, 3), 255, np.uint8)
    cv2.imwrite(str(picture), np.hstack([filmed, gap, drawn]), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
