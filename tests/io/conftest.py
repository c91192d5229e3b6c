import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.types import Adjustment, Detections, Frame, Scene


def make_scene(number=1, targets=1, size=(64, 48), grey=False, **rest):
    """A scene with `targets` square targets of 2×2 pixels, row by row."""
    width, height = size
    shape = (height, width) if grey else (height, width, 3)
    image = np.full(shape, 90, np.uint8)
    mask = np.zeros((height, width), np.uint16)
    boxes = []
    for i in range(targets):
        x, y = 3 * (i % (width // 3)), 3 * (i // (width // 3))
        mask[y : y + 2, x : x + 2] = i + 1
        boxes.append((x, y, 2, 2))
    heading = np.where(np.arange(targets) % 2 == 0, -np.pi / 2, np.nan)
    found = Detections(
        np.array(boxes, float).reshape(-1, 4),
        np.full(targets, 0.875),
        np.full(targets, 4.0),
        heading,
        heading * 0 + 1.5,
    )
    return Scene(Frame(number, number / 10, image), mask, found, interval_frames=2, **rest)


@pytest.fixture
def scene():
    return make_scene


@pytest.fixture
def adjustment():
    return Adjustment(2, "interval_frames", 1.0, 2.0, "background flow 0.4 px a frame")


@pytest.fixture
def fly(tmp_path):
    """Telemetry from the content of a file."""

    def read(content, name="telemetry.csv", **options):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_telemetry(path, **options)

    return read


@pytest.fixture
def refused(tmp_path):
    """The one line in which a reader refuses a file."""

    def words(read, content, name="table.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(InputError) as caught:
            read(path)
        assert str(path) in str(caught.value)
        return str(caught.value)

    return words
