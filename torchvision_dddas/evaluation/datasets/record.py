"""What a data set holds, whatever its layout: clips, their truth, and the options of a kind."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.truth import Truth
from torchvision_dddas.io.images import natural_order


@dataclass(frozen=True)
class Clip:
    """One clip.

    name: unique in its data set. place: what messages name. pictures: the files of its frames in order, or one video;
    empty where it has none. rate_hz: None where nothing says. frames: how many, 0 where nothing says. truth: None where
    nothing is known. still: nothing moves in it, so that whatever is found is false. shows: what its truth labels:
    "movers", or "people", who may stand; a study asks for motion in the former and recognizes people in the latter.
    given: a table of public detections. The rest are files as `dddas run` and `dddas locate` take them.
    """

    name: str
    place: Path
    pictures: tuple[Path, ...] = ()
    rate_hz: float | None = None
    frames: int = 0
    truth: Truth | None = None
    still: bool = False
    shows: tuple[str, ...] = ("movers",)
    given: Path | None = None
    telemetry: Path | None = None
    landmarks: Path | None = None
    colours: Path | None = None
    camera: Path | None = None
    elevation: Path | None = None


@dataclass(frozen=True)
class Dataset:
    """Clips of one kind. terms: of use, as its makers state them.

    missing: in words, clips that are left out and why, or what belongs in the folder. notes: in words, what else lacks,
    and where it belongs; its clips are read all the same.
    """

    kind: str
    folder: Path
    clips: tuple[Clip, ...]
    terms: str = ""
    missing: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


_WORDS = {str: "a text", bool: "true or false", int: "a whole number", float: "a number", list: "a list of texts"}


def checked(kind: str, options: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, Any]:
    """The options in force. wanted: name -> the value where it is not given, whose type is the option's.

    A list holds texts; None stands for a number above 0 that need not be given. Raises InputError: an unknown name,
    another type.
    """
    for name, value in options.items():
        if name not in wanted:
            takes = f"it takes {', '.join(wanted)}" if wanted else "it takes none"
            raise InputError(f"a data set of kind {kind} has no option '{name}'; {takes}")
        default = wanted[name]
        type_ = float if default is None else type(default)
        fits = isinstance(value, (int, float) if type_ is float else type_) and (
            type_ is bool or not isinstance(value, bool)
        )
        if type_ is list:
            fits = fits and all(isinstance(text, str) for text in value)
        if default is None:
            fits = fits and 0 < value <= 1000
        if not fits:
            what = "a number above 0, at most 1000" if default is None else _WORDS[type_]
            raise InputError(f"{name} = {value!r} will not do for a data set of kind {kind}; wanted {what}")
    return {**wanted, **options}


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
