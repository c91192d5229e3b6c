"""UAV123, UAV20L and UAV123 at 10 frames a second (Mueller, Smith and Ghanem, 2016): one labelled target a clip.

    data_seq/UAV123/SEQUENCE/000001.jpg   the frames
    anno/UAV123/CLIP.txt                  x,y,width,height a line, NaN where the target is hidden or out of the picture
    configSeqs.m                          where each clip begins and ends in its sequence: car6_2 is a part of car6

UAV20L and UAV123_10fps lie beside UAV123 in data_seq and anno, or have a folder of their own. Only a clip that is a
whole sequence can be read without configSeqs.m. Other targets than the labelled one may move, and are not labelled.
The targets of building1 to building5 stand still: such a clip is read only where the option `still` says that nothing
else moves in it either. Options: variant (UAV123, UAV20L or UAV123_10fps; by default the first that is there), still
(names or patterns), rate_hz (by default the variant's, 30 or 10).
Terms of use, by its makers: for research; whoever uses it cites their paper.
"""

import re
from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.files import fit_clip, images_in, number_of
from torchvision_dddas.evaluation.datasets.record import Clip, Collector, Dataset, Wanted, check_options
from torchvision_dddas.evaluation.metrics.truth import load_truth, read_text

TERMS = "for research; whoever uses it cites Mueller, Smith and Ghanem (2016)"

VARIANTS = {"UAV123": 30.0, "UAV20L": 30.0, "UAV123_10fps": 10.0}
"""Variant -> frames a second."""

OPTIONS: Mapping[str, Any] = {"variant": "", "still": [], "rate_hz": None}

_PART = re.compile(
    r"'name'\s*,\s*'([^']+)'\s*,\s*'path'\s*,\s*'([^']*)'\s*,\s*'startFrame'\s*,\s*(\d{1,8})\s*,\s*'endFrame'\s*,\s*(\d{1,8})"
)


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """The clips of a folder that holds anno and data_seq. See `kinds.KINDS`."""
    given = check_options("uav123", options, OPTIONS)
    if given["variant"] and given["variant"] not in VARIANTS:
        raise InputError(f"'{given['variant']}' is no variant of UAV123; wanted {', '.join(VARIANTS)}")
    collector = Collector("uav123", folder, TERMS, wanted)
    variant = given["variant"] or next((v for v in VARIANTS if (folder / "anno" / v).is_dir()), "")
    annotations, sequences = _places(folder, variant)
    parts = {annotations: "the boxes, CLIP.txt", sequences: "the frames, a folder a sequence"}
    if absent := [f"{place} does not exist; wanted {what}" for place, what in parts.items() if not place.is_dir()]:
        return collector.refuse(*absent)
    rate_hz = given["rate_hz"] or VARIANTS.get(variant or folder.name, 30.0)
    parts_of_sequences = _read_parts(folder, variant)

    def clip_of(name: str) -> Clip:
        still = any(fnmatchcase(name, pattern) for pattern in given["still"])
        if name.startswith("building") and not still:
            raise InputError("its target is a building, which does not move; name it in `still` if nothing else does")
        sequence, *span = parts_of_sequences.get(name, (name,))
        pictures = _pictures(sequences / sequence, name, span)
        truth = None if still else load_truth(annotations / f"{name}.txt")
        return fit_clip(Clip(name, sequences / sequence, pictures, rate_hz, len(pictures), truth, still))

    return collector.collect([path.stem for path in annotations.glob("*.txt")], clip_of)


def _places(folder: Path, variant: str) -> tuple[Path, Path]:
    """Where the boxes and the sequences of a variant lie; those of UAV20L may be among those of UAV123."""
    shared = "UAV123" if variant == "UAV20L" else variant
    anno = (folder / "anno" / variant, folder / "anno")
    data = (folder / "data_seq" / variant, folder / "data_seq" / shared, folder / "data_seq")
    return next(filter(Path.is_dir, anno), anno[0]), next(filter(Path.is_dir, data), data[0])


def _read_parts(folder: Path, variant: str) -> dict[str, tuple[Any, ...]]:
    """Clip -> its sequence, first and last frame, by configSeqs.m; none where it does not exist."""
    path = folder / "configSeqs.m"
    text = read_text(path, "latin-1") if path.is_file() else ""
    # One file may hold a table for each variant, which begins as seqUAV123_10fps = {...
    tables = re.split(r"seq(UAV\w+)\s*=\s*\{", text)
    mine = dict(zip(tables[1::2], tables[2::2], strict=True)).get(variant, text)
    return {
        name: (re.split(r"[\\/]", where.rstrip("\\/"))[-1], int(first), int(last))
        for name, where, first, last in _PART.findall(mine)
    }


def _pictures(place: Path, name: str, span: list[int]) -> tuple[Path, ...]:
    """The pictures of a clip. span: first and last frame, empty if unknown. Raises InputError if one is absent."""
    pictures = images_in(place)
    if not pictures:
        wanted = "" if span else f", or configSeqs.m, which says of what sequence {name} is a part"
        raise InputError(f"{place} holds no pictures; wanted the frames of the clip{wanted}")
    if not span:
        return pictures
    first, last = span
    part = tuple(p for p in pictures if first <= (number_of(p) or 0) <= last)
    if len(part) != last - first + 1:
        raise InputError(f"{place} holds {len(part)} of the frames {first} to {last} of {name}; wanted all of them")
    return part
