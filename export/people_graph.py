"""Make the ONNX graph of the score map that the onboard back end runs, from `ops.hog`.

usage: python export/people_graph.py [--config NAME] [--set people.cell_px=4 ...] [--out FILE]

It needs the extras `torch` and `export`. The graph takes

    image    uint8 (H + 2, W + 2, 3)  a level of the pyramid in BGR, or a part of one, with a border of one pixel
    weights  float32 (down, across, F)  the SVM's, as `ops.hog.arranged` has them
    bias, clip  float32  numbers

and gives `scores`, float32 (ny, nx): [j, i] is that of the window whose top left pixel lies j, i block strides from
the part's. H, W, and the window's blocks are free; cells, blocks, bins and gamma are baked in and named in the
metadata. It is written once its scores are torch's to 1e-4, on pictures and windows of other sizes than traced; the
same versions write the same bytes. Without --out it replaces the shipped graph; with one, name that file to the
onboard back end by `--set people.graph=FILE`.
"""

import argparse
import io
import os
import warnings
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import onnx
import onnxruntime
import torch

from torchvision_dddas.ops import hog
from torchvision_dddas.settings import PeopleKnobs, load
from torchvision_dddas.sinks.whole import write_whole
from torchvision_dddas.vision.onboard_people import BAKED, SHIPPED

OPSET, TOLERANCE = 20, 1e-4


class ScoreMap(torch.nn.Module):
    """What the graph computes."""

    def __init__(self, layout: hog.Layout) -> None:
        super().__init__()
        self.layout = layout

    def forward(
        self, image: torch.Tensor, weights: torch.Tensor, bias: torch.Tensor, clip: torch.Tensor
    ) -> torch.Tensor:
        bordered = image.permute(2, 0, 1)[None].float()
        return hog.scores(hog.blocks(bordered, self.layout, clip), weights, bias)[0]


def layout_of(knobs: PeopleKnobs) -> hog.Layout:
    return hog.Layout(
        (knobs.window_width_px, knobs.window_height_px),
        knobs.cell_px,
        knobs.block_px,
        knobs.block_stride_px,
        knobs.bins,
        knobs.signed,
        knobs.clip,
        knobs.gamma,
    )


def example(layout: hog.Layout, spare: tuple[int, int], seed: int) -> tuple[torch.Tensor, ...]:
    """Inputs of a picture that is so many pixels larger than the window, of smooth noise."""
    rng = np.random.default_rng(seed)
    width, height = (length + more + 2 for length, more in zip(layout.window, spare, strict=True))
    rough = rng.integers(0, 256, (height // 4 + 1, width // 4 + 1, 3))
    image = np.kron(rough, np.ones((4, 4, 1), int))[:height, :width] + rng.integers(-20, 20, (height, width, 3))
    across, down = layout.blocks
    weights = rng.normal(0, 0.02, (down, across, layout.features // (down * across)))
    return (
        torch.from_numpy(image.clip(0, 255).astype(np.uint8)),
        torch.from_numpy(weights.astype(np.float32)),
        torch.tensor(-0.25),
        torch.tensor(layout.clip),
    )


def exported(layout: hog.Layout) -> bytes:
    """The graph as a file's content, without what differs from run to run."""
    auto = torch.export.Dim.AUTO
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            ScoreMap(layout).eval(),
            example(layout, (23, 41), 0),
            dynamo=True,
            dynamic_shapes=({0: auto, 1: auto}, {0: auto, 1: auto}, None, None),
            output_names=["scores"],
            opset_version=OPSET,
            verbose=False,
        )
    assert program is not None
    return stripped(program.model_proto, layout)


def stripped(model: onnx.ModelProto, layout: hog.Layout) -> bytes:
    """Without the trace's stack and shapes, and with the layout in the metadata."""
    for node in model.graph.node:
        node.ClearField("metadata_props")
        node.ClearField("doc_string")
    for held in (model.graph.value_info, model.metadata_props, model.graph.metadata_props):
        del held[:]
    for value in (*model.graph.input, *model.graph.output):
        value.ClearField("metadata_props")
    knobs = (layout.cell, layout.block, layout.stride, layout.bins, int(layout.signed), int(layout.gamma))
    onnx.helper.set_model_props(model, {name: str(int(value)) for name, value in zip(BAKED, knobs, strict=True)})
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)


def largest_difference(content: bytes, layout: hog.Layout) -> float:
    """Between the graph's scores and torch's, over pictures and windows of other sizes."""
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    worst = 0.0
    step = layout.stride
    for seed, (spare, wider) in enumerate((((0, 0), 0), ((1, 3 * step), 0), ((5 * step, 2), 1), ((87, 190), 2)), 1):
        window = (layout.window[0] + wider * step, layout.window[1])
        other = hog.Layout(
            window, layout.cell, layout.block, step, layout.bins, layout.signed, layout.clip, layout.gamma
        )
        inputs = example(other, spare, seed)
        feed = {entry.name: value.numpy() for entry, value in zip(session.get_inputs(), inputs, strict=True)}
        wanted = ScoreMap(other)(*inputs).numpy()
        (found,) = session.run(None, feed)
        if found.shape != wanted.shape:
            raise SystemExit(f"the graph's map is {found.shape}, torch's {wanted.shape}; nothing was written")
        worst = max(worst, float(np.abs(found - wanted).max()))
    return worst


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config")
    parser.add_argument("--set", nargs="*", default=[], dest="overrides", metavar="KNOB=VALUE")
    parser.add_argument("--out", type=Path, default=SHIPPED)
    options = parser.parse_args()
    layout = layout_of(load(options.config, options.overrides).people)
    content = exported(layout)
    difference = largest_difference(content, layout)
    if not difference <= TOLERANCE:
        raise SystemExit(f"the graph's scores are up to {difference:.1e} off torch's; nothing was written")
    write_whole(options.out, content)
    print(f"{options.out}: {len(content)} bytes, scores within {difference:.1e} of torch's")


if __name__ == "__main__":
    main()
