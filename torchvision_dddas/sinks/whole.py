"""Files that appear whole or not at all: written under a temporary name beside their place, then renamed."""

import os
import re
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


def remove(path: Path) -> None:
    """Remove a file if it is there and can be removed: used while another error is on its way to the user."""
    with suppress(OSError):
        path.unlink(missing_ok=True)


def cannot_write(path: Path, error: OSError) -> InputError:
    """The line a user reads when the disk refuses."""
    place = path.with_name(_PART.sub(r"\1\2", path.name))
    return InputError(
        f"cannot write {place}: {error.strerror or error}. Nothing half-written was kept; "
        "free some space or choose another --out"
    )
