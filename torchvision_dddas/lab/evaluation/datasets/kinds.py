"""The kinds of data sets, and the reader of each."""

from collections.abc import Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from os.path import normpath
from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets.folder import Folder, Simulated
from torchvision_dddas.lab.evaluation.datasets.inria import Inria
from torchvision_dddas.lab.evaluation.datasets.kitti import Kitti
from torchvision_dddas.lab.evaluation.datasets.labelled_boxes import Cvml, StanfordDrone, Uavdt, VisDrone
from torchvision_dddas.lab.evaluation.datasets.labelled_masks import Bms, CdNet, Davis
from torchvision_dddas.lab.evaluation.datasets.motchallenge import MotChallenge
from torchvision_dddas.lab.evaluation.datasets.one_target import Uav123, Vivid
from torchvision_dddas.lab.evaluation.datasets.record import Dataset, DatasetSource, Reader

_READERS: tuple[type[Reader], ...] = (
    *(Folder, Bms, Davis, CdNet, Uav123, Vivid, MotChallenge),
    *(VisDrone, Uavdt, Cvml, StanfordDrone, Kitti, Inria, Simulated),
)
KINDS: Mapping[str, type[Reader]] = {reader.kind: reader for reader in _READERS}


def read(source: DatasetSource, base: Path) -> Dataset:
    """Return the requested clips. base: the folder to which the data set's folder is relative.

    Raise InputError for an unknown kind or a wrong option. Dataset.missing states what is absent.
    """
    check_kind(source.kind)
    reader = KINDS[source.kind]
    folder = Path(normpath(base / source.folder.expanduser()))

    def wanted(name: str) -> bool:
        return any(fnmatchcase(name, pattern) for pattern in source.clips)

    if not folder.is_dir():
        problem = "is no folder" if folder.exists() else "does not exist"
        return Dataset(source.kind, folder, (), missing=(f"{folder} {problem}; wanted {reader.layout}",))
    found = reader(folder, source.options, wanted).read()
    if not found.clips and not found.missing:
        names = "" if "*" in source.clips else f" by the name {' or '.join(source.clips)}"
        found = replace(found, missing=(f"{folder} holds no clip{names}; wanted {reader.layout}",))
    # Names of clips and contents of files may contain any characters; InputError makes printable lines of them.
    missing, notes = (tuple(str(InputError(line)) for line in lines) for lines in (found.missing, found.notes))
    return replace(found, missing=missing, notes=notes)


def check_kind(kind: str) -> None:
    """Raise InputError, with the list of kinds, for an unknown kind."""
    if kind not in KINDS:
        raise InputError(f"'{kind}' is not a kind of data set; wanted one of {', '.join(KINDS)}")
