"""Clips of a data set gathered one by one: whatever is wrong with one is told, and the others go on."""

from collections.abc import Callable, Iterable
from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip, Dataset
from torchvision_dddas.io.images import natural_order


def gather(
    kind: str,
    folder: Path,
    terms: str,
    names: Iterable[str],
    clip_of: Callable[[str], Clip],
    missing: Iterable[str] = (),
) -> Dataset:
    """A data set of the clips that can be read, in natural order of their names.

    clip_of: the clip of a name; where it raises InputError, the line goes to Dataset.missing. missing: what is known
    to be so before.
    """
    clips, told = [], list(missing)
    for name in sorted(names, key=natural_order):
        try:
            clips.append(clip_of(name))
        except InputError as error:
            told.append(f"{name}: {error}")
    return Dataset(kind, folder, tuple(clips), terms, tuple(told))


def folders_in(folder: Path) -> list[str]:
    """Names of the folders in a folder, but hidden ones. Raises InputError where it is none or cannot be read."""
    try:
        return sorted(entry.name for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith("."))
    except OSError as error:
        raise InputError(f"{folder} cannot be read: {error.strerror}") from None


def there(folder: Path, what: str) -> None:
    """Raises InputError where a folder is not there. what: what belongs there."""
    if not folder.is_dir():
        found = "is a file" if folder.exists() else "is not there"
        raise InputError(f"{folder} {found}; there belongs {what}")
