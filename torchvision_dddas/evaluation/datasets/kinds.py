"""The kinds of data sets that can be read, and reading one: each kind's adapter is a module of this folder."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from importlib import import_module
from os.path import normpath
from pathlib import Path
from typing import Any, Protocol

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Dataset

KINDS: Mapping[str, str] = {
    "folder": "your own: a folder a clip, with frames/ or a video, and masks/, boxes_xywh.txt or gt/gt.txt",
    "bms": "Berkeley motion segmentation: BMS-26 and FBMS-59, as published or as frames/ and masks/",
    "davis": "DAVIS 2016 or 2017: JPEGImages/, Annotations/ and ImageSets/",
    "cdnet": "CDnet 2012 or 2014: a folder a category, in it one a video with input/ and groundtruth/",
    "uav123": "UAV123, UAV20L or UAV123 at 10 frames a second: anno/, data_seq/ and configSeqs.m",
    "vivid": "VIVID of PETS 2005: egtest01/ and its like, with boxes or masks of every tenth frame",
    "motchallenge": "MOTChallenge 2015 to 2020 and its like: SEQUENCE/gt/gt.txt, with img1/ or a video if there",
    "visdrone": "VisDrone-MOT: sequences/ and annotations/ of a split, or a folder of splits",
    "uavdt": "UAVDT of many targets: UAV-benchmark-M/ and UAV-benchmark-MOTD_v1.0/GT/",
    "cvml": "PETS 2009 and CAVIAR as CVML: NAME.xml, with pictures in NAME/ where it has them",
    "sdd": "Stanford Drone: annotations/SCENE/VIDEO/annotations.txt, with its videos where they are there",
    "kitti": "KITTI tracking: training/ with image_02/, label_02/, calib/ and oxts/",
    "inria": "INRIA person: Test/ with pos/, annotations/ and neg/; or a folder of crops, each of one person",
    "simulated": "what dddas simulate writes: a folder a run",
}
"""Kind -> what it is, in a line. The adapter of `some-kind` is the module `some_kind`.

An adapter has `read(folder, options, wanted) -> Dataset`. folder: where the data set lies, a folder that is there.
options: further keys of the study's file (see `options.checked`). wanted: whether a clip of that name is asked for;
others are not read. It raises InputError for a wrong option; what is not there, and clips that cannot be read, are told
in Dataset.missing, so that the others go on (see `gathering.gather`).
"""

Wanted = Callable[[str], bool]


class Asked(Protocol):
    """What a study says of a data set."""

    @property
    def kind(self) -> str:
        """One of KINDS."""
        ...

    @property
    def folder(self) -> Path:
        """Where it lies."""
        ...

    @property
    def clips(self) -> tuple[str, ...]:
        """Patterns of names (fnmatch)."""
        ...

    @property
    def options(self) -> Mapping[str, Any]:
        """What the kind takes beside, by name."""
        ...


def read(source: Asked, base: Path) -> Dataset:
    """The clips that are asked for. base: what the folder is relative to.

    Raises InputError for an unknown kind or a wrong option. What is not there is told in Dataset.missing.
    """
    known(source.kind)
    folder = Path(normpath(base / source.folder.expanduser()))

    def wanted(name: str) -> bool:
        return any(fnmatchcase(name, pattern) for pattern in source.clips)

    adapter = import_module(f"{__package__}.{source.kind.replace('-', '_')}")
    if not folder.is_dir():
        said = "is no folder" if folder.exists() else "is not there"
        return Dataset(source.kind, folder, (), missing=(f"{folder} {said}; there belongs {KINDS[source.kind]}",))
    found: Dataset = adapter.read(folder, source.options, wanted)
    clips = tuple(clip for clip in found.clips if wanted(clip.name))
    if not clips and not found.missing:
        asked = "" if "*" in source.clips else f" by the name {' or '.join(source.clips)}"
        found = replace(found, missing=(f"{folder} holds no clip{asked}; wanted {KINDS[source.kind]}",))
    # A name that a file gives a clip, or a file's own, may hold anything; so may what was found in it.
    missing, notes = (tuple(str(InputError(line)) for line in lines) for lines in (found.missing, found.notes))
    return replace(found, clips=clips, missing=missing, notes=notes)


def known(kind: str) -> None:
    """Raises InputError, with the list of kinds, where this is none."""
    if kind not in KINDS:
        raise InputError(f"'{kind}' is no kind of data set; wanted one of {', '.join(KINDS)}")
