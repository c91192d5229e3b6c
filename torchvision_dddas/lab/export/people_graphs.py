"""Build the graphs that score windows for people, node by node, from the constants of `functional.hog`.

    people.onnx             uint8 picture (H + 2, W + 2, 3 or 1) with a border of one pixel -> `scores` (ny, nx)
    people_histograms.onnx  `polar` (1, 2, H, W), magnitude and magnitude x direction in radians -> `histograms`
                            (F, ny, nx) of all blocks, before normalisation
    people_scores.onnx      `histograms` -> `scores`

people.onnx computes the whole score map in any ONNX runtime. The onboard back end runs the other two graphs and joins
tiles between them. OpenCV computes its gradient, which makes it several times faster (`eval/speed.py people`). An SVM
with the same cells, blocks and bins runs on them with any window size. `functional.arrange_weights` gives `weights`.

Traced graphs of `functional.hog` are correct but take 160 ns per pixel on one core at 640x480. people.onnx takes 110,
people_histograms.onnx 14 and cv2.HOGDescriptor 54 in all, because ONNX Runtime has fast convolutions and slow copies.
"""

import math
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.functional import hog_svm
from torchvision_dddas.lab.export.graph_files import OPSET, Check, ExportedGraph, open_session
from torchvision_dddas.people.onnx_scorer import BAKED
from torchvision_dddas.people.torch_scorer import layout

IR_VERSION = 10
FAR = 2**31 - 1  # slice end that means the end of the axis
TOLERANCE = 5e-5
CHANNELS = 16  # ONNX Runtime's fast convolutions process channels in groups of 16, 8 or 4
ABOUT = {
    "people.onnx": "scores of all windows of a picture for people (HOG and a linear SVM), for any runtime",
    "people_histograms.onnx": "the same, first half as the onboard back end runs it: histograms of all blocks",
    "people_scores.onnx": "the same, second half: scores from histograms",
}


def export_people(parameters: PeopleParameters) -> dict[str, ExportedGraph]:
    """Return {file name: graph}, compared with torch."""
    wanted = layout(parameters)
    files = build_graphs(wanted)
    check = Check("score", largest_difference(files, wanted), TOLERANCE)
    held, source = baked(wanted), "functional.hog"
    return {name: ExportedGraph(files[name], about, source, held, (check,)) for name, about in ABOUT.items()}


class GraphBuilder:
    """Builds a graph. A call adds a node and returns its output's name."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[bytes, onnx.TensorProto] = {}

    def __call__(self, operation: str, *inputs: str, out: str = "", **attributes: Any) -> str:
        """Add a node with one output and return the output's name. out: name to use."""
        out = out or f"{operation.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operation, list(inputs), [out], name=out, **attributes))
        return out

    def number(self, *values: float) -> str:
        """Return the name of a float32 constant, a number or a vector."""
        return self.constant(np.array(values if len(values) > 1 else values[0], np.float32))

    def whole(self, *values: int) -> str:
        """Return the name of a constant int64 vector."""
        return self.constant(np.array(values, np.int64))

    def constant(self, array: np.ndarray) -> str:
        """Return the name of a constant array. Equal arrays share one constant."""
        key = str(array.dtype).encode() + str(array.shape).encode() + array.tobytes()
        name = f"constant_{len(self.constants)}"
        return self.constants.setdefault(key, numpy_helper.from_array(array, name)).name

    def cut(self, name: str, axis: int, begin: int, end: int) -> str:
        """Slice an axis from begin to end."""
        return self("Slice", name, self.whole(begin), self.whole(end), self.whole(axis))

    def model(self, inputs: dict, outputs: dict, properties: dict[str, str], name: str = "people") -> bytes:
        """Return the content of the ONNX file. inputs, outputs: {name: (type, shape)}."""
        given, found = (
            [helper.make_tensor_value_info(value, kind, shape) for value, (kind, shape) in held.items()]
            for held in (inputs, outputs)
        )
        graph = helper.make_graph(self.nodes, name, given, found, initializer=list(self.constants.values()))
        made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        helper.set_model_props(made, properties)
        onnx.checker.check_model(made, full_check=True)
        return made.SerializeToString(deterministic=True)


def polar(graph: GraphBuilder, image: str, layout: hog_svm.Layout) -> str:
    """Add `functional.hog_svm.gradient` and `angle`, (1, 2, H, W)."""
    levels = graph("Transpose", graph("Expand", image, graph.whole(1, 1, 3)), perm=[2, 0, 1])
    levels = graph("Cast", levels, to=TensorProto.FLOAT)
    if layout.gamma:
        levels = graph("Sqrt", levels)
    inner = graph.cut(levels, 1, 1, -1)
    across = graph("Sub", graph.cut(inner, 2, 2, FAR), graph.cut(inner, 2, 0, -2))
    inner = graph.cut(levels, 2, 1, -1)
    down = graph("Sub", graph.cut(inner, 1, 2, FAR), graph.cut(inner, 1, 0, -2))
    square = graph("Add", graph("Mul", across, across), graph("Mul", down, down))
    dx, dy, largest = (graph.cut(name, 0, 0, 1) for name in (across, down, square))
    for channel in (1, 2):
        here = graph.cut(square, 0, channel, channel + 1)
        wins = graph("Greater", here, largest)
        dx = graph("Where", wins, graph.cut(across, 0, channel, channel + 1), dx)
        dy = graph("Where", wins, graph.cut(down, 0, channel, channel + 1), dy)
        largest = graph("Max", here, largest)
    magnitude = graph("Sqrt", largest)
    x, y = graph("Abs", dx), graph("Abs", dy)
    ratio = graph("Div", graph("Min", x, y), graph("Add", graph("Max", x, y), graph.number(hog_svm.TINY)))
    squared = graph("Mul", ratio, ratio)
    arc = [math.radians(power) for power in hog_svm.ARC]
    angle = graph("Add", graph("Mul", squared, graph.number(arc[3])), graph.number(arc[2]))
    for power in (arc[1], arc[0]):
        angle = graph("Add", graph("Mul", angle, squared), graph.number(power))
    angle = graph("Mul", angle, ratio)
    nothing, half_turn = graph.number(0.0), graph.number(math.pi)
    angle = graph("Where", graph("Less", x, y), graph("Sub", graph.number(math.pi / 2), angle), angle)
    if layout.signed:
        angle = graph("Where", graph("Less", dx, nothing), graph("Sub", half_turn, angle), angle)
        angle = graph("Where", graph("Less", dy, nothing), graph("Sub", graph.number(2 * math.pi), angle), angle)
    else:
        folded = graph("Less", graph("Mul", dx, dy), nothing)
        angle = graph("Where", folded, graph("Sub", half_turn, angle), angle)
    both = graph("Concat", magnitude, graph("Mul", magnitude, angle), axis=0)
    return graph("Unsqueeze", both, graph.whole(0))


def histograms(graph: GraphBuilder, polar: str, layout: hog_svm.Layout, out: str = "") -> str:
    """Add the steps from `functional.hog_svm.hats` to the middle of `blocks`: (F, ny, nx), before normalisation.

    The hats are sums of ramps relu(m (angle - k)). A 1x1 convolution with a rectifier computes the ramps, which costs a
    digit of accuracy. A depthwise convolution pools over rows, then over columns. A further 1x1 convolution sums the
    ramps to hats and orders a block's numbers.
    """
    at = hog_svm.knots(layout.bins)[:-1]
    used = len(at) + 1
    channels = -(-used // CHANNELS) * CHANNELS
    ramps = np.zeros((channels, 2, 1, 1), np.float32)
    ramps[0, 0] = 1
    ramps[1:used, 0, 0, 0] = [-(knot + 0.5) for knot in at]
    ramps[1:used, 1] = layout.bins / (2 * math.pi if layout.signed else math.pi)
    maps = graph("Relu", graph("Conv", polar, graph.constant(ramps), kernel_shape=[1, 1]))
    hats = _hats_of_ramps(layout.bins).astype(np.float32)
    cells = layout.cells
    order = np.zeros((layout.bins, cells, cells, cells, cells, channels), np.float32)
    pooled = []
    for cy, rows in enumerate(hog_svm.cell_weights(layout).numpy().astype(np.float32)):
        over_rows = pool(graph, maps, rows[:, None], channels, (layout.stride, 1))
        for cx, columns in enumerate(hog_svm.cell_weights(layout).numpy().astype(np.float32)):
            pooled.append(pool(graph, over_rows, columns[None], channels, (1, layout.stride)))
            order[:, cy, cx, cy, cx, :used] = hats
    kernel = graph.constant(order.reshape(layout.bins * cells**2, -1, 1, 1))
    found = graph("Conv", graph("Concat", *pooled, axis=1), kernel, kernel_shape=[1, 1])
    return graph("Squeeze", found, graph.whole(0), out=out)


def _hats_of_ramps(bins: int) -> np.ndarray:
    """Return (bins, K) weights of ramps that sum to each bin's hat: second differences at knots. Column 0 is m."""
    rows = np.zeros((bins, bins + 4))
    for place, knot in enumerate(hog_svm.knots(bins)):
        # The first hat starts as 1 - (t - k), and the next ramp bends it to zero.
        rows[knot % bins, place : place + 3] += [1.0, -2.0 if place else -1.0, 1.0]
    return rows[:, : bins + 2]


def pool(graph: GraphBuilder, maps: str, weights: np.ndarray, channels: int, stride: tuple[int, int]) -> str:
    """Add weighted sums of each channel (depthwise convolution)."""
    kernel = graph.constant(np.ascontiguousarray(np.broadcast_to(weights, (channels, 1, *weights.shape))))
    return graph("Conv", maps, kernel, kernel_shape=list(weights.shape), strides=list(stride), group=channels)


def scores(graph: GraphBuilder, histograms: str, layout: hog_svm.Layout, out: str) -> str:
    """Add the end of `functional.hog` and the scores, (ny - down + 1, nx - across + 1)."""
    size = layout.bins * layout.cells**2
    flat = graph("Reshape", histograms, graph.whole(size, -1))
    # Sum a block's numbers by a product with ones, because ONNX Runtime is slow at sums over the first axis.
    ones = graph.constant(np.ones((1, size), np.float32))

    def norm(numbers: str, soft: float) -> str:
        square = graph("MatMul", ones, graph("Mul", numbers, numbers))
        return graph("Add", graph("Sqrt", square), graph.number(soft))

    clipped = graph("Min", graph("Div", flat, norm(flat, size * hog_svm.SOFT_FIRST)), "clip")
    blocks = graph("Div", clipped, norm(clipped, hog_svm.SOFT_SECOND))

    def length(name: str, axis: int) -> str:
        return graph("Shape", name, start=axis, end=axis + 1)

    def joined(*names: str) -> str:
        return graph("Concat", *names, axis=0)

    down, across, ny, nx = length("weights", 0), length("weights", 1), length(histograms, 1), length(histograms, 2)
    zero, one, rest = graph.whole(0), graph.whole(1), graph.whole(-1)
    places = graph("Mul", ny, nx)
    weights = graph("Reshape", "weights", graph.whole(-1, size))
    part = graph("MatMul", weights, blocks)
    # Sum over a window's blocks as in `functional.svm_scores`.
    part = graph("Pad", graph("Reshape", part, joined(down, rest)), joined(graph.whole(0, 0, 0), across))
    part = graph("ReduceSum", graph("Reshape", part, joined(down, across, rest)), one, keepdims=0)
    more = graph("Mul", down, nx)
    part = graph("Pad", graph("Reshape", part, rest), joined(zero, more))
    part = graph("ReduceSum", graph("Reshape", part, joined(down, rest)), zero, keepdims=0)
    part = graph("Reshape", graph("Slice", part, zero, places, zero), joined(ny, nx))
    ends = graph("Add", graph("Sub", joined(ny, nx), joined(down, across)), one)
    return graph("Add", graph("Slice", part, graph.whole(0, 0), ends, graph.whole(0, 1)), "bias", out=out)


def build_graphs(layout: hog_svm.Layout) -> dict[str, bytes]:
    """Return {file name: content}."""
    size = layout.bins * layout.cells**2
    number: tuple[int, list] = (TensorProto.FLOAT, [])
    svm = {"weights": (TensorProto.FLOAT, ["down", "across", size]), "bias": number, "clip": number}
    image = {"image": (TensorProto.UINT8, ["H + 2", "W + 2", "channels"])}
    made = {"polar": (TensorProto.FLOAT, [1, 2, "H", "W"])}
    held = {"histograms": (TensorProto.FLOAT, [size, "ny", "nx"])}
    found = {"scores": (TensorProto.FLOAT, ["windows down", "windows across"])}
    properties = {name: str(value) for name, value in baked(layout).items()}
    whole, first, second = GraphBuilder(), GraphBuilder(), GraphBuilder()
    scores(whole, histograms(whole, polar(whole, "image", layout), layout), layout, "scores")
    histograms(first, "polar", layout, "histograms")
    scores(second, "histograms", layout, "scores")
    return {
        "people.onnx": whole.model({**image, **svm}, found, properties),
        "people_histograms.onnx": first.model(made, held, properties),
        "people_scores.onnx": second.model({**held, **svm}, found, properties),
    }


def baked(layout: hog_svm.Layout) -> dict[str, int]:
    """Return the layout parameters that are built into a graph."""
    values = layout.cell, layout.block, layout.stride, layout.bins, int(layout.signed), int(layout.gamma)
    return dict(zip(BAKED, values, strict=True))


def example(layout: hog_svm.Layout, spare: tuple[int, int], channels: int, seed: int) -> dict[str, np.ndarray]:
    """Return example inputs: a picture of noisy patches, `spare` pixels larger than the window, and an SVM."""
    rng = np.random.default_rng(seed)
    width, height = (length + more + 2 for length, more in zip(layout.window, spare, strict=True))
    patches = rng.integers(0, 256, (height // 4 + 1, width // 4 + 1, channels))
    image = np.kron(patches, np.ones((4, 4, 1), int))[:height, :width] + rng.integers(-20, 20, (height, width, 1))
    across, down = layout.blocks
    weights = rng.normal(0, 0.02, (down, across, layout.features // (down * across)))
    return {
        "image": image.clip(0, 255).astype(np.uint8),
        "weights": weights.astype(np.float32),
        "bias": np.array(-0.25, np.float32),
        "clip": np.array(layout.clip, np.float32),
    }


def largest_difference(files: dict[str, bytes], layout: hog_svm.Layout) -> float:
    """Return the largest difference of the graphs' scores from torch's, over several picture and window sizes."""
    sessions = {name: open_session(content) for name, content in files.items()}

    def run(name: str, given: dict[str, np.ndarray]) -> np.ndarray:
        wanted = [entry.name for entry in sessions[name].get_inputs()]
        (found,) = sessions[name].run(None, {entry: given[entry] for entry in wanted})
        return found

    worst, step = 0.0, layout.stride
    cases = ((0, 0), 0, 3), ((1, 3 * step), 0, 1), ((5 * step, 2), 1, 3), ((87, 190), 2, 3)
    for seed, (spare, wider, channels) in enumerate(cases, 1):
        window = (layout.window[0] + wider * step, layout.window[1])
        other = hog_svm.Layout(window, *tuple(vars(layout).values())[1:])
        given = example(other, spare, channels, seed)
        bordered = torch.from_numpy(given["image"]).permute(2, 0, 1)[None].float()
        dx, dy = hog_svm.gradient(bordered, layout.gamma)
        magnitude = torch.sqrt(dx * dx + dy * dy)
        turn = 2 * math.pi if layout.signed else math.pi
        angle = (hog_svm.angle(dx, dy, layout) + 0.5) * (turn / layout.bins)
        given["polar"] = torch.cat([magnitude, magnitude * angle], 1).numpy()
        weights, bias = torch.from_numpy(given["weights"]), torch.from_numpy(given["bias"])
        wanted = hog_svm.svm_scores(hog_svm.hog(bordered, other), weights, bias)[0].numpy()
        given["histograms"] = run("people_histograms.onnx", given)
        for name in ("people_scores.onnx", "people.onnx"):
            found = run(name, given)
            if found.shape != wanted.shape:
                return float("inf")
            worst = max(worst, float(np.abs(found - wanted).max()))
    return worst
