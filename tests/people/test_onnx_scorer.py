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
from torchvision_dddas.people import onnx_scorer
from torchvision_dddas.people.classifiers import read_classifier
from torchvision_dddas.people.onnx_scorer import OnnxScorer
from torchvision_dddas.types import Part

SVM = read_classifier("opencv", 3780)


def picture() -> np.ndarray:
    """Coloured patches under noise: edges of all directions, and black and white."""
    random = np.random.default_rng(1)
    patches = random.integers(-30, 286, (26, 22, 3)).clip(0, 255).astype(np.float32)
    large = cv2.resize(patches, (260, 300), interpolation=cv2.INTER_CUBIC)
    return (large + random.normal(0, 4, large.shape)).clip(0, 255).astype(np.uint8)


def scored(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    ((found,),) = OnnxScorer(PeopleParameters(), SVM).scores([image], [[Part((width, height), 0, 0, width, height)]])
    return found


@pytest.mark.parametrize(
    "sizes",
    [
        *((16, 200_000, 5000, 20_000, 10**7, 1), (40, 1, 5000, 1, 10**7, 10**7)),
        *((72, 30_000, 1, 3000, 40_000, 1), (1000, 10**6, 10**6, 10**6, 1, 10**7)),
    ],
)
def test_the_sizes_of_tiles_bands_strips_and_batches_do_not_change_the_scores(monkeypatch, sizes):
    image = picture()
    wanted = scored(image)
    names = ("_TILE_PX", "_GRADIENT_PX", "_BLOCKS", "_BAND_PX", "_STRIP_PX", "_FEW_VALUES")
    for name, size in zip(names, sizes, strict=True):
        monkeypatch.setattr(onnx_scorer, name, size)
    np.testing.assert_allclose(scored(image), wanted, atol=5e-6, rtol=0)


def test_graphs_of_another_layout_are_refused_with_the_command_that_exports_them():
    with pytest.raises(InputError, match=r"people.cell_px = 8, not 4.*dddas export --graph people.*people.cell_px=4"):
        OnnxScorer(PeopleParameters(cell_px=4), SVM)


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
