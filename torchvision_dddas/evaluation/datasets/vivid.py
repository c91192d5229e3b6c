"""DARPA VIVID, egtest01 to egtest05 and their like, as of the tracking evaluation of PETS 2005 (Collins et al.).

    egtest01/frame00000.jpg   the frames, numbered from 0; also egtest01/egtest01/frame00000.jpg

The truth, the first of these that is there, in the clip's folder, beside it, or in Groundtruth/:

    egtest01_truth.csv        all vehicles: a line of names, then name,frame,identity,x,y,width,height; frames from 0
    egtest01*.txt             one target: frame,x,y,width,height of every tenth frame; or x,y,width,height a frame, NaN
                              where it is not seen
    egtest01*mask*/           one target: masks of every tenth frame, named by its number, nonzero where the target is

The site of the evaluation is gone, and copies differ: these are the layouts in which it is passed on. Of masks the box
about the target is taken, for the vehicles beside it move too and are not labelled. Options: rate_hz (30 by default).
Terms of use: its makers offer it for the evaluation of trackers, to be cited as Collins, Zhou and Teh (PETS 2005).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets import vivid_truth
from torchvision_dddas.evaluation.datasets.fitting import fitted
from torchvision_dddas.evaluation.datasets.gathering import folders_in, gather
from torchvision_dddas.evaluation.datasets.kinds import Wanted
from torchvision_dddas.evaluation.datasets.numbering import frames_by_number
from torchvision_dddas.evaluation.datasets.options import checked
from torchvision_dddas.evaluation.datasets.pictures import images_in
from torchvision_dddas.evaluation.datasets.record import Clip, Dataset
from torchvision_dddas.evaluation.metrics.truth import Truth

TERMS = "for the evaluation of trackers; to be cited as Collins, Zhou and Teh (PETS 2005)"

RATE_HZ = 30.0


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """The clips of a folder. See `kinds.KINDS`."""
    said = checked("vivid", options, {"rate_hz": None})
    names = [name for name in folders_in(folder) if "mask" not in name.lower() and name.lower() != "groundtruth"]

    def clip_of(name: str) -> Clip:
        place = folder / name
        pictures = images_in(place) or images_in(place / name)
        if not pictures:
            raise InputError(f"{place} holds no pictures; there belong frame00000.jpg and so on")
        frames = frames_by_number(pictures)
        if not frames:
            raise InputError(f"{pictures[0].parent}: the names of the pictures lack numbers, or repeat them")
        truth = _truth(folder, name, frames, pictures)
        return fitted(Clip(name, place, pictures, said["rate_hz"] or RATE_HZ, len(pictures), truth))

    return gather("vivid", folder, TERMS, filter(wanted, names), clip_of)


def _truth(folder: Path, name: str, frames: Mapping[int, int], pictures: tuple[Path, ...]) -> Truth:
    """The truth of a clip, wherever it lies. Raises InputError where there is none."""
    homes = (folder / name, folder, folder / "Groundtruth", folder / "groundtruth")
    for pattern, reader in (("*_truth.csv", vivid_truth.vehicles), ("*.txt", vivid_truth.boxes)):
        for home in homes:
            if found := [p for p in sorted(home.glob(f"{name}{pattern}")) if p.is_file()]:
                return reader(found[0], frames)
    for home in homes:
        inside = folders_in(home) if home.is_dir() else []
        masks = [home / d for d in inside if "mask" in d.lower() and (home == folder / name or d.startswith(name))]
        if masks:
            return vivid_truth.masks(masks[0], frames, pictures)
    raise InputError(f"{folder} has no truth of it; wanted {name}_truth.csv, {name}*.txt or a folder {name}_mask")
