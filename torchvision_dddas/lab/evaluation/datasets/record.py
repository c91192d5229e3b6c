"""A data set: clips with their truth, and the base class of the readers, one for each kind of data set."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from torchvision_dddas.errors import InputError, readable
from torchvision_dddas.io.images import natural_order
from torchvision_dddas.lab.evaluation.metrics.truth import ClipTruth


@dataclass(frozen=True)
class Clip:
    """One clip.

    name: unique in its data set, and `readable`. place: the file or folder that messages name.
    pictures: the files of its frames in order, or one video; empty if it has none.
    rate_hz: None if unknown. frames: their number, 0 if unknown. truth: None if unknown.
    still: nothing moves in the clip, so that every detection is false.
    shows: kinds of targets that its truth labels: "movers", or "people", who may stand. A study detects motion for the
    former and people for the latter.
    given: a table of public detections. The other files are inputs of `dddas run` and `dddas locate`.
    """

    name: str
    place: Path
    pictures: tuple[Path, ...] = ()
    rate_hz: float | None = None
    frames: int = 0
    truth: ClipTruth | None = None
    still: bool = False
    shows: tuple[str, ...] = ("movers",)
    given: Path | None = None
    telemetry: Path | None = None
    landmarks: Path | None = None
    colours: Path | None = None
    camera: Path | None = None
    elevation: Path | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", readable(self.name))  # tables and reports contain the name


@dataclass(frozen=True)
class Dataset:
    """Clips of one kind. terms: conditions of use, as the authors state them.

    missing: one line for each clip that is left out, with the reason, or on the content that the folder should have.
    notes: one line for each item that is absent from clips that are read nevertheless.
    """

    kind: str
    folder: Path
    clips: tuple[Clip, ...]
    terms: str = ""
    missing: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class DatasetSource:
    """A data set as a study names it. clips: patterns of names (fnmatch). options: further options of its kind."""

    kind: str
    folder: Path
    clips: tuple[str, ...] = ("*",)
    options: Mapping[str, Any] = field(default_factory=dict)


_EXPECTED = {
    str: "a text",
    float: "a number",
    list: "a list of texts",
    type(None): "a number above 0, at most 1000",
}


class Reader:
    """A reader of data sets of one kind. A subclass describes its layout on disk; docs/datasets.md states what counts.

    layout: in one line. terms: conditions of use. defaults: default of each option, which also sets the option's type;
    a list holds texts, and None stands for an optional number above 0. words: for each option that lists words, its
    data set's name and the known words; the default is all of them. missing, notes: see Dataset.
    """

    kind: ClassVar[str]
    layout: ClassVar[str]
    terms: ClassVar[str] = ""
    defaults: ClassVar[Mapping[str, Any]] = {}
    words: ClassVar[Mapping[str, tuple[str, tuple[str, ...]]]] = {}

    def __init__(self, folder: Path, options: Mapping[str, Any], wanted: Callable[[str], bool]) -> None:
        """folder: must exist. wanted: whether to read a clip by its name. Raise InputError for a wrong option."""
        self.folder, self.wanted = folder, wanted
        self.missing: list[str] = []
        self.notes: list[str] = []
        for name, value in options.items():
            if name not in self.defaults:
                takes = f"it takes {', '.join(self.defaults)}" if self.defaults else "it takes none"
                raise InputError(f"a data set of kind {self.kind} has no option '{name}'; {takes}")
            is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
            type_ = type(self.defaults[name])
            fits = {
                str: isinstance(value, str),
                float: is_number,
                list: isinstance(value, list) and all(isinstance(text, str) for text in value),
                type(None): is_number and 0 < value <= 1000,
            }
            if not fits[type_]:
                raise InputError(f"{name} of a data set of kind {self.kind} must be {_EXPECTED[type_]}, got {value!r}")
        self.options = {**self.defaults, **options}
        for option, (whose, known) in self.words.items():
            for word in self.options[option]:
                if word not in known:
                    raise InputError(f"'{word}' is not a class of {whose}; wanted some of {', '.join(known)}")

    def _places(self) -> Mapping[str, Any]:
        """Return the input of `_clip` for each clip, by name; usually its file or folder."""
        raise NotImplementedError

    def _clip(self, name: str, place: Any) -> Clip:
        """Read one clip. Its InputError goes to `missing`."""
        raise NotImplementedError

    def read(self) -> Dataset:
        """Return the wanted clips in natural order."""
        clips, places = [], self._places()
        for name in sorted(filter(self.wanted, places), key=natural_order):
            try:
                clips.append(self._clip(name, places[name]))
            except InputError as error:
                self.missing.append(f"{name}: {error}")
        return Dataset(self.kind, self.folder, tuple(clips), self.terms, tuple(self.missing), tuple(self.notes))

    def _refuse(self, *missing: str) -> dict[str, Any]:
        """Return no places, and add to `missing` the reasons why the folder does not hold this kind."""
        self.missing += missing
        return {}

    def _report_unlabelled(self, names: list[str], labelled: Mapping[str, Any], belongs: str) -> None:
        """Add to `missing` clips with pictures but no truth. belongs: path of the truth, with {} for the name."""
        absent = [name for name in names if name not in labelled and self.wanted(name)]
        self.missing += [f"{name}: no truth; it belongs in {belongs.format(name)}" for name in absent]

    def _boxes_clip(
        self, name: str, place: Path, pictures: tuple[Path, ...], truth: ClipTruth, belongs: Path, **more: Any
    ) -> Clip:
        """Return a clip of labelled boxes. If it lacks pictures, a note states where they belong."""
        if not pictures:
            self.notes.append(f"{name}: no pictures; they belong in {belongs}")
        return Clip(name, place, pictures, frames=truth.length or truth.frames[-1], truth=truth, **more)
