"""Berkeley motion segmentation: BMS-26 (2010) and FBMS-59 (2014), as published or as frames/ and masks/.

Read are clip folders of `frames/` and `masks/` (see `folder`). Terms of use, by its makers: scientific use only.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchvision_dddas.datasets.fitting import fitted
from torchvision_dddas.datasets.gathering import folders_in, gather
from torchvision_dddas.datasets.kinds import Wanted
from torchvision_dddas.datasets.options import checked
from torchvision_dddas.datasets.own import clip_at
from torchvision_dddas.datasets.record import Clip, Dataset

TERMS = "scientific use only; any commercial use is prohibited"


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """The clips of a folder. See `kinds.KINDS`."""
    said = checked("bms", options, {"rate_hz": None})

    def clip_of(name: str) -> Clip:
        return fitted(clip_at(folder / name, name, said["rate_hz"]))

    return gather("bms", folder, TERMS, filter(wanted, folders_in(folder)), clip_of)
