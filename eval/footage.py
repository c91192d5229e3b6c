"""MOTChallenge's sequences as the studies here use them, by the adapter that reads them: places, truth, pictures."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from torchvision_dddas.evaluation.datasets import motchallenge
from torchvision_dddas.evaluation.metrics.truth import Truth
from torchvision_dddas.io.images import ImageSource, read_image
from torchvision_dddas.io.sources import open_source


def sequences(folder: Path) -> list[Path]:
    """The folders with truth, by name."""
    places = motchallenge.sequences(folder)
    return [places[name] for name in sorted(places) if (places[name] / "gt/gt.txt").is_file()]


def truth_of(place: Path) -> Truth:
    """What is true of a sequence, with its tracks."""
    truth = motchallenge.sequence(place).truth
    assert truth is not None and truth.tracks is not None
    return truth


def film_of(place: Path) -> Path | None:
    """Its video, where it has one."""
    pictures = motchallenge.sequence(place).pictures
    return pictures[0] if len(pictures) == 1 else None


def has_pictures(place: Path, pictures: str) -> bool:
    """Whether a sequence has them. pictures: video for those of all frames, images for single ones in img1*."""
    single = pictures != "video"
    return bool(motchallenge.single_pictures(place) if single else motchallenge.sequence(place).pictures)


def frames_of(place: Path, pictures: str) -> Iterator[tuple[int, np.ndarray]]:
    """The number and the picture of each frame that there is."""
    if pictures != "video":
        for number, path in sorted(motchallenge.single_pictures(place).items()):
            image = read_image(path)
            assert image is not None, path
            yield number, image
        return
    files = motchallenge.sequence(place).pictures
    for frame in open_source(files[0]) if len(files) == 1 else ImageSource(files, place.name):
        yield frame.number, frame.image
