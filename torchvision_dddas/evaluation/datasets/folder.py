"""One's own data: a folder of clips, each a folder.

    CLIP/frames/            its pictures in natural order, named by number or not; or img1/, or one video in CLIP
    CLIP/masks/             PNG, of any of its frames: 0 background, each other value or colour one mover; named by the
                            number of the picture, or of a video's or unnumbered clip's frame, from 0 or from 1
    CLIP/boxes_xywh.txt     or this: x,y,width,height of one target a frame, NaN where it is not seen; others may move
    CLIP/gt.txt, gt/gt.txt  or this: MOTChallenge text, frames from 1
    CLIP/det/det.txt        detections to follow, as MOTChallenge text
    CLIP/positions.csv      where the targets truly are: frame,target,east_m,north_m
    CLIP/seqinfo.ini        MOTChallenge's: seqLength, frameRate
    CLIP/telemetry.*, landmarks.csv, colours.toml, camera.toml, dem.*: as `dddas run` takes them

A clip without pictures can be followed all the same if its truth has identities.
Options: still (names or patterns of clips in which nothing moves: whatever is found there is false), people (the same
of clips whose truth labels people who may stand), rate_hz. Terms of use: your own.
"""

from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from torchvision_dddas.evaluation.datasets.fitting import fitted
from torchvision_dddas.evaluation.datasets.gathering import folders_in, gather
from torchvision_dddas.evaluation.datasets.kinds import Wanted
from torchvision_dddas.evaluation.datasets.options import checked
from torchvision_dddas.evaluation.datasets.own import clip_at, looks_like
from torchvision_dddas.evaluation.datasets.record import Clip, Dataset

OPTIONS: Mapping[str, Any] = {"still": [], "people": [], "rate_hz": None}


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """The clips of a folder, or the one that it is. See `kinds.KINDS`."""
    said = checked("folder", options, OPTIONS)
    one = looks_like(folder)
    places = {folder.resolve().name: folder} if one else {name: folder / name for name in folders_in(folder)}

    def clip_of(name: str) -> Clip:
        people = any(fnmatchcase(name, pattern) for pattern in said["people"])
        still = any(fnmatchcase(name, pattern) for pattern in said["still"])
        return fitted(clip_at(places[name], name, said["rate_hz"], still, ("people",) if people else ("movers",)))

    return gather("folder", folder, "", filter(wanted, places), clip_of)
