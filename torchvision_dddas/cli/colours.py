"""`dddas colours`: find the colour ranges of landmarks from pictures that show them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.options import Config, Overrides, Quiet, print_lines, report_errors
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.geo import CalibratedColours

MOST = 12  # largest number of colours that can be distinguished by hue
Box = tuple[int, int, int, int]


@report_errors
def colours(
    pictures: Annotated[
        list[Path], typer.Argument(metavar="PICTURE...", help="Pictures of all the landmarks, as the camera sees them.")
    ],
    count: Annotated[
        int | None, typer.Option(metavar="N", help="Number of landmarks. [default: all that stand out]")
    ] = None,
    names: Annotated[
        str | None,
        typer.Option(metavar="A,B,...", help="Names of the landmarks; colour names go to the nearest colour."),
    ] = None,
    at: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=X,Y,W,H", help="A box of a landmark's colour in the first picture; repeat it."),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="FILE", help="The TOML to write, with a picture beside it.")] = Path(
        "colours.toml"
    ),
    config: Config = None,
    set_: Overrides = None,
    quiet: Quiet = False,
) -> None:
    """Find the ranges of hue, saturation and value of the landmarks' colours: patches that stand out from the ground.

    Writes a TOML for `dddas run --colours`, and a picture of all areas that the ranges mark. Check this picture.
    """
    from torchvision_dddas.config import load_config
    from torchvision_dddas.geo import calibrate_colours, draw_calibration
    from torchvision_dddas.io.atomic_files import refuse_folder, refuse_own_input, save_file
    from torchvision_dddas.io.colour_files import format_colours
    from torchvision_dddas.io.images import read_colour_image

    least_px = load_config(config, set_ or []).landmarks.least_area_px
    boxes, wanted = [parse_box(text) for text in at or []], parse_names(names)
    _check(count, wanted, [name for name, _ in boxes])
    drawing = out.with_suffix(".png")
    if drawing == out:
        raise InputError(f"--out must be the name of a TOML, such as colours.toml, got the name of a picture, {out}")
    refuse_own_input(pictures, [out, drawing], "--out")
    for path in (out, drawing):
        refuse_folder(path)
    images = [read_colour_image(path) for path in pictures]
    found = calibrate_colours(images, least_px, count, wanted, boxes)
    save_file(drawing, draw_calibration(images, found))
    save_file(out, format_colours(found.ranges).encode())
    print_lines([*_describe(found, len(pictures)), f"{out}; {drawing} shows the areas that the ranges mark"], quiet)


def parse_box(text: str) -> tuple[str, Box]:
    """Return the name and the box of NAME=X,Y,WIDTH,HEIGHT. Raise InputError for anything else."""
    name, _, numbers = text.rpartition("=")
    cells = numbers.split(",")
    if not name.strip() or len(cells) != 4 or not all(cell.strip().isdecimal() and len(cell) < 8 for cell in cells):
        raise InputError(f"--at must be NAME=X,Y,WIDTH,HEIGHT in whole pixels, such as red=410,220,24,16, got '{text}'")
    x, y, width, height = (int(cell.strip()) for cell in cells)
    return name.strip(), (x, y, width, height)


def parse_names(text: str | None) -> list[str]:
    """Return names separated by commas. Raise InputError for an empty name."""
    names = [name.strip() for name in text.split(",")] if text is not None else []
    if "" in names:
        raise InputError(f"--names must be names separated by commas, such as red,blue,yellow,magenta, got '{text}'")
    return names


def _check(count: int | None, names: list[str], box_names: list[str]) -> None:
    if box_names and (names or count is not None):
        raise InputError("--at was given with --names or --count; give only --at, which has its own names")
    called = names or box_names
    if twice := [name for name in called if called.count(name) > 1]:
        raise InputError(f"the name {twice[0]} is given twice; give each landmark its own name")
    if count is not None and not 1 <= count <= MOST:
        raise InputError(f"--count must be 1 to {MOST}, because more colours cannot be distinguished; got {count}")
    if count is not None and names and len(names) != count:
        raise InputError(f"--count is {count}, but --names has {len(names)} names; give as many names")


def _describe(found: "CalibratedColours", pictures: int) -> list[str]:
    """Return a line for each colour, and a note if its range marks more than the landmark."""
    lines, ranges = [], found.ranges
    for name, low, high, group, more in zip(
        ranges.names, ranges.low, ranges.high, found.groups, found.others, strict=True
    ):
        x, y, width, height = group[0].box_px
        lines.append(
            f"{name}: hue {low[0]} to {high[0]}, saturation from {low[1]}, value from {low[2]}; "
            f"{width} x {height} px at {x}, {y}" + (f" and in {len(group) - 1} more" if len(group) > 1 else "")
        )
        if more:
            where = "the picture" if pictures == 1 else "the pictures"
            lines.append(f"note: {name} also marks {more} other patch{'es' * (more > 1)} in {where}")
    return lines
