"""Which frame of a clip a file is: pictures and masks are named by numbers that begin anywhere."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from torchvision_dddas.errors import InputError


def number_of(path: Path) -> int | None:
    """The last number in a file's name: 12 of frame_0012.jpg, 7 of 7.png; None where there is none."""
    found = re.findall(r"[0-9]+", path.stem)
    return int(found[-1]) if found else None


def frames_by_number(pictures: Iterable[Path]) -> dict[int, int]:
    """The number in each picture's name -> the frame that it is, from 1; empty where names lack numbers or repeat them.

    pictures: in order.
    """
    frames: dict[int, int] = {}
    for frame, path in enumerate(pictures, 1):
        number = number_of(path)
        if number is None or number in frames:
            return {}
        frames[number] = frame
    return frames


def labelled(masks: Iterable[Path], frames: Mapping[int, int], place: Path) -> dict[int, Path]:
    """The masks by frame. frames: as of `frames_by_number`. place: of the pictures, for messages.

    Raises InputError: a mask of whose number there is no picture, or two of one number.
    """
    found: dict[int, Path] = {}
    for path in masks:
        number = number_of(path)
        frame = frames.get(number) if number is not None else None
        if frame is None:
            first, last = (min(frames), max(frames)) if frames else (0, 0)
            held = f"its pictures are {first} to {last}" if frames else "it holds no numbered pictures"
            raise InputError(f"{path} labels no picture of {place}: {held}; is it the same clip?")
        if frame in found:
            raise InputError(f"{found[frame]} and {path} label the same picture; wanted one mask a picture")
        found[frame] = path
    return found
