"""KITTI tracking: boxes of road users from a car, in pixels and in metres."""

from collections.abc import Mapping
from math import pi
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets.annotations import boxes_of_corners, table_of, truth_of
from torchvision_dddas.lab.evaluation.datasets.files import check_numbering, folders_in, images_in
from torchvision_dddas.lab.evaluation.datasets.record import Clip, Reader
from torchvision_dddas.lab.evaluation.metrics.text_rows import read_columns, read_text
from torchvision_dddas.lab.evaluation.metrics.truth import Positions, TrackTable

EARTH_RADIUS_M = 6378137.0
MOST_LATITUDE_DEG = 85.0
"""Beyond it the map projection goes to infinity."""


class Kitti(Reader):
    """KITTI tracking.

    training/image_02/0000/000000.png   pictures, from 0, 10 a second
    training/label_02/0000.txt          frame id type truncated occluded alpha, the box's corners, size, place
    training/calib/0000.txt             rectified camera from the inertial unit
    training/oxts/0000.txt              latitude, longitude, altitude, roll, pitch, yaw of each frame
    """

    kind = "kitti"
    layout = "KITTI tracking: training/ with image_02/, label_02/, calib/ and oxts/"
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
                f"{self.folder} holds no training/label_02/0000.txt: the truth of KITTI tracking belongs there"
            )
        self._report_unlabelled(folders_in(self._home / "image_02"), places, f"{self._home / 'label_02'}/{{}}.txt")
        return places

    def _clip(self, name: str, place: Path) -> Clip:
        belongs = self._home / "image_02" / name
        pictures = check_numbering(images_in(belongs), 0)
        pose = [self._home / part / f"{name}.txt" for part in ("calib", "oxts")]
        absent = [str(path) for path in pose if not path.is_file()]
        corners = ("left", "top", "right", "bottom")
        columns = ("frame", "identity", "type", "truncated", "occluded", "alpha", *corners)
        rows = read_columns(place, (*columns, "height", "width", "length", "x", "y", "z"), "type", first=0)
        rows.check_known("type", (*self.types, "DontCare"), ", ".join(self.types))
        is_region = rows["type"] == "DontCare"
        other, rows = rows.at(is_region), rows.at(~is_region)
        regions = TrackTable.of(other["frame"] + 1, other["identity"], boxes_of_corners(other.stack(*corners)))
        boxes = boxes_of_corners(rows.stack(*corners))
        table = table_of(place, rows["frame"] + 1, rows["identity"], boxes, rows.line)
        is_visible = (rows["truncated"] <= 0) & (rows["occluded"] < 3)  # 3: unknown
        counts = np.isin(rows["type"], self.options["classes"]) & is_visible
        where = None if absent else positions_of(table.at(counts), rows.at(counts).stack("x", "y", "z"), *pose)
        truth = truth_of(place, table, counts, len(pictures), regions, where)
        if absent:
            self.notes.append(f"{name}: no places in metres, which need {' and '.join(absent)}")
        return self._boxes_clip(name, place, pictures, truth, belongs, rate_hz=10.0)


def positions_of(table: TrackTable, camera_m: np.ndarray, calibration: Path, records: Path) -> Positions:
    """Where rows are on the ground. camera_m: (N, 3), right, down and ahead of the rectified camera.

    Metres east and north of the unit's place in the first frame, by the Mercator projection at its latitude, as
    KITTI's own tools have it. Raises InputError: broken files, a row in a frame without record.
    """
    imu_from_camera = np.linalg.inv(camera_from_imu(calibration))
    world_from_imu = poses(records)
    if len(table.frame) and table.frame.max() > len(world_from_imu):
        raise InputError(f"{records} has {len(world_from_imu)} lines, but frame {table.frame.max()} is labelled")
    homogeneous = np.column_stack([camera_m, np.ones(len(camera_m))]) @ imu_from_camera.T
    place = np.einsum("nij,nj->ni", world_from_imu[table.frame - 1], homogeneous)
    return Positions(table.frame, table.identity, place[:, :2])


def camera_from_imu(path: Path) -> np.ndarray:
    """(4, 4) rectified camera from the inertial unit. Raises InputError where one of the matrices lacks."""
    lines = {cells[0].rstrip(":"): cells[1:] for line in read_text(path).splitlines() if (cells := line.split())}
    chain: np.ndarray = np.eye(4)
    for name, size in {"R_rect": 9, "Tr_velo_cam": 12, "Tr_imu_velo": 12}.items():
        try:
            values = np.array([float(cell) for cell in lines.get(name, ())])
        except ValueError:
            values = np.zeros(0)
        if len(values) != size or not np.isfinite(values).all() or np.abs(values).max() > 1e6:
            raise InputError(f"{path} does not hold {name} with {size} numbers")
        matrix = np.eye(4)
        matrix[:3, : size // 3] = values.reshape(3, -1)
        if np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max() > 0.01:
            raise InputError(f"{path}: {name} is no rotation")
        chain = chain @ matrix
    return chain


def poses(path: Path) -> np.ndarray:
    """(F, 4, 4) east, north, up from the unit's forward, left, up, of each line. Raises InputError with the line."""
    columns = ("latitude", "longitude", "altitude", "roll", "pitch", "yaw")
    rows = read_columns(path, columns)
    latitude, longitude, altitude, roll, pitch, yaw = rows.stack(*columns).T
    if not len(rows):
        raise InputError(f"{path} is empty; wanted {','.join(columns)} a line")
    outside = (np.abs(latitude) > MOST_LATITUDE_DEG) | (np.abs(longitude) > 360)
    if outside.any():
        i = int(outside.argmax())
        raise InputError(
            f"{path}, line {rows.line[i]}: {latitude[i]:g}, {longitude[i]:g} is no place; wanted degrees, "
            f"latitudes up to {MOST_LATITUDE_DEG:g}"
        )
    scale = EARTH_RADIUS_M * np.cos(np.radians(latitude[0]))
    east = scale * np.radians(longitude)
    north = scale * np.log(np.tan(pi / 4 + np.radians(latitude) / 2))
    found = np.tile(np.eye(4), (len(latitude), 1, 1))
    found[:, :3, :3] = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
    found[:, :3, 3] = np.stack([east - east[0], north - north[0], altitude - altitude[0]], axis=1)
    return found


def _about(axis: int, angle_rad: np.ndarray) -> np.ndarray:
    """(F, 3, 3) rotations about x, y or z."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    found = np.tile(np.eye(3), (len(c), 1, 1))
    found[:, a, a], found[:, b, b], found[:, a, b], found[:, b, a] = c, c, -s, s
    return found
