"""A small data set on disk: clips of bright plates that move over a ground seen from a moving camera, and tables."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

SIZE = (176, 132)


def film(seed: int, frames: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pictures and their masks. The camera moves, and two plates over the ground."""
    rng = np.random.default_rng(seed)
    width, height = SIZE
    ground = cv2.GaussianBlur(rng.integers(0, 256, (height + 100, width + 100, 3), dtype=np.uint8), (0, 0), 1.5)
    ground = np.interp(ground, (ground.min(), ground.max()), (20, 200)).astype(np.uint8)
    places = rng.uniform((60, 40), (120, 90), (2, 2))
    speeds = np.array([[5.0, 0.0], [0.0, -4.0]])
    for k in range(frames):
        picture, mask = ground.copy(), np.zeros(ground.shape[:2], np.uint8)
        for value, (place, speed) in enumerate(zip(places, speeds, strict=True), 1):
            x, y = np.round(place + k * speed).astype(int).tolist()
            cv2.rectangle(picture, (x, y), (x + 15, y + 11), (230, 240, 250) if value == 1 else (5, 10, 30), -1)
            cv2.rectangle(mask, (x, y), (x + 15, y + 11), value, -1)
        u, v = 10 + 2 * k, 20 + k
        noise = rng.normal(0, 1.5, (height, width, 3))
        view = np.clip(picture[v : v + height, u : u + width] + noise, 0, 255).astype(np.uint8)
        yield view, mask[v : v + height, u : u + width]


def filmed(folder: Path, name: str, seed: int = 0, frames: int = 10, masks: bool = True) -> Path:
    """A clip, with masks of each frame."""
    place = folder / name
    (place / "frames").mkdir(parents=True)
    for number, (picture, mask) in enumerate(film(seed, frames), 1):
        cv2.imwrite(str(place / "frames" / f"{number:06d}.png"), picture)
        if masks:
            (place / "masks").mkdir(exist_ok=True)
            cv2.imwrite(str(place / "masks" / f"{number:06d}.png"), mask)
    return place


def followed(folder: Path, name: str, seed: int = 0, frames: int = 10, pictures: bool = True) -> Path:
    """A clip with true tracks, with or without pictures, and with detections that lack identities."""
    place = folder / name
    if pictures:
        filmed(folder, name, seed, frames, masks=False)
    (place / "gt").mkdir(parents=True)
    (place / "det").mkdir()
    rows, bare = [], []
    for number, (_, mask) in enumerate(film(seed, frames), 1):
        for value in np.unique(mask)[1:].tolist():
            v, u = np.nonzero(mask == value)
            box = f"{u.min()},{v.min()},{np.ptp(u) + 1},{np.ptp(v) + 1}"
            rows.append(f"{number},{value},{box},1,-1,-1,-1\n")
            bare.append(f"{number},-1,{box},1,-1,-1,-1\n")
    (place / "gt" / "gt.txt").write_text("".join(rows))
    (place / "det" / "det.txt").write_text("".join(bare))
    return place


def study(folder: Path, text: str = "") -> Path:
    """The file of a study of the clips in a folder."""
    path = folder.parent / "study.toml"
    path.write_text(f'{text}\n[[dataset]]\nkind = "folder"\nfolder = "{folder.name}"\n')
    return path


def three(folder: Path) -> Path:
    """A study of a clip with masks, one with tracks, and one of a table alone; the file."""
    filmed(folder, "masks", 1)
    followed(folder, "tracks", 2)
    followed(folder, "table", 3, pictures=False)
    return study(folder)
