"""KITTI tracking: boxes of road users from a car."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from torchvision_dddas.lab.evaluation.datasets.annotations import boxes_of_corners, table_of, truth_of
from torchvision_dddas.lab.evaluation.datasets.files import check_numbering, folders_in, images_in
from torchvision_dddas.lab.evaluation.datasets.record import Clip, Reader
from torchvision_dddas.lab.evaluation.metrics.text_rows import read_columns
from torchvision_dddas.lab.evaluation.metrics.truth import TrackTable


class Kitti(Reader):
    """KITTI tracking.

    training/image_02/0000/000000.png   pictures, from 0, 10 a second
    training/label_02/0000.txt          frame id type truncated occluded alpha, the box's corners, size, place
    """

    kind = "kitti"
    layout = "KITTI tracking: training/ with image_02/ and label_02/"
    terms = "CC BY-NC-SA 3.0"
    types = ("Car", "Van", "Truck", "Pedestrian", "Person", "Person_sitting", "Cyclist", "Tram", "Misc")
    defaults: ClassVar = {"classes": list(types)}
    words: ClassVar = {"classes": ("KITTI", types)}

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self._home = self.folder / "training" if (self.folder / "training").is_dir() else self.folder

    def _places(self) -> Mapping[str, Path]:
        places = {path.stem: path for path in sorted((self._home / "label_02").glob("*.txt"))}
        if not places:
            return self._refuse(
                f"{self.folder} holds no training/label_02/0000.txt; wanted the truth of KITTI tracking there"
            )
        self._report_unlabelled(folders_in(self._home / "image_02"), places, f"{self._home / 'label_02'}/{{}}.txt")
        return places

    def _clip(self, name: str, place: Path) -> Clip:
        belongs = self._home / "image_02" / name
        pictures = check_numbering(images_in(belongs), 0)
        corners = ("left", "top", "right", "bottom")
        columns = ("frame", "identity", "type", "truncated", "occluded", "alpha", *corners)
        rows = read_columns(place, columns, "type", first=0)
        rows.check_known("type", (*self.types, "DontCare"), ", ".join(self.types))
        is_region = rows["type"] == "DontCare"
        other, rows = rows.at(is_region), rows.at(~is_region)
        regions = TrackTable.of(other["frame"] + 1, other["identity"], boxes_of_corners(other.stack(*corners)))
        boxes = boxes_of_corners(rows.stack(*corners))
        table = table_of(place, rows["frame"] + 1, rows["identity"], boxes, rows.line)
        is_visible = (rows["truncated"] <= 0) & (rows["occluded"] < 3)  # 3: unknown
        counts = np.isin(rows["type"], self.options["classes"]) & is_visible
        truth = truth_of(place, table, counts, len(pictures), regions)
        return self._boxes_clip(name, place, pictures, truth, belongs, rate_hz=10.0)
