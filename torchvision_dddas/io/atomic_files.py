"""Files that appear whole or not at all: written under a temporary name beside their place, then renamed."""

import os
import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from torchvision_dddas.errors import InputError

_PART = re.compile(r"^\.(.+)\.\d+\.part(\.\w+)$")


def temporary(path: Path) -> Path:
    """A hidden name in the same folder, with the same ending, so that a rename makes it whole."""
    return path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")


def write_whole(path: Path, content: bytes) -> None:
    """Write a file at once. Raises OSError, and then leaves neither a new file nor a temporary one."""
    part = temporary(path)
    try:
        part.write_bytes(content)
        part.replace(path)
    except BaseException:
        remove(part)
        raise


def save_file(path: Path, content: bytes) -> None:
    """Write a file at once, and the folders above it. Raises InputError where the disk refuses."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, content)
    except OSError as error:
        raise cannot_write(path, error) from error


def remove(path: Path) -> None:
    """Remove a file if it is there and can be removed: used while another error is on its way to the user."""
    with suppress(OSError):
        path.unlink(missing_ok=True)


def refuse_own_input(given: Iterable[Path], written: Iterable[Path], option: str) -> None:
    """Raises InputError where a file that is read is one of those to be written; option: what names another place."""
    places = {os.path.realpath(path) for path in written}  # unlike Path.resolve it takes links that go in circles
    for path in given:
        if os.path.realpath(path) in places:
            raise InputError(f"{path} is a file that this run writes; choose another {option}")


def refuse_folder(path: Path) -> None:
    """Raises InputError where a folder is in the place of a file to be written, or no file can have that name."""
    try:
        folder = path.is_dir()
    except OSError as error:
        raise cannot_write(path, error) from None
    if folder:
        raise InputError(f"--out {path} is a folder; wanted the name of a file")


def cannot_write(path: Path, error: OSError) -> InputError:
    """The InputError to raise for a failed write of a file."""
    place = path.with_name(_PART.sub(r"\1\2", path.name))
    return InputError(
        f"cannot write {place}: {error.strerror or error}. Nothing half-written was kept; "
        "free some space or choose another --out"
    )
