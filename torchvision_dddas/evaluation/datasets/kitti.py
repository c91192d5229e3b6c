"""KITTI tracking: boxes of road users from a car, in pixels and in metres."""

from collections.abc import Mapping
from math import pi
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.annotations import check_classes, check_known, read_rows, table_of, truth_of
from torchvision_dddas.evaluation.datasets.files import check_numbering, images_in
from torchvision_dddas.evaluation.datasets.record import Clip, Collector, Dataset, Wanted, check_options, folders_in
from torchvision_dddas.evaluation.metrics.truth import Positions, TrackTable, Truth, read_text

TERMS = "CC BY-NC-SA 3.0"
RATE_HZ = 10.0
CLASSES = ("Car", "Van", "Truck", "Pedestrian", "Person", "Person_sitting", "Cyclist", "Tram", "Misc")
UNLABELLED = "DontCare"
LEAST_OCCLUDED_UNKNOWN = 3
_COLUMNS = (
    "frame", "identity", "type", "truncated", "occluded", "alpha", "left", "top", "right", "bottom",
    "height", "width", "length", "x", "y", "z",
)  # fmt: skip


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """Options. classes: those that count, of CLASSES; all by default."""
    classes = check_options("kitti", options, {"classes": list(CLASSES)})["classes"]
    check_classes(classes, CLASSES, "KITTI")
    collector = Collector("kitti", folder, TERMS, wanted)
    home = folder / "training" if (folder / "training").is_dir() else folder
    places = {path.stem: path for path in sorted((home / "label_02").glob("*.txt"))}
    if not places:
        return collector.refuse(
            f"{folder} holds no training/label_02/0000.txt: the truth of KITTI tracking belongs there"
        )
    collector.report_unlabelled(folders_in(home / "image_02"), places, f"{home / 'label_02'}/{{}}.txt")

    def clip_of(name: str) -> Clip:
        belongs = home / "image_02" / name
        pictures = check_numbering(images_in(belongs), 0)
        calibration, flight = home / "calib" / f"{name}.txt", home / "oxts" / f"{name}.txt"
        absent = [str(path) for path in (calibration, flight) if not path.is_file()]
        truth = read_truth(places[name], classes, len(pictures), None if absent else (calibration, flight))
        if absent:
            collector.notes.append(f"{name}: no places in metres, which need {' and '.join(absent)}")
        return collector.label_clip(name, places[name], pictures, truth, belongs, rate_hz=RATE_HZ)

    return collector.collect(places, clip_of)


def read_truth(path: Path, classes: list[str], length: int = 0, pose: tuple[Path, Path] | None = None) -> Truth:
    """A label file. length: frames of the clip, 0 where unknown. pose: the files of calib and oxts.

    Raises InputError with file and line.
    """
    rows = read_rows(path, _COLUMNS, "type", first=0)
    v, words = rows.values, rows.word.astype(str)
    check_known(path, rows, words, (*CLASSES, UNLABELLED), "type", ", ".join(CLASSES))
    frame, box = v[:, 0] + 1, np.column_stack([v[:, 6:8], v[:, 8:10] - v[:, 6:8]])
    region = words == UNLABELLED
    regions = TrackTable.of(frame[region], v[region, 1], box[region])
    rest = ~region
    table = table_of(path, frame[rest], v[rest, 1], box[rest], rows.line[rest])
    is_visible = (v[rest, 3] <= 0) & (v[rest, 4] < LEAST_OCCLUDED_UNKNOWN)
    counts = np.isin(words[rest], classes) & is_visible
    where = positions_of(table.at(counts), v[rest][counts, 13:16], *pose) if pose else None
    return truth_of(path, table, counts, length, regions if region.any() else None, where)


EARTH_RADIUS_M = 6378137.0
MOST_LATITUDE_DEG = 85.0
"""Beyond it the map projection goes to infinity."""

_RECORD = ("latitude", "longitude", "altitude", "roll", "pitch", "yaw")
_SIZES = {"R_rect": 9, "Tr_velo_cam": 12, "Tr_imu_velo": 12}


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
    matrices = []
    for name, size in _SIZES.items():
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
        matrices.append(matrix)
    rectified, camera_from_velodyne, velodyne_from_imu = matrices
    chain: np.ndarray = rectified @ camera_from_velodyne @ velodyne_from_imu
    return chain


def poses(path: Path) -> np.ndarray:
    """(F, 4, 4) east, north, up from the unit's forward, left, up, of each line. Raises InputError with the line."""
    rows = read_rows(path, _RECORD)
    latitude, longitude, altitude, roll, pitch, yaw = rows.values.T
    if not len(rows.values):
        raise InputError(f"{path} is empty; wanted {','.join(_RECORD)} a line")
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
