"""What a data set holds, whatever its layout: clips with their truth. How an adapter collects them."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.truth import Truth
from torchvision_dddas.io.images import natural_order

Wanted = Callable[[str], bool]
"""Whether a clip of that name is requested; others are not read."""


@dataclass(frozen=True)
class Clip:
    """One clip.

    name: unique in its data set. place: the file or folder that messages name.
    pictures: the files of its frames in order, or one video; empty where it has none.
    rate_hz: None where unknown. frames: how many, 0 where unknown. truth: None where nothing is known.
    still: nothing moves in it, so that every detection is false.
    shows: what its truth labels: "movers", or "people", who may stand. A study detects motion in the former and
        people in the latter.
    given: a table of public detections. The other files are those that `dddas run` and `dddas locate` take.
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

    missing: one line for each clip that is left out, and why, or on what the folder should hold. notes: one line for
    each thing that is absent from clips that are read all the same.
    """

    kind: str
    folder: Path
    clips: tuple[Clip, ...]
    terms: str = ""
    missing: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Source:
    """A data set as a study names it. clips: patterns of names (fnmatch). options: further options of its kind."""

    kind: str
    folder: Path
    clips: tuple[str, ...] = ("*",)
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass
class Collector:
    """Collects the clips that can be read; the reason why another cannot goes to `missing`. Fields as in Dataset."""

    kind: str
    folder: Path
    terms: str
    wanted: Wanted
    missing: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def collect(self, names: Iterable[str], clip_of: Callable[[str], Clip]) -> Dataset:
        """The wanted ones of the names in natural order. clip_of: reads one; its InputError goes to `missing`."""
        clips = []
        for name in sorted(filter(self.wanted, names), key=natural_order):
            try:
                clips.append(clip_of(name))
            except InputError as error:
                self.missing.append(f"{name}: {error}")
        return Dataset(self.kind, self.folder, tuple(clips), self.terms, tuple(self.missing), tuple(self.notes))

    def refuse(self, *missing: str) -> Dataset:
        """A data set without clips: the folder does not hold this kind, for these reasons."""
        return Dataset(self.kind, self.folder, (), self.terms, missing)

    def report_unlabelled(self, names: Iterable[str], labelled: Iterable[str], belongs: str) -> None:
        """Add to `missing` what has pictures and no truth. belongs: the path of the truth, with {} for the name."""
        absent = [name for name in names if name not in labelled and self.wanted(name)]
        self.missing += [f"{name}: no truth, which belongs in {belongs.format(name)}" for name in absent]

    def label_clip(
        self, name: str, place: Path, pictures: tuple[Path, ...], truth: Truth, belongs: Path | str, **more: Any
    ) -> Clip:
        """A clip of labelled boxes, which may lack its pictures; a note then says where they belong."""
        if not pictures:
            self.notes.append(f"{name}: no pictures, which belong in {belongs}")
        return Clip(name, place, pictures, frames=truth.length or truth.frames[-1], truth=truth, **more)


_EXPECTED = {str: "a text", bool: "true or false", int: "a whole number", float: "a number", list: "a list of texts"}


def check_options(kind: str, options: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """The options in force. defaults: by name; the type of a default is the option's.

    A list holds texts; None stands for an optional number above 0. Raises InputError: an unknown name, another type.
    """
    for name, value in options.items():
        if name not in defaults:
            takes = f"it takes {', '.join(defaults)}" if defaults else "it takes none"
            raise InputError(f"a data set of kind {kind} has no option '{name}'; {takes}")
        default = defaults[name]
        type_ = float if default is None else type(default)
        fits = isinstance(value, (int, float) if type_ is float else type_) and (
            type_ is bool or not isinstance(value, bool)
        )
        if type_ is list:
            fits = fits and all(isinstance(text, str) for text in value)
        if default is None:
            fits = fits and 0 < value <= 1000
        if not fits:
            expected = "a number above 0, at most 1000" if default is None else _EXPECTED[type_]
            raise InputError(f"{name} of a data set of kind {kind} must be {expected}, got {value!r}")
    return {**defaults, **options}


def folders_in(folder: Path) -> list[str]:
    """The names of the folders in a folder, without hidden ones; none where it is no folder.

    Raises InputError where it cannot be read.
    """
    try:
        return sorted(entry.name for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith("."))
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise InputError(f"{folder} cannot be read: {error.strerror}") from None


def find_below(folder: Path, is_clip: Callable[[Path], bool], depth: int) -> list[Path]:
    """The folders that are clips: this one, or those at most so many folders deeper; none lies in another."""
    if is_clip(folder):
        return [folder]
    return [place for name in folders_in(folder) if depth for place in find_below(folder / name, is_clip, depth - 1)]
