"""What the studies of speed look at: clips named by the user, or the project's own scene, at the sizes asked for."""

import argparse
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.io.sources import open_source

Size = tuple[int, int]
"""Width and height, px."""
SPOT_PX = 4


def size_of(text: str) -> Size:
    """Of an option such as 640x480."""
    try:
        width, height = (int(side) for side in text.split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is no size; give one as 640x480") from None
    return width, height


def clips(arguments: list[str], sizes: list[Size], frames: int = 40) -> Iterator[tuple[str, list[np.ndarray]]]:
    """(name, frames as BGR) of the clips named as they are, or of the project's own scene at each of the sizes.

    A clip is a video, a folder of pictures, or a folder that holds clips.
    """
    if not arguments:
        yield from ((f"scene {width}x{height}", scene((width, height), frames)) for width, height in sizes)
    for argument in arguments:
        folder = Path(argument)
        held = [p for p in sorted(folder.iterdir()) if p.is_dir() and p.name != "masks"] if folder.is_dir() else []
        if (folder / "frames").is_dir():
            yield folder.name, pictures(folder / "frames")
        elif held:
            yield from clips([str(p) for p in held], sizes)
        else:
            yield folder.stem, pictures(folder)


def scene(size: Size, frames: int) -> list[np.ndarray]:
    """The project's own scene, filmed at a size."""
    from synthetic import render

    return render(seed=0, frames=frames, size=size).images


def pictures(path: Path, most: int = 100) -> list[np.ndarray]:
    """Up to `most` decoded BGR frames."""
    found = []
    for frame in open_source(str(path)):
        image = frame.image
        found.append(image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        if len(found) == most:
            break
    return found


def resized(image: np.ndarray, size: Size) -> np.ndarray:
    """The largest middle part of a picture that has the sides of the size asked for, made as large as that."""
    height, width = image.shape[:2]
    rows, columns = (min(own, round(other)) for own, other in zip(
        (height, width), (width * size[1] / size[0], height * size[0] / size[1]), strict=True
    ))  # fmt: skip
    top, left = (height - rows) // 2, (width - columns) // 2
    part = image[top : top + rows, left : left + columns]
    return cv2.resize(part, size, interpolation=cv2.INTER_AREA if size[0] <= columns else cv2.INTER_CUBIC)


def there_and_back(frames: list[np.ndarray], count: int) -> list[np.ndarray]:
    """The clip forwards and backwards until there are `count` frames: no cuts."""
    period = max(2 * len(frames) - 2, 1)
    return [frames[min(i % period, period - i % period)] for i in range(count)]


def write_video(path: Path, images: list[np.ndarray], count: int, rate_hz: float = 25.0) -> None:
    """A file of `count` frames of a clip played forwards and backwards."""
    height, width = images[0].shape[:2]
    kind = "MJPG" if path.suffix == ".avi" else "mp4v"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*kind), rate_hz, (width, height))
    for image in there_and_back(images, count):
        writer.write(image)
    writer.release()


def peopled(frames: list[np.ndarray], count: int, seed: int = 0) -> list[np.ndarray]:
    """The clip with so many more movers: patches that go to and fro, each in its own part of the picture.

    A part is left to one mover, so that none touch and all are counted alone. Sizes go with the picture's.
    """
    if not count:
        return frames
    rng = np.random.default_rng([seed, count])
    height, width = frames[0].shape[:2]
    columns = int(np.ceil(np.sqrt(count * width / height)))
    rows = int(np.ceil(count / columns))
    cell = np.array([width / columns, height / rows])
    side = np.minimum([width / 20, height / 15], 0.45 * cell).astype(int).clip(4)
    corners = [cell * (k % columns, k // columns) for k in range(count)]
    patches = [textured(rng, side) for _ in range(count)]
    phases = rng.uniform(0, 2, count)
    drawn = []
    for number, frame in enumerate(frames):
        picture = frame.copy()
        for corner, patch, phase in zip(corners, patches, phases, strict=True):
            room = cell - side - 2
            # To and fro at an even pace, the same share of the side at every size.
            gone = phase + number * max(side[0] / 4, 2) / max(room[0], 1)
            x, y = (corner + 1 + room * (abs((gone + 1) % 2 - 1), 0.5)).astype(int)
            picture[y : y + side[1], x : x + side[0]] = patch
        drawn.append(picture)
    return drawn


def textured(rng: np.random.Generator, side: np.ndarray) -> np.ndarray:
    """A patch of coarse spots, BGR: an even one would show at its edges alone."""
    spots = rng.integers(30, 226, (-(-side[1] // SPOT_PX), -(-side[0] // SPOT_PX), 3), np.uint8)
    return spots.repeat(SPOT_PX, axis=0).repeat(SPOT_PX, axis=1)[: side[1], : side[0]]
