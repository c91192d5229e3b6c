"""Are people's scores and boxes OpenCV's? `python eval/people_parity.py PICTURES ... [--crops FOLDER] [--every N]`.

PICTURES are folders of pictures, or videos. For every one of their pictures, at each padding and window
stride, both back ends beside cv2.HOGDescriptor with its default people detector, in all levels of scale step 1.05:

- windows: how many were scored; worst difference: of a window's score; signs: windows that score above zero in one
  only; shape: levels with another number of windows (0 wanted).
- boxes: OpenCV's from detectMultiScale (group 2, distance 0.2); other: boxes of either that the other has not, exactly;
  worst weight: the largest difference of a box's score. Compared as sets, as the order of OpenCV's threads decides that
  of its boxes, and after cutting ours at the picture's border, which OpenCV does last of all.

--crops: a folder of pictures of one person each. How many OpenCV accepts, searching the crop (any window, or any group)
or scoring the window in its middle alone, and how many of those each back end accepts by the same rule, and by the
project's own default.

What of detectMultiScale one must follow: level i is the picture over scale_step ** i, its sides rounded half to even,
for as long as they hold the window, whatever the padding; a level of the picture's own size is not resized. The padding
is raised to a multiple of the common divisor of window and block stride: give such a one. A window's corner and size in
the picture are rounded each by itself. Where two levels have the same rounded size OpenCV scores both, which counts in
its groups; with a window of 64 x 128 and steps from 1.01 no two have. Where the padded width is no multiple of 4,
another channel wins among equal ones in the columns that are left over, which no window of a stride of 4 or 8 sees.
OpenCV keeps the clip (L2-Hys) of the first descriptor of a process for all others.
"""

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.people import pyramid
from torchvision_dddas.people import suppression as suppress
from torchvision_dddas.people.classifiers import read_classifier
from torchvision_dddas.people.detector import WindowScorer, detect_people, load_scorer

# What detectMultiScale does unless told otherwise, whatever the project's defaults.
PLAIN = PeopleParameters(
    enlarge=1, padding_px=0, window_stride_px=8, scale_step=1.05, threshold=0, suppression="opencv", group=2
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures", nargs="*", help="folders of pictures, or videos")
    parser.add_argument("--crops", type=Path, help="a folder of pictures of one person each")
    parser.add_argument("--every", type=int, default=1, help="take one in so many pictures")
    parser.add_argument("--padding", default="0,32", help="px, a list")
    parser.add_argument("--stride", default="8,4", help="px from window to window, a list")
    parser.add_argument("--backends", default="torch,onboard")
    chosen = parser.parse_args()
    backends = chosen.backends.split(",")
    if not chosen.pictures and chosen.crops is None:
        print("No pictures and no crops are given: nothing is measured.")
    if chosen.pictures:
        print(
            "| pictures | padding | stride | back end | windows | worst difference | signs | shape | boxes | other |",
            end="",
        )
        print(" worst weight |\n| --- | --: | --: | --- | --: | --: | --: | --: | --: | --: | --: |")
    for name in chosen.pictures:
        if not Path(name).exists():
            print(f"| {name}: absent, left out |")
            continue
        for padding in map(int, chosen.padding.split(",")):
            for stride in map(int, chosen.stride.split(",")):
                parameters = PLAIN.model_copy(update={"padding_px": padding, "window_stride_px": stride})
                images = (frame.image for frame in islice(open_source(name), 0, None, chosen.every))
                for backend, found in compare(images, parameters, backends).items():
                    print(f"| {Path(name).name} | {padding} | {stride} | {backend} | {found.row()} |", flush=True)
    if chosen.crops is not None:
        crops(chosen.crops, backends)


@dataclass
class Parity:
    """The figures of one back end; see the module."""

    windows: int = 0
    worst: float = 0.0
    signs: int = 0
    shapes: int = 0
    boxes: int = 0
    other: int = 0
    weight: float = 0.0

    def row(self) -> str:
        """Of the table."""
        return (
            f"{self.windows} | {self.worst:.1e} | {self.signs} | {self.shapes} | {self.boxes} | {self.other} | "
            f"{self.weight:.1e}"
        )


def compare(images: Iterable[np.ndarray], parameters: PeopleParameters, backends: Sequence[str]) -> dict[str, Parity]:
    """Each back end beside OpenCV over all pictures."""
    svm = read_classifier(parameters.classifier, 3780)
    engines = {name: load_scorer(parameters, name, svm) for name in backends}
    figures = {name: Parity() for name in backends}
    for image in images:
        size = image.shape[1], image.shape[0]
        parts = pyramid.everywhere(size, parameters)
        wanted = [opencv_scores(image, part.level, parameters) for part in parts]
        boxes = opencv_boxes(image, parameters)
        for name, engine in engines.items():
            (maps,) = engine.scores([image], [parts])
            tally(figures[name], maps, wanted)
            tally_boxes(figures[name], own_boxes(maps, size, parameters), boxes)
    return figures


def tally(figure: Parity, maps: Sequence[np.ndarray], wanted: Sequence[np.ndarray]) -> None:
    """Counts the windows of one picture."""
    for found, right in zip(maps, wanted, strict=True):
        figure.windows += right.size
        if found.shape != right.shape:
            figure.shapes += 1
            continue
        figure.worst = max(figure.worst, float(np.abs(found - right).max(initial=0)))
        figure.signs += int(((found > 0) != (right > 0)).sum())


def tally_boxes(figure: Parity, found: np.ndarray, wanted: np.ndarray) -> None:
    """Counts the boxes of one picture; rows of x, y, width, height, score."""
    figure.boxes += len(wanted)
    ours, theirs = ({tuple(row[:4].astype(int)): row[4] for row in rows} for rows in (found, wanted))
    figure.other += len(ours.keys() ^ theirs.keys()) + abs(len(found) - len(ours) - len(wanted) + len(theirs))
    figure.weight = max([figure.weight, *(abs(ours[box] - theirs[box]) for box in ours.keys() & theirs.keys())])


def opencv() -> cv2.HOGDescriptor:
    """The descriptor and classifier that all are compared with."""
    made = cv2.HOGDescriptor()
    made.setSVMDetector(cv2.HOGDescriptor.getDefaultPeopleDetector())
    return made


def opencv_scores(image: np.ndarray, size: tuple[int, int], parameters: PeopleParameters) -> np.ndarray:
    """The map of one level; NaN where OpenCV has no window."""
    level = image if size == image.shape[1::-1] else cv2.resize(image, size, interpolation=cv2.INTER_LINEAR_EXACT)
    stride, pad = parameters.window_stride_px, parameters.padding_px
    hits = opencv().detect(level, -1e9, (stride, stride), (pad, pad))
    places, scores = (np.asarray(hit) for hit in hits)
    columns, rows = ((places + pad) // stride).T
    found = np.full((rows.max() + 1, columns.max() + 1), np.nan)
    found[rows, columns] = scores.ravel()
    return found


def opencv_boxes(image: np.ndarray, parameters: PeopleParameters, group: int | None = None) -> np.ndarray:
    """x, y, width, height, score of OpenCV's own search."""
    stride, pad = parameters.window_stride_px, parameters.padding_px
    boxes, scores = opencv().detectMultiScale(
        image,
        winStride=(stride, stride),
        padding=(pad, pad),
        scale=parameters.scale_step,
        groupThreshold=parameters.group if group is None else group,
    )
    return np.column_stack([np.reshape(boxes, (-1, 4)), np.ravel(scores)])


def own_boxes(maps: Sequence[np.ndarray], size: tuple[int, int], parameters: PeopleParameters) -> np.ndarray:
    """The same from our maps, cut at the picture's border; those wholly outside are dropped, as OpenCV does."""
    boxes, scores = suppress.group_rectangles(
        *pyramid.windows(pyramid.everywhere(size, parameters), maps, size, parameters),
        parameters.group,
        parameters.group_distance,
    )
    low, high = np.maximum(boxes[:, :2], 0), np.minimum(boxes[:, :2] + boxes[:, 2:], size)
    return np.column_stack([low, high - low, scores])[(high > low).all(axis=1)]


def crops(folder: Path, backends: Sequence[str]) -> None:
    """What is accepted of a folder of crops, as a table."""
    images = [cv2.imread(str(path)) for path in sorted(folder.glob("*.png"))]
    if not images:
        print(f"{folder} holds no PNG pictures: the crops are left out.")
        return
    middles = [middle(image) for image in images]
    each, padded = (PLAIN.model_copy(update={"suppression": "none", "padding_px": pad}) for pad in (0, 8))
    anywhere = [len(opencv_boxes(image, each, 0)) for image in images]
    rules = {
        "any window": (anywhere, images, each),
        "any window, padding 8": ([len(opencv_boxes(image, padded, 0)) for image in images], images, padded),
        "any group": ([len(opencv_boxes(image, PLAIN)) for image in images], images, PLAIN),
        "the middle 64 x 128": ([len(opencv().detect(image)[0]) for image in middles], middles, each),
        "any window, beside our default": (anywhere, images, PeopleParameters()),
    }
    print(f"\n| of {len(images)} crops | OpenCV |", *(f"{name} | its misses |" for name in backends))
    print("| --- | --: |", "--: | --: |" * len(backends))
    svm = read_classifier(PLAIN.classifier, 3780)
    for rule, (wanted, pictures, parameters) in rules.items():
        words = [f"| {rule} | {sum(map(bool, wanted))} |"]
        for name in backends:
            found = accepted(pictures, load_scorer(parameters, name, svm), parameters)
            missed = sum(bool(right) and not one for right, one in zip(wanted, found, strict=True))
            words.append(f"{sum(found)} | {missed} |")
        print(*words, flush=True)


def accepted(images: Sequence[np.ndarray], recognizer: WindowScorer, parameters: PeopleParameters) -> list[bool]:
    """Whether each shows anybody."""
    return [len(people.box_px) > 0 for people in detect_people(images, recognizer, parameters)]


def middle(image: np.ndarray) -> np.ndarray:
    """The window in the middle of a crop, as a picture."""
    y, x = (image.shape[0] - 128) // 2, (image.shape[1] - 64) // 2
    return np.ascontiguousarray(image[y : y + 128, x : x + 64])


if __name__ == "__main__":
    cv2.setNumThreads(2)
    main()
