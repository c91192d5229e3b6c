"""Train a linear SVM for people on your own pictures, and write the file for `--set people.classifier=FILE`.

usage: python export/train_people.py POSITIVES NEGATIVES --out FILE.npz [--set people.window_width_px=32 ...]

POSITIVES: a folder of crops. Each crop shows one centred person with the margin that windows have. `--crop 64x128` cuts
the middle out of larger crops. NEGATIVES: a folder of pictures without people. The script needs the extras `torch` and
`train`. Its steps:

1. Compute descriptors of the positives and their mirror images, and of random windows of the negatives on all levels.
2. Choose C by cross-validation (average precision), unless --c gives it.
3. Mine hard negatives in rounds: add the windows of the negatives that the last classifier takes for people.
4. Measure accuracy, and missed windows against false windows, on a share of both folders that steps 1 to 3 leave out.

The descriptor follows the people settings, which the file records. Use the file with the same settings. Set
people.height_share and the other shares of the body in the window from your crops, and people.probability_even from
your data. The same pictures, settings and --seed give the same file.
"""

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import cv2
import numpy as np
import torch

from torchvision_dddas.cli.progress import progress
from torchvision_dddas.config import PeopleParameters, load_config
from torchvision_dddas.errors import InputError
from torchvision_dddas.functional import hog_svm
from torchvision_dddas.io.atomic_files import PartFile, cannot_write, refuse_folder, utf8_name, write_whole
from torchvision_dddas.io.images import IMAGE_SUFFIXES
from torchvision_dddas.people.pyramid import everywhere, levels
from torchvision_dddas.people.torch_scorer import TorchScorer
from torchvision_dddas.people.torch_scorer import layout as descriptor
from torchvision_dddas.types import LinearSvm, Part

CHOICES = (0.003, 0.01, 0.03, 0.1, 0.3)
BATCH = 256
# Least step of the pyramid in mining and measuring, because windows of closer levels are similar.
STEP = 1.2
FALSE_PER_WINDOW = (1e-3, 1e-4, 1e-5)
MOST_WINDOWS = 100_000  # 1.5 GB of descriptors


@dataclass(frozen=True)
class Plan:
    """Training options. negatives: random windows at the start. rounds: rounds of mining. hard: windows per picture.

    c: C of the SVM, or None to choose it. margin: negative windows above this score are hard. held_out: share of each
    folder that is used for measuring only.
    """

    negatives: int = 3000
    rounds: int = 3
    hard: int = 100
    c: float | None = None
    margin: float = -0.5
    held_out: float = 0.2
    seed: int = 0


class Trained(NamedTuple):
    """A classifier, and lines about the training to print."""

    svm: LinearSvm
    lines: list[str]


def main(words: Sequence[str] | None = None) -> int:
    """Train and write. Return 2, with one line, for bad input."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("positives", type=Path)
    parser.add_argument("negatives", type=Path)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=".npz, or text by any other name")
    parser.add_argument("--crop", metavar="WxH", help="the middle of each positive that becomes the window")
    parser.add_argument("--config")
    parser.add_argument("--set", nargs="*", default=[], dest="overrides", metavar="KNOB=VALUE")
    parser.add_argument("--c", type=float, help="of the SVM; by default chosen by cross-validation")
    parser.add_argument("--rounds", type=int, default=Plan.rounds, help="of hard negatives")
    parser.add_argument("--windows", type=int, default=Plan.negatives, help="random windows of the negatives")
    parser.add_argument("--held-out", type=float, default=Plan.held_out, help="share that is only measured on")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quiet", action="store_true")
    options = parser.parse_args(words)
    try:
        parameters = load_config(options.config, options.overrides).people
        plan = Plan(options.windows, options.rounds, c=options.c, held_out=options.held_out, seed=options.seed)
        check(plan)
        check_out(options.out, (options.positives, options.negatives))
        _sklearn("svm")  # fail early if scikit-learn is missing
        people = crops(options.positives, parameters, size_of(options.crop) if options.crop else None)
        rest = pictures(options.negatives, parameters)
        trained = train(people, rest, parameters, plan, options.quiet)
        write(options.out, trained.svm, parameters)
    except InputError as error:
        print(f"train_people: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("train_people: stopped; nothing was written", file=sys.stderr)
        return 130
    for line in trained.lines:
        print(line)
    said = " ".join(f"--set {word}" for word in [f"people.classifier={options.out}", *options.overrides])
    print(f"{options.out}: {trained.svm.weights.size} weights and a bias; use it by {said}")
    return 0


def check(plan: Plan) -> None:
    """Raise InputError for a number outside its range."""
    for name, value, fine, wanted in (
        ("--windows", plan.negatives, 1 <= plan.negatives <= MOST_WINDOWS, f"1 to {MOST_WINDOWS}"),
        ("--seed", plan.seed, 0 <= plan.seed < 2**32, "0 or more, below 2 to the 32nd"),
        ("--rounds", plan.rounds, plan.rounds >= 0, "0 or more"),
        ("--c", plan.c, plan.c is None or 0 < plan.c < float("inf"), "a number above 0"),
        ("--held-out", plan.held_out, 0 <= plan.held_out <= 0.9, "a share from 0 to 0.9"),
    ):
        if not fine:
            raise InputError(f"{name} is {value}; wanted {wanted}")


def check_out(path: Path, folders: Sequence[Path]) -> None:
    """Raise InputError early if the file cannot be written or would lie among the pictures."""
    refuse_folder(path)
    place = Path(os.path.realpath(path)).parent
    if among := [folder for folder in folders if place.is_relative_to(os.path.realpath(folder))]:
        raise InputError(f"--out {path} lies in {among[0]}, among the pictures; choose another place")
    try:
        PartFile(path).discard()
    except OSError as error:
        raise cannot_write(path, error) from None


# --------------------------------------------------------------------------------------------------------------------
# Pictures.


def files(folder: Path) -> list[Path]:
    """Return the images of a folder and its subfolders, sorted by name. Raises InputError if there are none."""
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; wanted one that holds images")
    found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES)
    if not found:
        raise InputError(f"{folder} holds no images ({', '.join(sorted(IMAGE_SUFFIXES))})")
    return found


def picture(path: Path) -> np.ndarray:
    """Read a picture, uint8 (H, W, 3) BGR. Raises InputError if it cannot be decoded."""
    image = cv2.imread(utf8_name(path), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path} cannot be decoded; repair it or leave it out")
    return image


def size_of(text: str) -> tuple[int, int]:
    """Parse a size such as `64x128` to (width, height)."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise InputError(f"--crop is '{text}'; wanted width x height in pixels, such as 64x128")
    return int(width), int(height)


def crops(folder: Path, parameters: PeopleParameters, crop: tuple[int, int] | None = None) -> np.ndarray:
    """Return (N, h + 2, w + 2, 3) uint8 windows of a folder's crops with a border of one pixel, resized as in a scan.

    Raises InputError for a crop smaller than `crop` or than half the window, which would be blurred.
    """
    return np.stack([window(picture(path), path, parameters, crop) for path in files(folder)])


def window(image: np.ndarray, path: Path, parameters: PeopleParameters, crop: tuple[int, int] | None) -> np.ndarray:
    """Return the middle of a picture as a window with a border of one pixel."""
    size, wanted = image.shape[1::-1], (parameters.window_width_px, parameters.window_height_px)
    crop = crop or size
    if crop[0] > size[0] or crop[1] > size[1]:
        raise InputError(f"{path} is {size[0]} x {size[1]} px, smaller than --crop {crop[0]}x{crop[1]}")
    if 2 * crop[0] < wanted[0] or 2 * crop[1] < wanted[1]:
        raise InputError(
            f"{path} gives {crop[0]} x {crop[1]} px, less than half the window of {wanted[0]} x {wanted[1]} px; "
            "leave it out, or set a smaller people.window_width_px and people.window_height_px"
        )
    level = round(size[0] * wanted[0] / crop[0]), round(size[1] * wanted[1] / crop[1])
    level = max(level[0], wanted[0]), max(level[1], wanted[1])
    middle = Part(level, (level[0] - wanted[0]) // 2, (level[1] - wanted[1]) // 2, *wanted)
    return bordered(resized(image, level), middle)


def resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a level of the pyramid as in the recognizer."""
    return image if size == image.shape[1::-1] else cv2.resize(image, size, interpolation=cv2.INTER_LINEAR_EXACT)


def bordered(level: np.ndarray, place: Part) -> np.ndarray:
    """Return a window of a level with a border of one pixel. The level is reflected (101) beyond its edge."""
    rows, columns = (
        np.arange(begin - 1, begin + length + 1) for begin, length in ((place.y, place.height), (place.x, place.width))
    )
    return level[_reflected(rows, level.shape[0])][:, _reflected(columns, level.shape[1])]


def _reflected(index: np.ndarray, length: int) -> np.ndarray:
    period = max(2 * (length - 1), 1)
    index = np.abs(index) % period
    return np.where(index < length, index, period - index)


def pictures(folder: Path, parameters: PeopleParameters) -> list[np.ndarray]:
    """Return the pictures of a folder that are as large as a window. Raises InputError if there are none."""
    every = [picture(path) for path in files(folder)]
    held = [
        image
        for image in every
        if image.shape[1] >= parameters.window_width_px and image.shape[0] >= parameters.window_height_px
    ]
    if not held:
        raise InputError(
            f"{folder}: none of {len(every)} pictures is as large as the window of {parameters.window_width_px} x "
            f"{parameters.window_height_px} px"
        )
    return held


# --------------------------------------------------------------------------------------------------------------------
# Descriptors.


def descriptors(windows: np.ndarray, parameters: PeopleParameters) -> np.ndarray:
    """Return descriptors (N, F) float32, in OpenCV's order, of windows (N, h + 2, w + 2, 3) with a border of 1 px."""
    layout = descriptor(parameters)
    (across, down), cells = layout.blocks, layout.cells
    found = [np.zeros((0, layout.features), np.float32)]
    for begin in range(0, len(windows), BATCH):
        batch = torch.from_numpy(np.ascontiguousarray(windows[begin : begin + BATCH])).permute(0, 3, 1, 2).float()
        with torch.inference_mode():
            blocks = hog_svm.hog(batch, layout)  # (B, bins x cells down x cells across, ny, nx)
        blocks = blocks.view(-1, layout.bins, cells, cells, down, across).permute(0, 5, 4, 3, 2, 1)
        found.append(blocks.reshape(len(batch), -1).numpy())
    return np.concatenate(found)


def random_windows(
    images: Sequence[np.ndarray], parameters: PeopleParameters, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Return windows (count, h + 2, w + 2, 3) of random pictures, levels and places. All levels are equally likely."""
    found = []
    for index in np.sort(rng.integers(0, len(images), count)):
        image = images[index]
        found.append(cut(image, [_somewhere(image, parameters, rng)])[0])
    return np.stack(found)


def _somewhere(image: np.ndarray, parameters: PeopleParameters, rng: np.random.Generator) -> Part:
    known = levels(image.shape[1::-1], parameters)
    size = known[rng.integers(len(known))].size
    width, height = parameters.window_width_px, parameters.window_height_px
    x, y = (int(rng.integers(0, have - need + 1)) for have, need in zip(size, (width, height), strict=True))
    return Part(size, x, y, width, height)


def cut(image: np.ndarray, places: Sequence[Part]) -> list[np.ndarray]:
    """Return windows of a picture with a border of one pixel."""
    kept: dict[tuple[int, int], np.ndarray] = {}
    for place in places:
        if place.level not in kept:
            kept[place.level] = resized(image, place.level)
    return [bordered(kept[place.level], place) for place in places]


def scored(
    images: Sequence[np.ndarray], recognizer: TorchScorer, parameters: PeopleParameters
) -> Iterator[tuple[list[Part], list[np.ndarray]]]:
    """Yield the parts and score maps of each picture, on levels STEP apart."""
    parameters = parameters.model_copy(update={"scale_step": max(parameters.scale_step, STEP)})
    for image in images:
        parts = everywhere(image.shape[1::-1], parameters)
        yield parts, recognizer.scores([image], [parts])[0]


def hardest(
    parts: Sequence[Part], maps: Sequence[np.ndarray], parameters: PeopleParameters, above: float, count: int
) -> list[Part]:
    """Return up to `count` windows with the highest scores above a limit, best first."""
    places = [np.argwhere(scores > above) for scores in maps]
    values = np.concatenate([scores[scores > above] for scores in maps])
    of = np.repeat(np.arange(len(maps)), [len(place) for place in places])
    rows = np.concatenate(places)
    stride, found = parameters.window_stride_px, []
    for i in np.argsort(-values, kind="stable")[:count]:
        part, (row, column) = parts[of[i]], rows[i]
        x, y = part.x + int(column) * stride, part.y + int(row) * stride
        found.append(Part(part.level, x, y, parameters.window_width_px, parameters.window_height_px))
    return found


# --------------------------------------------------------------------------------------------------------------------
# Training.


def train(
    people: np.ndarray, rest: Sequence[np.ndarray], parameters: PeopleParameters, plan: Plan, quiet: bool = False
) -> Trained:
    """Train a classifier of people (windows as from `crops`) against all windows of other pictures.

    Raises InputError if there are too few windows or pictures, or if scikit-learn is missing.
    """
    rng = np.random.default_rng(plan.seed)
    people, tested = split(people, plan.held_out, rng, "positives")
    order, kept_back = split(np.arange(len(rest)), plan.held_out if len(rest) > 1 else 0, rng, "negatives")
    learned = [rest[i] for i in order]
    positive = descriptors(mirrored(people), parameters)
    negative = descriptors(random_windows(learned, parameters, plan.negatives, rng), parameters)
    lines = [f"{len(people)} people and their mirror images, {len(negative)} random windows of {len(learned)} pictures"]
    c = plan.c or choose(positive, negative, plan.seed, lines)
    svm = fit(positive, negative, c, plan.seed)
    for turn in range(plan.rounds):
        found = mine(learned, parameters, svm, plan, f"hard negatives, round {turn + 1}", quiet)
        both = np.unique(np.concatenate([negative, found]), axis=0)
        new = len(both) - len(np.unique(negative, axis=0))
        lines.append(f"round {turn + 1}: {len(found)} windows taken for people, or nearly so; {new} of them new")
        if not new:
            break
        negative = both
        svm = fit(positive, negative, c, plan.seed)
    held = [rest[i] for i in kept_back]
    return Trained(svm, lines + measured(svm, tested, held, parameters))


def split(items: np.ndarray, share: float, rng: np.random.Generator, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Split items into a part for training and a part for measuring. Raises InputError if too few remain."""
    order = rng.permutation(len(items))
    aside = round(share * len(items))
    if len(items) - aside < (2 if name == "positives" else 1):
        raise InputError(f"{len(items)} {name}, of which {aside} are held out, are too few to learn from; give more")
    return items[np.sort(order[aside:])], items[np.sort(order[:aside])]


def mirrored(windows: np.ndarray) -> np.ndarray:
    """Return the windows, followed by their mirror images."""
    return np.concatenate([windows, windows[:, :, ::-1]])


def choose(positive: np.ndarray, negative: np.ndarray, seed: int, lines: list[str]) -> float:
    """Choose C by cross-validation: the smallest of equally good values. A person and its mirror image share a fold.

    Raises InputError if there are too few people for the folds.
    """
    model_selection, metrics = _sklearn("model_selection"), _sklearn("metrics")
    x = np.concatenate([positive, negative])
    y = np.arange(len(x)) < len(positive)
    half = len(positive) // 2
    groups = np.concatenate([np.tile(np.arange(half), 2), half + np.arange(len(negative))])
    folds = min(4, half)
    every = model_selection.GroupKFold(folds, shuffle=True, random_state=seed).split(x, y, groups)
    # With few pictures, a fold may hold only people or no people.
    parts = [one for one in every if all(len(np.unique(y[rows])) == 2 for rows in one)]
    if not parts:
        raise InputError(f"{half} people and {len(negative)} windows are too few to choose C by; give more, or --c")
    found = []
    for c in CHOICES:
        values = []
        for learn, test in parts:
            svm = fit(x[learn][y[learn]], x[learn][~y[learn]], c, seed)
            values.append(metrics.average_precision_score(y[test], x[test] @ svm.weights))
        found.append(float(np.mean(values)))
    best = CHOICES[int(np.argmax(np.round(found, 3)))]
    shown = ", ".join(f"{c:g}: {value:.3f}" for c, value in zip(CHOICES, found, strict=True))
    lines.append(f"C = {best:g} by average precision in {len(parts)} folds ({shown})")
    return best


def fit(positive: np.ndarray, negative: np.ndarray, c: float, seed: int) -> LinearSvm:
    """Fit a linear SVM with squared hinge loss. Both classes have the same total weight."""
    svm = _sklearn("svm")
    model = svm.LinearSVC(C=c, class_weight="balanced", dual=True, random_state=seed, max_iter=20_000)
    x = np.concatenate([positive, negative])
    model.fit(x, np.arange(len(x)) < len(positive))
    return LinearSvm(model.coef_[0].astype(np.float32), float(model.intercept_[0]), "trained")


def mine(
    images: Sequence[np.ndarray], parameters: PeopleParameters, svm: LinearSvm, plan: Plan, name: str, quiet: bool
) -> np.ndarray:
    """Return (N, F) descriptors of the windows that a classifier wrongly takes for people, on every level."""
    recognizer = TorchScorer(parameters, svm)
    found = [np.zeros((0, svm.weights.size), np.float32)]
    with progress(name, len(images), quiet) as tick:
        for image, (parts, maps) in zip(images, scored(images, recognizer, parameters), strict=True):
            places = hardest(parts, maps, parameters, plan.margin, plan.hard)
            if places:
                found.append(descriptors(np.stack(cut(image, places)), parameters))
            tick()
    return np.concatenate(found)


def measured(svm: LinearSvm, people: np.ndarray, rest: Sequence[np.ndarray], parameters: PeopleParameters) -> list[str]:
    """Return lines about the accuracy on pictures that the training left out."""
    if not len(people) or not len(rest):
        return ["nothing was held out, so nothing was measured"]
    score = descriptors(people, parameters) @ svm.weights + svm.bias
    recognizer = TorchScorer(parameters, svm)
    false = np.concatenate(
        [np.concatenate([m.ravel() for m in maps]) for _, maps in scored(rest, recognizer, parameters)]
    )
    right = ((score > 0).mean() + (false <= 0).mean()) / 2
    missed, taken = int((score <= 0).sum()), int((false > 0).sum())
    line = (
        f"held out: {missed} of {len(people)} people missed, {taken} of {len(false)} windows of {len(rest)} pictures "
    )
    lines = [f"{line}taken for people; accuracy {right:.3f} with both alike"]
    shown = []
    for rate in FALSE_PER_WINDOW:
        if rate * len(false) >= 1:
            level = np.sort(false)[-int(rate * len(false))]
            shown.append(f"{(score <= level).mean():.3f} at {rate:g} (score {level:.2f})")
    return [*lines, f"miss rate at false positives per window: {', '.join(shown) or 'too few windows'}"]


def write(path: Path, svm: LinearSvm, parameters: PeopleParameters) -> None:
    """Write .npz with the layout, or text with the layout in comments. Raises InputError if writing fails."""
    import io

    layout = parameters.descriptor
    held = io.BytesIO()
    if path.suffix.lower() == ".npz":
        # The format has no record for `layout`, so store each value as an array of its name.
        arrays: dict[str, Any] = {name: np.asarray(value) for name, value in layout.items()}
        np.savez(held, weights=svm.weights, bias=np.float32(svm.bias), **arrays)
    else:
        told = ", ".join(f"{name} {value}" for name, value in layout.items())
        lines = [f"# Linear SVM for people: {svm.weights.size} weights, then the bias. {told}"]
        lines += [f"{number:.9g}" for number in (*svm.weights.tolist(), svm.bias)]
        held.write(("\n".join(lines) + "\n").encode())
    try:
        write_whole(path, held.getvalue())
    except OSError as error:
        raise cannot_write(path, error) from None


def _sklearn(name: str) -> Any:
    """Return a module of scikit-learn. Raises InputError if it is not installed."""
    import importlib

    try:
        return importlib.import_module(f"sklearn.{name}")
    except ModuleNotFoundError:
        raise InputError("training needs scikit-learn; pip install 'torchvision-dddas[torch,train]'") from None


if __name__ == "__main__":
    sys.exit(main())
