"""Where frames come from: files, folders, cameras, streams, simulated worlds; and what the vehicle reports."""

from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.images import IMAGE_SUFFIXES, ImageSource, images_of_folder, images_of_glob
from torchvision_dddas.io.video import VideoSource
from torchvision_dddas.types import Problem, Source

__all__ = ["Problem", "Source", "open_source"]


def open_source(
    spec: str | Path, *, rate_hz: float | None = None, full_scale: int | None = None, single: bool = False
) -> Source:
    """A clip from what the user typed: a video file, a folder or glob of images, `camera:0`, `rtsp://...`, `sim:four`.

    sim: and the name or file of a scenario is a SimulatorSource, which can be steered.
    rate_hz: frames a second; None takes the video's own, and 10 for images. full_scale: see ImageSource.
    single: a file that is one image is a clip of one frame; else it is refused, as nothing can be seen to move in it.
    Raises InputError with one line when it cannot be read.
    """
    text = str(spec)
    if rate_hz is not None and not 0 < rate_hz <= 1000:
        raise InputError(f"a frame rate of {rate_hz} per second will not do; wanted more than 0, at most 1000")
    if full_scale is not None and not 1 <= full_scale <= 65535:
        raise InputError(f"a full scale of {full_scale} will not do; wanted 1 to 65535")
    if text.startswith("sim:"):
        from torchvision_dddas.simulation import open_scenario

        if rate_hz is not None:
            raise InputError(f"{text} says how many frames a second it has (clip.rate_hz): leave --rate out")
        return open_scenario(text.removeprefix("sim:"))
    if text.startswith("camera:"):
        index = text.removeprefix("camera:")
        if not index.isdecimal() or len(index) > 4:
            raise InputError(f"'{text}' names no camera; wanted camera:0, camera:1, ...")
        return VideoSource(int(index), text, rate_hz)
    if "://" in text:
        return VideoSource(text, text, rate_hz)
    if not text:
        raise InputError(
            "the input's name is empty; wanted a video file, a folder or glob of images, camera:0, rtsp://..., "
            "sim:SCENARIO"
        )
    path = Path(text)
    try:
        path.stat()
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:  # a name too long, a folder that may not be entered, a name with a NUL
        raise InputError(f"{text[:200]} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if path.is_dir():
        return ImageSource(images_of_folder(path), text, rate_hz or 10.0, full_scale)
    if path.is_file():
        if path.suffix.lower() in IMAGE_SUFFIXES:
            if single:
                return ImageSource([path], text, rate_hz or 10.0, full_scale)
            raise InputError(
                f"{path} is one image, not a clip; give its folder, or a glob in quotes such as 'frames/*.png'"
            )
        return VideoSource(text, text, rate_hz)
    if any(sign in text for sign in "*?["):
        return ImageSource(images_of_glob(text), text, rate_hz or 10.0, full_scale)
    raise InputError(
        f"{path} does not exist; wanted a video file, a folder or glob of images, camera:0, rtsp://... or sim:NAME"
    )
