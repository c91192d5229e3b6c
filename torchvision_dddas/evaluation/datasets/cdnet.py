"""Change detection: CDnet 2012 (Goyette et al.) and 2014 (Wang et al.), changedetection.net.

    CATEGORY/VIDEO/input/in000001.jpg         the frames
    CATEGORY/VIDEO/groundtruth/gt000001.png   0 static, 50 hard shadow, 85 outside the region of interest, 170 unknown,
                                              255 moving
    CATEGORY/VIDEO/temporalROI.txt            the first and the last frame that count
    CATEGORY/VIDEO/ROI.bmp                    the region of interest; what is outside is 85 in the masks too

A clip is called CATEGORY-VIDEO. As in its makers' own scores shadow counts as static, 85 and 170 count for nothing, and
so do frames outside the temporal region. Movers share one value, so that boxes are not scored. Only the clips of PTZ
have a camera that moves. Of the later half of each video of 2014 the makers keep the truth: there its masks say so.
Options: rate_hz. Terms of use, by its makers: whoever publishes results acknowledges the site and cites its papers.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.files import (
    fit_clip,
    frames_by_number,
    images_in,
    masks_by_frame,
    number_of,
)
from torchvision_dddas.evaluation.datasets.record import Clip, Collector, Dataset, Wanted, check_options, folders_in
from torchvision_dddas.evaluation.metrics.truth import Labels, Truth, read_text

TERMS = "whoever publishes results acknowledges changedetection.net and cites its papers"

LABELS = Labels(background=(0, 50), unscored=(85, 170), separate=False)

PARTS = ("input", "groundtruth", "temporalROI.txt")


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """The clips of a folder of categories, `dataset` in the published archive. See `kinds.KINDS`."""
    rate_hz = check_options("cdnet", options, {"rate_hz": None})["rate_hz"]
    collector = Collector("cdnet", folder, TERMS, wanted)
    if "dataset" in folders_in(folder):
        folder = folder / "dataset"
    places = {
        f"{category}-{video}": folder / category / video
        for category in folders_in(folder)
        for video in folders_in(folder / category)
    }

    def clip_of(name: str) -> Clip:
        place = places[name]
        if absent := [part for part in PARTS if not (place / part).exists()]:
            raise InputError(f"{place} has no {absent[0]}; wanted {', '.join(PARTS)}")
        pictures = images_in(place / "input")
        if not pictures:
            raise InputError(f"{place / 'input'} holds no pictures; wanted the frames of the clip")
        first, last = _read_temporal_region(place / "temporalROI.txt")
        masks = [p for p in images_in(place / "groundtruth") if first <= (number_of(p) or 0) <= last]
        if not masks:
            raise InputError(f"{place / 'groundtruth'} labels none of the frames {first} to {last}; wanted masks")
        found = masks_by_frame(masks, frames_by_number(pictures), place / "input")
        truth = Truth("masks", place / "groundtruth", found, {}, length=len(pictures), labels=LABELS)
        return fit_clip(Clip(name, place, pictures, rate_hz, len(pictures), truth))

    return collector.collect(places, clip_of)


def _read_temporal_region(path: Path) -> tuple[int, int]:
    """The first and the last frame that count. Raises InputError where the file does not say."""
    words = read_text(path).split()
    numbers = [int(word) for word in words if word.isdecimal() and len(word) < 9]
    if not len(words) == len(numbers) == 2 or numbers[0] > numbers[1]:
        raise InputError(f"{path} says '{' '.join(words)[:40]}'; wanted the first and the last frame that count")
    return numbers[0], numbers[1]
