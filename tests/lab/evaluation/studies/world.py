"""A small data set on disk: clips of bright plates that move over a ground seen from a moving camera, and tables."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.lab.evaluation.datasets.kinds import read
from torchvision_dddas.lab.evaluation.datasets.record import Clip, DatasetSource

WIDTH, HEIGHT = 176, 132


def film(seed: int, frames: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pictures and their masks. The camera moves, and two plates over the ground."""
    rng = np.random.default_rng(seed)
    ground = cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT + 100, WIDTH + 100, 3), dtype=np.uint8), (0, 0), 1.5)
    ground = np.interp(ground, (ground.min(), ground.max()), (20, 200)).astype(np.uint8)
    places = rng.uniform((60, 40), (120, 90), (2, 2))
    speeds, colours = np.array([[5.0, 0.0], [0.0, -4.0]]), ((230, 240, 250), (5, 10, 30))
    for k in range(frames):
        picture, mask = ground.copy(), np.zeros(ground.shape[:2], np.uint8)
        for value, (x, y) in enumerate(np.round(places + k * speeds).astype(int).tolist(), 1):
            cv2.rectangle(picture, (x, y), (x + 15, y + 11), colours[value - 1], -1)
            cv2.rectangle(mask, (x, y), (x + 15, y + 11), value, -1)
        seen = slice(20 + k, 20 + k + HEIGHT), slice(10 + 2 * k, 10 + 2 * k + WIDTH)
        view = picture[seen] + rng.normal(0, 1.5, (HEIGHT, WIDTH, 3))
        yield np.clip(view, 0, 255).astype(np.uint8), mask[seen]


def filmed(folder: Path, name: str, seed: int = 0, frames: int = 10, masks: bool = True) -> Path:
    """A clip, with masks of each frame."""
    for part in ("frames", "masks")[: 1 + masks]:
        (folder / name / part).mkdir(parents=True)
    for number, (picture, mask) in enumerate(film(seed, frames), 1):
        cv2.imwrite(str(folder / name / "frames" / f"{number:06d}.png"), picture)
        if masks:
            cv2.imwrite(str(folder / name / "masks" / f"{number:06d}.png"), mask)
    return folder / name


def followed(folder: Path, name: str, seed: int = 0, frames: int = 10, pictures: bool = True) -> Path:
    """A clip with true tracks, with or without pictures, and with detections that lack identities."""
    if pictures:
        filmed(folder, name, seed, frames, masks=False)
    boxes = [
        (number, value, "{},{},{},{}".format(*cv2.boundingRect((mask == value).astype(np.uint8))))
        for number, (_, mask) in enumerate(film(seed, frames), 1)
        for value in np.unique(mask)[1:].tolist()
    ]
    for part, identified in (("gt", True), ("det", False)):
        (folder / name / part).mkdir(parents=True)
        lines = [f"{number},{value if identified else -1},{box},1,-1,-1,-1\n" for number, value, box in boxes]
        (folder / name / part / f"{part}.txt").write_text("".join(lines))
    return folder / name


def study(folder: Path, text: str = "") -> Path:
    """The file of a study of the clips in a folder."""
    path = folder.parent / "study.toml"
    path.write_text(f'{text}\n[[dataset]]\nkind = "folder"\nfolder = "{folder.name}"\n')
    return path


def three(folder: Path, tracked: int = 10) -> Path:
    """A study of a clip with masks, one with tracks in so many pictures, and one of a table alone; the file."""
    filmed(folder, "masks", 1)
    followed(folder, "tracks", 2, tracked)
    followed(folder, "table", 3, pictures=False)
    return study(folder)


def clips_in(folder: Path, *names: str) -> tuple[Clip, ...]:
    """The clips of a folder, or some of them."""
    return tuple(read(DatasetSource("folder", folder, names or ("*",)), folder).clips)
