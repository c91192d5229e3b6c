"""The table of implementations of tensor operations by device. `dddas settings --backends` prints it.

Kornia's implementation is preferred. Our own is used if Kornia's takes more than twice its time on that device, or for
the reason stated in the table. The ratios are Kornia's time divided by ours: `python eval/speed.py operations` on a CPU
(eval/results/operations.json), `python eval/speed.py gpu` on a GPU (eval/results/gpu.json). The ratios of the Gaussian
and the warp on a CPU compare with our earlier implementations, which Kornia's replaced.
"""

from typing import NamedTuple


class Implementation(NamedTuple):
    """A row of the table. form: Kornia, ours or OpenCV. ratio: Kornia's time divided by ours; NaN if not measured."""

    operation: str
    device: str
    form: str
    ratio: float
    reason: str = ""


_NAN = float("nan")

IMPLEMENTATIONS = (
    Implementation("grey conversion", "cpu", "Kornia", _NAN, "OpenCV's where a frame comes as an array of bytes"),
    Implementation("HSV conversion", "cpu", "Kornia", 0.65),
    Implementation("warp", "cpu", "Kornia", 1.9, "by remap; its warp_perspective takes 4 to 6 times our time"),
    Implementation(
        "Gaussian",
        "cpu",
        "Kornia",
        1.2,
        "floats, kernel 7; for bytes our earlier implementation took a half to a quarter of the time",
    ),
    Implementation("points transformed", "cpu", "Kornia", 1.01),
    Implementation("transfer error", "cpu", "Kornia", _NAN),
    Implementation(
        "homography fit", "cpu", "ours", 0.73, "reports degenerate fits; Kornia's cannot be exported to ONNX"
    ),
    Implementation("resize", "cpu", "ours", 0.29, "with Kornia's, scores of a trained HOG detector change by 0.15"),
    Implementation("gradient", "cpu", "ours", 9.6),
    Implementation("corners", "cpu", "ours", 6.7),
    Implementation("pyramid", "cpu", "ours", 11.0),
    Implementation("morphology", "cpu", "ours", 11.1),
    Implementation("RANSAC", "cpu", "ours", 5.7),
    Implementation("histograms", "cpu", "ours", 84.0),
    Implementation("connected components", "cpu", "OpenCV", 11.5),
    Implementation("grey conversion", "cuda", "Kornia", _NAN, "OpenCV's where a frame comes as an array of bytes"),
    Implementation("HSV conversion", "cuda", "Kornia", 0.94),
    Implementation("warp", "cuda", "Kornia", 1.5),
    Implementation("Gaussian", "cuda", "Kornia", 2.8, "one form for all devices; 0.2 ms a picture"),
    Implementation("points transformed", "cuda", "Kornia", 0.90),
    Implementation("transfer error", "cuda", "Kornia", _NAN),
    Implementation(
        "homography fit", "cuda", "ours", 0.91, "reports degenerate fits; Kornia's cannot be exported to ONNX"
    ),
    Implementation("resize", "cuda", "ours", 0.28, "with Kornia's, scores of a trained HOG detector change by 0.15"),
    Implementation("gradient", "cuda", "Kornia", 1.1),
    Implementation("corners", "cuda", "Kornia", 1.1),
    Implementation("pyramid", "cuda", "ours", 3.3),
    Implementation("morphology", "cuda", "ours", 2.1, "the erosion; the closing has 20"),
    Implementation("RANSAC", "cuda", "ours", 5.3),
    Implementation("histograms", "cuda", "ours", 6.7),
    Implementation("connected components", "cuda", "Kornia", 0.67),
)
"""Every tensor operation of the detection chain, on a CPU and on a CUDA device."""

_FORMS = {(line.operation, line.device): line.form for line in IMPLEMENTATIONS}


def uses_kornia(operation: str, device: str) -> bool:
    """Return whether Kornia computes an operation on a device type."""
    return _FORMS[operation, device if device == "cpu" else "cuda"] == "Kornia"
