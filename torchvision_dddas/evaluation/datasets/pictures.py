"""The pictures of a clip as files: a folder's images in order, or one video."""

from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.picture_size import size_of
from torchvision_dddas.io.images import IMAGE_SUFFIXES, natural_order
from torchvision_dddas.io.video import VideoSource

VIDEO_SUFFIXES = frozenset({".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".ts", ".mpg", ".mpeg", ".wmv"})


def images_in(folder: Path, suffixes: frozenset[str] = IMAGE_SUFFIXES) -> tuple[Path, ...]:
    """The images of a folder in natural order, none where it is none. Raises InputError where it cannot be read."""
    return _files(folder, suffixes)


def videos_in(folder: Path) -> tuple[Path, ...]:
    """The videos of a folder in natural order, none where it is none. Raises InputError where it cannot be read."""
    return _files(folder, VIDEO_SUFFIXES)


def frames_of(pictures: tuple[Path, ...]) -> int:
    """How many frames they are: of a video what it announces, 0 where it does not say exactly.

    Raises InputError where the video cannot be opened.
    """
    if len(pictures) == 1 and is_video(pictures[0]):
        video = VideoSource(str(pictures[0]), pictures[0].name)
        return (video.count or 0) if video.exact else 0
    return len(pictures)


def frame_size(picture: Path) -> tuple[int, int]:
    """(width, height), px, of a picture or of a video's frames. Raises InputError where it cannot be read."""
    return VideoSource(str(picture), picture.name).size if is_video(picture) else size_of(picture)


def is_video(path: Path) -> bool:
    """Whether a file is one by its name."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def _files(folder: Path, suffixes: frozenset[str]) -> tuple[Path, ...]:
    if not folder.is_dir():
        return ()
    try:
        files = [f for f in folder.iterdir() if f.suffix.lower() in suffixes and not f.name.startswith(".")]
    except OSError as error:
        raise InputError(f"folder {folder} cannot be read: {error.strerror}") from None
    return tuple(sorted(files, key=lambda file: natural_order(file.name)))
