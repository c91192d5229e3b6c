"""`dddas colours`: the ranges of colour by which landmarks are found, from pictures that show them."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.options import Config, Overrides, Quiet
from torchvision_dddas.cli.progress import progress
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from torchvision_dddas.geo.colour_calibration import ColourSample
    from torchvision_dddas.types import Colours

Box = tuple[int, int, int, int]
MOST = 12
"""Colours that can be told apart by their hue."""


@explained
def colours(
    pictures: Annotated[
        list[Path], typer.Argument(metavar="PICTURE...", help="Pictures of all the landmarks, as the camera sees them.")
    ],
    count: Annotated[
        int | None, typer.Option(metavar="N", help="How many landmarks there are. [default: all that are clear]")
    ] = None,
    names: Annotated[
        str | None,
        typer.Option(metavar="A,B,...", help="Their names; words for colours go to the nearest, others by hue."),
    ] = None,
    at: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=X,Y,W,H", help="A box of a landmark's colour in the first picture; repeat it."),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="FILE", help="The TOML to write; a picture comes beside it.")] = Path(
        "colours.toml"
    ),
    config: Config = None,
    set_: Overrides = None,
    quiet: Quiet = False,
) -> None:
    """Find the ranges of hue, saturation and value of the landmarks' colours: patches that stand out from the ground.

    Writes a TOML for `dddas run --colours`, and beside it a picture of all that the ranges mark: look at it.
    """
    from torchvision_dddas.config import load_config
    from torchvision_dddas.geo.colour_calibration import build_ranges, to_hsv
    from torchvision_dddas.io.atomic_files import refuse_folder, refuse_own_input

    least = load_config(config, set_ or []).landmarks.least_area_px
    boxes, wanted = [_box(text) for text in at or []], _names(names)
    _check(count, wanted, boxes)
    drawing = out.with_suffix(".png")
    if drawing == out:
        raise InputError(f"--out {out} is a picture's name; wanted one such as colours.toml")
    refuse_own_input(pictures, [out, drawing], "--out")
    for path in (out, drawing):
        refuse_folder(path)
    images = [_picture(path) for path in pictures]
    found = [to_hsv(image) for image in images]
    if boxes:
        groups, called = _given(boxes, found[0], pictures[0]), [name for name, _ in boxes]
    else:
        groups = _found(found, least, count or (len(wanted) or None), pictures, quiet)
        called = _called(wanted, groups)
    low, high, others = build_ranges(groups, found, least)
    ranges = _checked(called, low, high)
    _write(out, drawing, images, found, groups, ranges)
    if not quiet:
        for line in _summary(ranges, groups, others.tolist(), len(pictures)):
            typer.echo(line)
        typer.echo(f"{out}; {drawing} shows what the ranges mark")


def _box(text: str) -> tuple[str, Box]:
    name, _, numbers = text.rpartition("=")
    cells = numbers.split(",")
    if not name.strip() or len(cells) != 4 or not all(cell.strip().isdecimal() and len(cell) < 8 for cell in cells):
        raise InputError(f"--at is '{text}'; wanted NAME=X,Y,WIDTH,HEIGHT in whole pixels, such as red=410,220,24,16")
    x, y, width, height = (int(cell.strip()) for cell in cells)
    return name.strip(), (x, y, width, height)


def _names(text: str | None) -> list[str]:
    names = [name.strip() for name in text.split(",")] if text is not None else []
    if "" in names:
        raise InputError(f"--names is '{text}'; wanted names with commas between, such as red,blue,yellow,magenta")
    return names


def _check(count: int | None, names: list[str], boxes: list[tuple[str, Box]]) -> None:
    if boxes and (names or count is not None):
        raise InputError("--at was given with --names or --count; boxes bring their own names, leave the others out")
    called = names or [name for name, _ in boxes]
    if twice := [name for name in called if called.count(name) > 1]:
        raise InputError(f"the name {twice[0]} is given twice; wanted each landmark's own")
    if count is not None and not 1 <= count <= MOST:
        raise InputError(f"--count is {count}; wanted 1 to {MOST}: more colours cannot be told apart")
    if count is not None and names and len(names) != count:
        raise InputError(f"--count is {count}, but --names has {len(names)} names; wanted as many")


def _picture(path: Path) -> "np.ndarray":
    import numpy as np

    from torchvision_dddas.io.images import read_image

    image = read_image(path)
    if image is None:
        raise InputError(f"{path} is no whole picture; wanted a PNG, JPEG or TIFF")
    if image.ndim == 3 and image.shape[2] == 4:
        image = image[:, :, :3]
    if image.dtype != np.uint8 or image.ndim != 3:
        raise InputError(f"{path} has no colours of 8 bits; wanted a colour picture, as the camera gives it")
    return np.ascontiguousarray(image)


def _given(boxes: list[tuple[str, Box]], hsv: "np.ndarray", path: Path) -> list[list["ColourSample"]]:
    from torchvision_dddas.geo.colour_calibration import sample_box

    groups = []
    height, width = hsv.shape[:2]
    for name, box in boxes:
        x, y, wide, high = box
        if wide < 1 or high < 1 or x + wide > width or y + high > height:
            raise InputError(f"--at {name}: the box {x},{y},{wide},{high} is not in {path}, {width} x {height} px")
        sample = sample_box(hsv, box)
        if sample is None:
            raise InputError(f"--at {name}: nothing in the box {x},{y},{wide},{high} of {path} has a strong colour")
        groups.append([sample])
    return groups


def _found(
    pictures: list["np.ndarray"], least: int, count: int | None, paths: list[Path], quiet: bool
) -> list[list["ColourSample"]]:
    from torchvision_dddas.geo.colour_calibration import find_samples, pool_samples

    samples = []
    with progress("colours", len(pictures), quiet) as tick:
        for number, hsv in enumerate(pictures):
            samples.append(find_samples(hsv, least, number))
            tick()
    groups = pool_samples(samples, count)
    where = str(paths[0]) if len(paths) == 1 else f"the {len(paths)} pictures"
    if not groups or (count is not None and len(groups) < count):
        has = f"{len(groups)} of {count} colours stand" if groups else "no colour stands"
        raise InputError(f"{has} out in {where}; say where the landmarks are with --at NAME=X,Y,W,H for each")
    return sorted(groups, key=lambda group: group[0].hue)


def _called(names: list[str], groups: Sequence[Sequence["ColourSample"]]) -> list[str]:
    """A name for each colour: the words given that fit best, or the names given in the order of hues."""
    from scipy.optimize import linear_sum_assignment

    from torchvision_dddas.geo.colour_calibration import HUES, hue_difference, name_hues

    hues = [group[0].hue for group in groups]
    if not names:
        return name_hues(hues)
    if not set(names) <= HUES.keys():
        return names
    away = [[float(abs(hue_difference(HUES[name], hue))) for name in names] for hue in hues]
    return [names[place] for place in linear_sum_assignment(away)[1]]


def _checked(names: list[str], low: "np.ndarray", high: "np.ndarray") -> "Colours":
    from torchvision_dddas.io.colour_files import find_overlaps
    from torchvision_dddas.types import Colours

    for a, b in find_overlaps(low, high):
        raise InputError(
            f"{names[a]} and {names[b]} are too near each other in hue (about {low[a, 0]} and {low[b, 0]}) to be told "
            "apart; give the landmarks colours of their own"
        )
    return Colours(tuple(names), low, high)


def _write(
    out: Path,
    drawing: Path,
    images: list["np.ndarray"],
    found: list["np.ndarray"],
    groups: Sequence[Sequence["ColourSample"]],
    ranges: "Colours",
) -> None:
    import cv2
    import numpy as np

    from torchvision_dddas.geo.colour_calibration import mask_range
    from torchvision_dddas.io.atomic_files import cannot_write, write_whole
    from torchvision_dddas.io.colour_files import draw_colours, format_colours

    sheets = []
    for number, (image, hsv) in enumerate(zip(images, found, strict=True)):
        masks = np.stack([mask_range(hsv, *ends) for ends in zip(ranges.low, ranges.high, strict=True)])
        own = [np.array([s.box_px for s in group if s.picture == number], float).reshape(-1, 4) for group in groups]
        sheet = draw_colours(image, masks, ranges, own)
        width = images[0].shape[1]
        sheets.append(cv2.resize(sheet, (width, max(round(sheet.shape[0] * width / sheet.shape[1]), 1))))
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_whole(drawing, cv2.imencode(".png", np.concatenate(sheets))[1].tobytes())
        write_whole(out, format_colours(ranges).encode())
    except OSError as error:
        raise cannot_write(out, error) from error


def _summary(
    ranges: "Colours", groups: Sequence[Sequence["ColourSample"]], others: list[int], pictures: int
) -> list[str]:
    lines = []
    where = "the picture" if pictures == 1 else "the pictures"
    for name, low, high, group, more in zip(ranges.names, ranges.low, ranges.high, groups, others, strict=True):
        x, y, width, height = group[0].box_px
        lines.append(
            f"{name}: hue {low[0]} to {high[0]}, saturation from {low[1]}, value from {low[2]}; "
            f"{width} x {height} px at {x}, {y}" + (f" and in {len(group) - 1} more" if len(group) > 1 else "")
        )
        if more:
            lines.append(f"note: {name} also marks {more} other patch{'es' * (more > 1)} in {where}")
    return lines
