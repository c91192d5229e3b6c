"""Data of the studies: real clips, MOTChallenge sequences, and the tests' synthetic scene."""

import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import bench
import cv2
import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.io.images import read_image
from torchvision_dddas.io.sources import ImageSource, open_source
from torchvision_dddas.lab.evaluation.datasets import motchallenge
from torchvision_dddas.lab.evaluation.datasets.files import folders_in, images_in, number_of
from torchvision_dddas.lab.evaluation.datasets.kinds import read
from torchvision_dddas.lab.evaluation.datasets.record import Clip, DatasetSource
from torchvision_dddas.lab.evaluation.metrics.truth import ClipTruth
from torchvision_dddas.lab.evaluation.studies.records import Task
from torchvision_dddas.lab.evaluation.studies.scoring import score
from torchvision_dddas.lab.evaluation.studies.stages import find
from torchvision_dddas.lab.evaluation.studies.summary import measures

sys.path.insert(0, str(bench.ROOT))
from tests.synthetic_clip import RATE_HZ, film_into, flight, render

__all__ = ["RATE_HZ", "film_into", "flight", "render"]

Size = tuple[int, int]
"""Width and height in pixels."""


def scene(size: Size, frames: int) -> list[np.ndarray]:
    """Return BGR frames of the synthetic scene at a size."""
    return render(seed=0, frames=frames, size=size).images


def read_frames(path: Path, most: int = 100) -> list[np.ndarray]:
    """Read up to `most` BGR frames of a video or a folder of pictures."""
    found = []
    for frame in open_source(str(path)):
        image = frame.image
        found.append(image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        if len(found) == most:
            break
    return found


def clips_in(folder: Path | None, only: str = "") -> list[Path]:
    """Return the folders with frames/ inside a folder. End the program with one line if there are none."""
    places = sorted(p for p in folder.iterdir() if (p / "frames").is_dir()) if folder and folder.is_dir() else []
    places = [place for place in places if only in place.name]
    if not places:
        sys.exit(f"{folder} holds no clips (folders with frames/); nothing was measured")
    return places


def resize(image: np.ndarray, size: Size) -> np.ndarray:
    """Crop the largest middle part of a picture with the aspect ratio of a size, and resize it to that size."""
    height, width = image.shape[:2]
    rows, columns = min(height, round(width * size[1] / size[0])), min(width, round(height * size[0] / size[1]))
    top, left = (height - rows) // 2, (width - columns) // 2
    part = image[top : top + rows, left : left + columns]
    return cv2.resize(part, size, interpolation=cv2.INTER_AREA if size[0] <= columns else cv2.INTER_CUBIC)


def there_and_back(frames: Sequence[np.ndarray], count: int) -> list[np.ndarray]:
    """Repeat a clip forwards and backwards to `count` frames, so that there are no cuts."""
    period = max(2 * len(frames) - 2, 1)
    return [frames[min(i % period, period - i % period)] for i in range(count)]


def write_video(path: Path, images: Sequence[np.ndarray], count: int, rate_hz: float = 25.0) -> None:
    """Write `count` frames of a clip played forwards and backwards."""
    height, width = images[0].shape[:2]
    kind = "MJPG" if path.suffix == ".avi" else "mp4v"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*kind), rate_hz, (width, height))
    for image in there_and_back(images, count):
        writer.write(image)
    writer.release()


# -- MOTChallenge sequences ------------------------------------------------------------------------------------------


def sequences(folder: Path) -> list[Path]:
    """Return the folders with gt/gt.txt, by name. End the program with one line if there are none."""
    places = motchallenge.sequences(folder)
    found = [places[name] for name in sorted(places) if (places[name] / "gt/gt.txt").is_file()]
    return found or sys.exit(f"{folder} holds no sequences with gt/gt.txt; nothing was measured")


def truth_of(place: Path) -> ClipTruth:
    """Return the truth of a sequence, with its tracks."""
    truth = motchallenge.sequence(place).truth
    assert truth is not None and truth.tracks is not None
    return truth


def film_of(place: Path) -> Path | None:
    """Return the video of a sequence, if it has one."""
    pictures = motchallenge.sequence(place).pictures
    return pictures[0] if len(pictures) == 1 else None


def single_pictures(place: Path) -> dict[int, Path]:
    """Return {frame: picture} of a sequence's folders img1*. Frames may be missing."""
    folders = [place / name for name in folders_in(place) if name.startswith("img1")]
    paths = [path for folder in folders for path in images_in(folder)]
    return {number: path for path in paths if (number := number_of(path)) is not None}


def has_pictures(place: Path, pictures: str) -> bool:
    """Return whether there is a video of all frames ("video"), or single pictures in folders img1* ("images")."""
    single = pictures != "video"
    return bool(single_pictures(place) if single else motchallenge.sequence(place).pictures)


def frames_of(place: Path, pictures: str) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the number and picture of each frame."""
    if pictures != "video":
        for number, path in sorted(single_pictures(place).items()):
            image = read_image(path)
            assert image is not None, path
            yield number, image
        return
    files = motchallenge.sequence(place).pictures
    for frame in open_source(files[0]) if len(files) == 1 else ImageSource(files, place.name):
        yield frame.number, frame.image


def identified_clips(data: Path, kinds: Iterable[str]) -> list[Clip]:
    """Return clips with true identities of several targets. A name in several kinds is taken from the first kind."""
    found: dict[str, Clip] = {}
    data = data.resolve()  # a relative path would be resolved inside itself
    for kind in kinds:
        for clip in read(DatasetSource(kind, data), data).clips:
            if clip.truth is not None and clip.truth.tracks is not None:
                found.setdefault(clip.name, clip)
    return list(found.values())


def measure_idf1(clip: Clip, task: Task, settings: Settings, interval: int) -> float:
    """Return IDF1 of the tracker on a clip."""
    found = find(clip, task, settings, "onboard", interval)
    return float(measures([score(clip, task, found, interval)])["tracks"]["idf1"])
