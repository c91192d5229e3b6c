"""What a data set holds, whatever its layout: clips, and what is true of them."""

from dataclasses import dataclass
from pathlib import Path

from torchvision_dddas.evaluation.metrics.truth import Truth


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
