"""CSV text, opened and gone through in one way."""

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from torchvision_dddas.errors import InputError


class Line(NamedTuple):
    """A line that is not blank: its number in the file, from 1, and its cells without blanks around them."""

    number: int
    cells: list[str]


@contextmanager
def opened(path: str | Path, what: str = "") -> Iterator[tuple[list[str], Iterator[Line]]]:
    """The cells of the first line, none where there is none, and the lines after it but blank ones.

    what: what the file is, for messages. Raises InputError where it cannot be read, is no text or no CSV, as far as it
    is gone through.
    """
    name = f"{what} {path}".strip()
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, skipinitialspace=True)
            rows = ([cell.strip() for cell in row] for row in reader)
            yield next(rows, []), (Line(reader.line_num, cells) for cells in rows if any(cells))
    except OSError as error:
        raise InputError(f"{name} cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{name} is no CSV text: {error}") from None
