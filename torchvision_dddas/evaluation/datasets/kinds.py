"""The kinds of data sets, and reading one: the adapter of each kind is the module of that name in this folder."""

from collections.abc import Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from importlib import import_module
from os.path import normpath
from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Dataset, Source

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
"""Kind -> its layout in a line.

An adapter has `read(folder, options, wanted) -> Dataset`. folder: where the data set lies, a folder that exists.
options: further keys of the study's file (see `record.check_options`). wanted: see `record.Wanted`. It raises
InputError for a wrong option; absent files and clips that cannot be read go to Dataset.missing (see
`record.Collector`), so that the others go on.
"""


def read(source: Source, base: Path) -> Dataset:
    """The requested clips. base: what the folder is relative to.

    Raises InputError for an unknown kind or a wrong option. Dataset.missing says what is absent.
    """
    check_kind(source.kind)
    folder = Path(normpath(base / source.folder.expanduser()))

    def wanted(name: str) -> bool:
        return any(fnmatchcase(name, pattern) for pattern in source.clips)

    layout = KINDS[source.kind]
    if not folder.is_dir():
        problem = "is no folder" if folder.exists() else "does not exist"
        return Dataset(source.kind, folder, (), missing=(f"{folder} {problem}; wanted {layout}",))
    found: Dataset = import_module(f"{__package__}.{source.kind}").read(folder, source.options, wanted)
    if not found.clips and not found.missing:
        names = "" if "*" in source.clips else f" by the name {' or '.join(source.clips)}"
        found = replace(found, missing=(f"{folder} holds no clip{names}; wanted {layout}",))
    # Names of clips and contents of files may hold anything; InputError makes printable lines of them.
    missing, notes = (tuple(str(InputError(line)) for line in lines) for lines in (found.missing, found.notes))
    return replace(found, missing=missing, notes=notes)


def check_kind(kind: str) -> None:
    """Raises InputError, with the list of kinds, for an unknown one."""
    if kind not in KINDS:
        raise InputError(f"'{kind}' is no kind of data set; wanted one of {', '.join(KINDS)}")
