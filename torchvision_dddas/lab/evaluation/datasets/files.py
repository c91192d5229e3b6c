"""Folders and pictures on disk: names, numbers, sizes; and clips whose pictures must fit their truth."""

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.images import IMAGE_SUFFIXES, natural_order, read_image, size_in_header
from torchvision_dddas.io.sources import VideoSource
from torchvision_dddas.lab.evaluation.datasets.record import Clip

VIDEO_SUFFIXES = frozenset({".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".ts", ".mpg", ".mpeg", ".wmv"})


def images_in(folder: Path, suffixes: frozenset[str] = IMAGE_SUFFIXES) -> tuple[Path, ...]:
    """Return the images of a folder in natural order; none without a folder. Raise InputError if it cannot be read."""
    if not folder.is_dir():
        return ()
    try:
        files = [f for f in folder.iterdir() if f.suffix.lower() in suffixes and not f.name.startswith(".")]
    except OSError as error:
        raise InputError(f"folder {folder} cannot be read: {error.strerror}") from None
    return tuple(sorted(files, key=lambda file: natural_order(file.name)))


def videos_in(folder: Path) -> tuple[Path, ...]:
    """Return the videos of a folder, as `images_in` does."""
    return images_in(folder, VIDEO_SUFFIXES)


def folders_in(folder: Path) -> list[str]:
    """Return the names of the folders in a folder, without hidden ones; none without a folder.

    Raise InputError if the folder cannot be read.
    """
    try:
        return sorted(entry.name for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith("."))
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise InputError(f"{folder} cannot be read: {error.strerror}") from None


def find_below(folder: Path, is_clip: Callable[[Path], bool], depth: int) -> list[Path]:
    """Return the folders that are clips: this folder, or folders up to `depth` levels deeper. None lies in another."""
    if is_clip(folder):
        return [folder]
    return [place for name in folders_in(folder) if depth for place in find_below(folder / name, is_clip, depth - 1)]


def count_frames(pictures: tuple[Path, ...], announced: int = 0, source: str = "") -> int:
    """Return the frames of a clip, counted from its pictures or video, else as its source announces; 0 if unknown.

    Raise InputError if the two numbers differ, or if the video cannot be opened.
    """
    there = len(pictures)
    if there == 1 and is_video(pictures[0]):
        video = VideoSource(str(pictures[0]), pictures[0].name)
        there = (video.count or 0) if video.exact else 0
    if there and announced and there != announced:
        where = pictures[0] if len(pictures) == 1 else pictures[0].parent
        raise InputError(f"{where} has {there} frames, but {source} says {announced}; are they of the same clip?")
    return there or announced


def is_video(path: Path) -> bool:
    """Return whether a file is a video by its suffix."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def number_of(path: Path) -> int | None:
    """Return the last number in a file's name: 12 of frame_0012.jpg, 7 of 7.png; None without a number."""
    found = re.findall(r"[0-9]+", path.stem)
    return int(found[-1]) if found else None


def frames_by_number(pictures: Iterable[Path]) -> dict[int, int]:
    """Return the frame, from 1, of the number in each picture's name; empty if names lack numbers or repeat them."""
    frames: dict[int, int] = {}
    for frame, path in enumerate(pictures, 1):
        number = number_of(path)
        if number is None or number in frames:
            return {}
        frames[number] = frame
    return frames


def masks_by_frame(masks: Iterable[Path], frames: Mapping[int, int], place: Path) -> dict[int, Path]:
    """Return the masks by frame. frames: from `frames_by_number`. place: place of the pictures, for messages.

    Raise InputError for a mask whose number no picture has, and for two masks of one number.
    """
    found: dict[int, Path] = {}
    for path in masks:
        number = number_of(path)
        frame = frames.get(number) if number is not None else None
        if frame is None:
            span = f"its pictures are {min(frames)} to {max(frames)}" if frames else "it holds no numbered pictures"
            raise InputError(f"{path} labels no picture of {place}: {span}; is it the same clip?")
        if frame in found:
            raise InputError(f"{found[frame]} and {path} label the same picture; wanted one mask for each picture")
        found[frame] = path
    return found


def check_numbering(pictures: tuple[Path, ...], first: int) -> tuple[Path, ...]:
    """Return the pictures if they are numbered from `first` without a gap. Raise InputError otherwise."""
    for wanted, picture in enumerate(pictures, first):
        if number_of(picture) != wanted:
            raise InputError(f"{picture.parent} has {picture.name} in place of frame {wanted}; wanted all frames")
    return pictures


def fit_clip(clip: Clip) -> Clip:
    """Return the clip. Raise InputError without truth or pictures, or if frames or sizes differ from the truth's."""
    truth, place = clip.truth, clip.place
    if truth is None:
        if not clip.still:
            raise InputError(f"{place} has no truth, so that it cannot be scored")
        if not clip.pictures:
            raise InputError(f"{place} holds no pictures")
        return clip
    if not clip.pictures and (truth.kind != "boxes" or truth.tracks is None):
        raise InputError(f"{truth.place} is the truth of a clip without pictures; put the pictures into {place}")
    if clip.frames and truth.kind == "one target" and truth.length != clip.frames:
        lines = f"{truth.place} has {truth.length} lines, but the clip has {clip.frames} frames"
        raise InputError(f"{lines}; wanted one line for each frame")
    if clip.pictures and clip.frames:
        last = max(truth.frames, default=0)
        if last > clip.frames:
            labels = f"{truth.place} labels frame {last}, but the clip has {clip.frames} frames"
            raise InputError(f"{labels}; is it the same clip?")
        if truth.length > clip.frames:
            raise InputError(f"{truth.place} is of {truth.length} frames, but the clip has {clip.frames}; is it whole?")
    if truth.masks:
        # Check only the first and the last mask here. The others are checked when they are scored.
        check_mask_sizes(clip.pictures[0], [truth.masks[truth.frames[0]], truth.masks[truth.frames[-1]]])
    return clip


def check_mask_sizes(picture: Path, masks: Iterable[Path]) -> None:
    """Raise InputError for a mask of another size than the picture or video."""
    size = VideoSource(str(picture), picture.name).size if is_video(picture) else size_of(picture)
    for mask in masks:
        if (found := size_of(mask)) != size:
            raise InputError(
                f"{mask} is {found[0]}×{found[1]} pixels, but {picture.name} {size[0]}×{size[1]}; "
                "wanted masks of the same size"
            )


def size_of(path: Path) -> tuple[int, int]:
    """Return (width, height), px. A file is decoded only if it is not PNG, BMP, PNM or plain JPEG.

    Raise InputError if it is not a picture.
    """
    try:
        with path.open("rb") as file:
            head = file.read(32)
            if head[:2] == b"\xff\xd8":
                head += file.read(65536)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    # Exif may state that the picture must be rotated.
    size = None if b"Exif" in head or head[:2] in (b"II", b"MM") else size_in_header(head)
    if size is not None and min(size) > 0:
        return size
    image = read_image(path)
    if image is None:
        raise InputError(f"{path} is not a readable picture")
    return image.shape[1], image.shape[0]
