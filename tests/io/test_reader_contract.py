"""What holds for every reader of a file: a good one is read, a bad one refused in one line that names it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.fuzz import seeds
from torchvision_dddas.config import load_config
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.camera_files import read_camera, read_measurements, read_poses
from torchvision_dddas.io.colour_files import read_colours
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.io.elevation import read_elevation
from torchvision_dddas.io.ground_tables import read_landmarks, read_positions
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.people.classifiers import read_classifier

# Reader, name of a file, a good file, and whether an empty one is refused.
READERS: dict[str, tuple[Callable[[Path], object], str, Callable[[], bytes], bool]] = {
    "detections": (read_detections, "a.csv", lambda: seeds.text("detections")[0], False),
    "positions": (read_positions, "a.csv", lambda: seeds.text("positions")[0], True),
    "landmarks": (lambda path: read_landmarks(path, 10.0, 0.0), "a.csv", lambda: seeds.text("landmarks")[0], True),
    "measurements": (read_measurements, "a.csv", lambda: seeds.text("measurements")[0], True),
    "poses": (read_poses, "a.csv", lambda: seeds.text("poses")[0], True),
    "camera": (read_camera, "a.toml", lambda: seeds.text("camera")[0], True),
    "colours": (read_colours, "a.toml", lambda: seeds.text("colours")[0], True),
    "settings": (load_config, "a.toml", lambda: seeds.text("settings")[0], False),
    "own telemetry": (read_telemetry, "a.csv", lambda: seeds.text("own telemetry")[0], True),
    "program telemetry": (read_telemetry, "a.csv", lambda: seeds.text("program telemetry")[0], True),
    "subtitles": (read_telemetry, "a.srt", lambda: seeds.text("subtitles")[0], True),
    "classifier": (
        lambda path: read_classifier(path, seeds.FEATURES), "a.txt", lambda: seeds.text("classifier text")[0], True,
    ),
    "video": (open_source, "a.avi", lambda: seeds.videos(".avi", "MJPG")[0], True),
    "elevation": (
        lambda path: read_elevation(path, np.zeros((1, 2)), None, 30.0), "a.tif", lambda: seeds.raster(1)[0], True,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", READERS)
def test_a_good_file_is_read_and_a_bad_one_is_refused_in_one_line_that_names_it(tmp_path: Path, name: str) -> None:
    if name == "elevation":
        pytest.importorskip("rasterio")
    read, file, whole, is_content_wanted = READERS[name]
    path = tmp_path / file
    path.write_bytes(whole())
    read(path)
    bad: list[bytes | None] = [None, b"\xff\xfe\x00\x01\x80", *([b""] if is_content_wanted else [])]
    for content in bad:
        path.unlink()
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(InputError) as caught:
            read(path)
        assert file in str(caught.value) and str(caught.value).isprintable()
        path.touch()
