"""The onboard scorer: tiles, threads, gradients and its graphs."""

import json
import subprocess
import sys
import textwrap
from pathlib import Path

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.people import onnx_scorer as onboard_people
from torchvision_dddas.people.classifiers import read_classifier
from torchvision_dddas.people.onnx_scorer import OnnxScorer
from torchvision_dddas.types import Part

SVM = read_classifier("opencv", 3780)


def picture(seed: int, height: int = 300, width: int = 260) -> np.ndarray:
    """Coloured patches under noise: edges of all directions, and black and white."""
    random = np.random.default_rng(seed)
    patches = random.integers(-30, 286, (height // 12 + 1, width // 12 + 1, 3)).clip(0, 255).astype(np.float32)
    large = cv2.resize(patches, (width, height), interpolation=cv2.INTER_CUBIC)
    return (large + random.normal(0, 4, large.shape)).clip(0, 255).astype(np.uint8)


def whole(image: np.ndarray) -> Part:
    height, width = image.shape[:2]
    return Part((width, height), 0, 0, width, height)


def scored(image: np.ndarray, part: Part | None = None) -> np.ndarray:
    ((found,),) = OnnxScorer(PeopleParameters(), SVM).scores([image], [[part or whole(image)]])
    return found


@pytest.mark.parametrize(
    ("tile_px", "gradient_px", "blocks", "band_px"),
    [(16, 200_000, 5000, 20_000), (40, 1, 5000, 1), (72, 30_000, 1, 3000), (1000, 10**6, 10**6, 10**6)],
)
def test_how_the_work_is_cut_changes_nothing(monkeypatch, tile_px, gradient_px, blocks, band_px):
    image = picture(1)
    wanted = scored(image)
    monkeypatch.setattr(onboard_people, "_TILE_PX", tile_px)
    monkeypatch.setattr(onboard_people, "_GRADIENT_PX", gradient_px)
    monkeypatch.setattr(onboard_people, "_BLOCKS", blocks)
    monkeypatch.setattr(onboard_people, "_BAND_PX", band_px)
    np.testing.assert_allclose(scored(image), wanted, atol=5e-6, rtol=0)


def test_graphs_of_another_layout_are_refused_with_what_makes_them():
    with pytest.raises(InputError, match=r"people.cell_px = 8, not 4.*dddas export --graph people.*people.cell_px=4"):
        OnnxScorer(PeopleParameters(cell_px=4), read_classifier("opencv", 3780))


@pytest.mark.parametrize("text", [None, "", "[]", '{"graphs": {}}', '{"layout": null}'])
def test_a_folder_without_graphs_is_refused(tmp_path: Path, text: str | None):
    if text is not None:
        (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(InputError, match=r"people.graphs: .*dddas export"):
        OnnxScorer(PeopleParameters(graphs=str(tmp_path)), SVM)


@pytest.mark.slow
def test_a_frame_needs_no_torch_and_further_ones_no_more_memory():
    """In a process of its own, on two threads: torch is not imported, resident memory is flat and below 150 MB."""
    script = textwrap.dedent("""
        import json, sys
        from pathlib import Path
        import cv2
        import numpy as np
        from torchvision_dddas.config import PeopleParameters
        from torchvision_dddas.people.classifiers import read_classifier
        from torchvision_dddas.people import pyramid
        from torchvision_dddas.people.detector import load_scorer

        def peak_mb():
            lines = Path("/proc/self/status").read_text().splitlines()
            return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))

        cv2.setNumThreads(2)
        parameters = PeopleParameters(scale_step=1.2)
        recognizer = load_scorer(parameters, "auto", read_classifier("opencv", 3780))
        image = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
        peaks = []
        for _ in range(6):
            recognizer.scores([image], [pyramid.everywhere((640, 480), parameters)])
            peaks.append(peak_mb())
        print(json.dumps({"name": recognizer.name, "torch": "torch" in sys.modules, "peaks": peaks}))
    """)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["name"] == "onboard" and not found["torch"]
    assert found["peaks"][-1] < 150
    assert found["peaks"][-1] - found["peaks"][2] < 5
