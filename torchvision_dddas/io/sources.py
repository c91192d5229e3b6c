"""Where frames come from: video files, folders and globs of images, cameras, network streams."""

from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.images import IMAGE_SUFFIXES, ImageSource, images_of_folder, images_of_glob
from torchvision_dddas.io.video import VideoSource, stream_target
from torchvision_dddas.types import Source

_WANTED = "a video file, a folder or glob of images, camera:0, rtsp://... or sim:SCENARIO"


def open_source(
    spec: str | Path, *, rate_hz: float | None = None, full_scale: int | None = None, single: bool = False
) -> Source:
    """Open a clip: a video file, a folder or glob of images, `camera:0`, `rtsp://...`.

    rate_hz: frames a second; None takes the video's own, and 10 for images. full_scale: see ImageSource.
    single: a file that is one image is a clip of one frame; else it is refused, since nothing can move in it.
    Raises InputError with one line when it cannot be read.
    """
    text = str(spec)
    if rate_hz is not None and not 0 < rate_hz <= 1000:
        raise InputError(f"the frame rate must be more than 0 and at most 1000 per second, got {rate_hz}")
    if full_scale is not None and not 1 <= full_scale <= 65535:
        raise InputError(f"the full scale must be between 1 and 65535, got {full_scale}")
    if not text:
        raise InputError(f"the input's name is empty; wanted {_WANTED}")
    if (target := stream_target(text)) is not None:
        return VideoSource(target, text, rate_hz)
    path = Path(text)
    try:
        path.stat()
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:  # a name too long, a folder that may not be entered, a name with a NUL
        raise InputError(f"{text[:200]} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if path.is_file() and path.suffix.lower() not in IMAGE_SUFFIXES:
        return VideoSource(text, text, rate_hz)
    if path.is_file() and not single:
        raise InputError(
            f"{path} is one image, not a clip; give its folder, or a glob in quotes such as 'frames/*.png'"
        )
    if path.is_file():
        files = [path]
    elif path.is_dir():
        files = images_of_folder(path)
    elif any(sign in text for sign in "*?["):
        files = images_of_glob(text)
    else:
        raise InputError(f"{path} does not exist; wanted {_WANTED}")
    return ImageSource(files, text, rate_hz or 10.0, full_scale)
