"""The graphs that solve plane homographies; all in float64, for any batch B and n landmarks.

    homography.onnx      ground (B, n, 2), image (B, n, 2), weight (B, n) -> matrix (B, 3, 3), valid (B,): `fit`
    homography_raw.onnx  ground, image -> matrix, valid: `fit_raw`, the source's system as printed

ONNX Runtime takes about 0.6 us for a node of so small a size, whatever it does. Eliminating eight unknowns one by one
with row exchange, as in the second graph, takes 141 nodes; the first eliminates them by blocks, in 46. The equations
of u and of v have the same 3 x 3 matrix of the ground's moments for their own three unknowns: this goes first, and
leaves 2 x 2 equations for the two unknowns that they share. Both blocks are symmetric and positive definite, where
elimination is as exact in one order of the rows as in any other; so there is no row to exchange. What decides validity
is the same as in `fit`, measured on the blocks: it differs where landmarks lie on one line but for a thousandth.
"""

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import TensorProto

from torchvision_dddas.export.checked import Check, Made
from torchvision_dddas.export.graph_builder import Graph
from torchvision_dddas.functional import homography

ABOUT = {
    "homography.onnx": "weighted least-squares homographies of sets of landmarks",
    "homography_raw.onnx": "the same as the source prints it: no weights, no normalisation",
}
TOLERANCE_PX = 1e-6
SINGULAR = 1e-10  # smallest share of a block's trace, before what x, y, 1 explain, for its smaller eigenvalue
UNKNOWNS = 8


def made() -> dict[str, Made]:
    """The files by their names, compared with torch."""
    files = graphs()
    check = Check("px", largest_difference(files), TOLERANCE_PX)
    return {name: Made(content, ABOUT[name], "ops.homography", {}, (check,)) for name, content in files.items()}


# The nine products of (x, y, 1) with (u, v, 1): of each, which of the first and which of the second.
MONOMIALS = {"x": (0, 2), "y": (1, 2), "1": (2, 2), "ux": (0, 0), "uy": (1, 0), "vx": (0, 1), "vy": (1, 1)} | {
    "u": (2, 0),
    "v": (2, 1),
}
COLUMN = {name: place for place, name in enumerate(MONOMIALS)}


# --------------------------------------------------------------------------------------------------------------------
# `fit`.


def plane(graph: Graph) -> None:
    """Weighted least squares by blocks. Quantities of a set of landmarks are (B, 9, 9), over pairs of monomials."""
    share = graph("LpNormalization", graph("Unsqueeze", "weight", graph.whole(1)), axis=-1, p=1)
    ground, image = (
        graph("Pad", name, graph.whole(0, 0, 0, 0, 0, 1), constant(graph, 1.0)) for name in ("ground", "image")
    )
    # Centred (x, y, 1), repeated as the monomials want them: a matrix of the mean does both. The image's offset costs
    # no digits that matter, as it is not larger than some thousand pixels.
    mean = graph("MatMul", share, ground)
    centring = graph("Reshape", graph("MatMul", mean, constant(graph, centred())), graph.whole(-1, 3, 9))
    of_image = np.zeros((3, 9))
    of_image[[second for _, second in MONOMIALS.values()], range(9)] = 1
    columns = graph("Mul", graph("MatMul", ground, centring), graph("MatMul", image, constant(graph, of_image)))
    weighted = graph("Mul", graph("Transpose", columns, perm=[0, 2, 1]), share)
    moments = graph("MatMul", weighted, columns)

    # First block: x, y, 1. Centred, it is (xx, xy; xy, yy) and 1 apart; its inverse is the adjugate by the determinant.
    turn = np.zeros((9, 9))
    turn[0, 1], turn[1, 0] = 1, -1
    adjugate = graph("MatMul", graph("MatMul", constant(graph, turn), moments), constant(graph, turn.T))
    twice = graph("ReduceSum", graph("Mul", moments, adjugate), graph.whole(1, 2))
    half = graph("Div", adjugate, twice)
    last = np.zeros((9, 9))
    last[2, 2] = 1
    inverse = graph("Sum", half, half, constant(graph, last))
    # Of every monomial the coefficients of its own fit by x, y, 1; and the moments of what that fit leaves.
    fitted = graph("MatMul", inverse, moments)
    left = graph("Sub", moments, graph("MatMul", moments, fitted))

    # Second block: what is left of u x and v x, u y and v y, by what is left of u and v. All by the determinant, which
    # cancels in the end.
    both = graph("Reshape", graph("Concat", left, moments, axis=1), graph.whole(-1, 1, 162))
    first, second, signs = products()
    pairs = graph("Mul", graph("MatMul", both, constant(graph, first)), graph("MatMul", both, constant(graph, second)))
    found = graph("MatMul", pairs, constant(graph, signs))  # p, q, 1 (times the determinant), how regular it is

    # u (p x + q y + 1) and v (...) are sums of monomials, of which all coefficients are known.
    numerators = graph("Reshape", graph("MatMul", found, constant(graph, numerator())), graph.whole(-1, 9, 3))
    centred_matrix = graph("MatMul", fitted, numerators)
    matrix = graph("Transpose", graph("MatMul", centring, centred_matrix), perm=[0, 2, 1])
    corner = graph("Slice", matrix, graph.whole(2, 2), graph.whole(3, 3), graph.whole(1, 2))

    # What must not be negative: the depths of the points (of weight 0: always 0), and the regularity. A negative
    # square root is NaN, which no comparison passes. Scaled by 1e-10, the sum of roots is also what h33 must exceed.
    depth = np.zeros((4, 9))
    depth[[0, 1, 2], [COLUMN["x"], COLUMN["y"], COLUMN["1"]]] = 1, 1, 1 - homography.HORIZON
    depths = graph("MatMul", graph("MatMul", found, constant(graph, 1e-10 * depth)), weighted)
    regular = graph("Slice", found, graph.whole(3), graph.whole(4), graph.whole(2))
    roots = graph("Sqrt", graph("Concat", depths, regular, axis=2))
    enough = graph("Sqrt", graph("Abs", corner))
    valid = graph("GreaterOrEqual", enough, graph("ReduceSum", roots, graph.whole(2)))
    graph("Where", valid, graph("Div", matrix, corner), constant(graph, np.eye(3)), out="matrix")
    graph("Reshape", valid, graph.whole(-1), out="valid")


def centred() -> np.ndarray:
    """(3, 27): from the mean (x, y, 1) to the matrix (3, 9) that takes (x, y, 1) to the ground's part of monomials."""
    matrix = np.zeros((3, 3, 9))
    for column, (part, _) in enumerate(MONOMIALS.values()):
        matrix[2, part, column] = 1
        if part < 2:
            matrix[part, 2, column] = -1
    return matrix.reshape(3, 27)


def products() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Factors of products (162, 8), twice, and what the products add up to (8, 4): Cramer's rule of the second block.

    Factors are sums of elements of two matrices of moments: of what the first block leaves, and of all.
    """

    def element(first: str, second: str, whole: bool = False) -> np.ndarray:
        chosen = np.zeros((2, 9, 9))
        for axis in "uv":
            chosen[int(whole), COLUMN[axis + first], COLUMN[axis + second]] += 1
        return chosen.ravel()

    xx, xy, yy = element("x", "x"), element("x", "y"), element("y", "y")
    x, y = element("x", ""), element("y", "")
    trace = element("x", "x", whole=True) + element("y", "y", whole=True)
    terms = [
        (yy, x, (-1, 0, 0, 0)),
        (xy, y, (1, 0, 0, 0)),
        (xx, y, (0, -1, 0, 0)),
        (xy, x, (0, 1, 0, 0)),
        (xx, yy, (0, 0, 1, 1e-10)),
        (xy, xy, (0, 0, -1, -1e-10)),
        (xx + yy, trace, (0, 0, 0, -1e-10 * SINGULAR)),
        # Of three landmarks nothing is left but rounding, whose trace may be negative.
        (trace, trace, (0, 0, 0, -1e-10 * SINGULAR**2)),
    ]
    first, second, signs = (np.array(part, float) for part in zip(*terms, strict=True))
    return first.T, second.T, signs


def numerator() -> np.ndarray:
    """(4, 27): from p, q, 1 to the coefficients of monomials (9, 3) in u and v times the depth, and in the depth."""
    matrix = np.zeros((4, 9, 3))
    for row, axis in enumerate(("u", "v", "")):
        for place, name in enumerate(("x", "y", "")):
            matrix[place, COLUMN[axis + name or "1"], row] = 1
    return matrix.reshape(4, 27)


# --------------------------------------------------------------------------------------------------------------------
# `fit_raw`.


def raw(graph: Graph) -> None:
    """A m = k of four landmarks, AᵀA m = Aᵀk of more, by Gaussian elimination with row exchange."""
    ground, image = (
        graph("Pad", name, graph.whole(0, 0, 0, 0, 0, 1), constant(graph, 1.0)) for name in ("ground", "image")
    )
    rows = []
    for axis in range(2):
        # Columns of `ops.homography.fit_raw`, k the ninth: each a coordinate of the ground by one of the image.
        on_ground, on_image = np.zeros((3, 9)), np.zeros((3, 9))
        for part in range(3):
            on_ground[part, 3 * axis + part] = on_image[2, 3 * axis + part] = 1
            on_ground[part, 6 + part] = 1
            on_image[axis, 6 + part] = -1 if part < 2 else 1
        parts = (
            graph("MatMul", name, constant(graph, held)) for name, held in ((ground, on_ground), (image, on_image))
        )
        rows.append(graph("Mul", *parts))
    system = graph("Concat", *rows, axis=1)
    transposed = graph("Transpose", graph.cut(system, 2, 0, UNKNOWNS), perm=[0, 2, 1])
    normal = graph("MatMul", transposed, system)
    four = graph("Equal", graph("Shape", "ground", start=1, end=2), graph.whole(homography.SAMPLE_SIZE))
    joined = graph("If", four, then_branch=branch(system), else_branch=branch(normal))

    # Rows stay where they are: which row served which unknown is noted, and rows that served are not asked again.
    place, free = graph.constant(np.arange(UNKNOWNS).reshape(1, -1, 1)), constant(graph, np.ones((1, UNKNOWNS, 1)))
    nothing = constant(graph, 0.0)
    served, pivots = [], []
    for k in range(UNKNOWNS):
        column = graph.cut(joined, 2, k, k + 1)
        largest = graph("ArgMax", graph("Mul", graph("Abs", column), free), axis=1, keepdims=1)
        chosen = graph("Cast", graph("Equal", largest, place), to=TensorProto.DOUBLE)
        row = graph("ReduceSum", graph("Mul", joined, chosen), graph.whole(1))
        pivots.append(graph.cut(row, 2, k, k + 1))
        unit = graph("Div", row, pivots[-1])
        # Less 1 in its own row: subtracting leaves the scaled row there, as in `ops.linear.solve`.
        joined = graph("Sub", joined, graph("Mul", graph("Sub", column, chosen), unit))
        free = graph("Sub", free, chosen)
        served.append(chosen)
    order = graph("Transpose", graph("Concat", *served, axis=2), perm=[0, 2, 1])
    solution = graph("MatMul", order, graph.cut(joined, 2, UNKNOWNS, UNKNOWNS + 1))

    # Zero times what is not finite is NaN, which no comparison passes.
    numbers = graph("ReduceSum", graph("Mul", solution, nothing), graph.whole(1))
    smallest = graph("ReduceMin", graph("Abs", graph("Concat", *pivots, axis=2)), graph.whole(2))
    valid = graph("Greater", smallest, numbers)
    matrix = graph("Pad", solution, graph.whole(0, 0, 0, 0, 1, 0), constant(graph, 1.0))
    matrix = graph("Reshape", matrix, graph.whole(-1, 3, 3))
    graph("Where", valid, matrix, constant(graph, np.eye(3)), out="matrix")
    graph("Reshape", valid, graph.whole(-1), out="valid")


def branch(system: str) -> onnx.GraphProto:
    """What one of the two cases goes on with."""
    name = f"{system}_chosen"
    result = onnx.helper.make_tensor_value_info(name, TensorProto.DOUBLE, None)
    return onnx.helper.make_graph([onnx.helper.make_node("Identity", [system], [name])], name, [], [result])


def constant(graph: Graph, values: np.ndarray | float) -> str:
    """In float64."""
    return graph.constant(np.asarray(values, np.float64))


# --------------------------------------------------------------------------------------------------------------------
# Checking them.


def graphs() -> dict[str, bytes]:
    """Files by their names."""
    points = {name: (TensorProto.DOUBLE, ["B", "n", 2]) for name in ("ground", "image")}
    weight = {"weight": (TensorProto.DOUBLE, ["B", "n"])}
    outputs = {"matrix": (TensorProto.DOUBLE, ["B", 3, 3]), "valid": (TensorProto.BOOL, ["B"])}
    fit, fit_raw = Graph(), Graph()
    plane(fit)
    raw(fit_raw)
    return dict(
        zip(
            ABOUT,
            (
                fit.model({**points, **weight}, outputs, {}, "homography"),
                fit_raw.model(points, outputs, {}, "homography_raw"),
            ),
            strict=True,
        )
    )


def example(count: int, sets: int, seed: int, noise_px: float = 1.0) -> dict[str, np.ndarray]:
    """Landmarks about places some km from the origin, as cameras 50 to 200 m away see them, tilted up to 50 degrees."""
    rng = np.random.default_rng(seed)
    turn, tilt = rng.uniform(0, 2 * np.pi, sets), rng.uniform(0, np.radians(50), sets)
    sin, cos = np.sin(turn), np.cos(turn)
    forward = np.stack([np.sin(tilt) * sin, np.sin(tilt) * cos, -np.cos(tilt)], 1)
    right = np.stack([cos, -sin, np.zeros(sets)], 1)
    axes = np.stack([right, np.cross(forward, right), forward], 1)
    around = np.linspace(0, 2 * np.pi, count, endpoint=False) + rng.uniform(-0.3, 0.3, (sets, count))
    spread = rng.uniform(9, 13, (sets, count, 1)) * np.stack([np.sin(around), np.cos(around)], 2)
    away = rng.uniform(50, 200, (sets, 1, 1)) * forward[:, None]
    seen = (np.pad(spread, ((0, 0), (0, 0), (0, 1))) + away) @ axes.swapaxes(1, 2)
    image = 1370 * seen[..., :2] / seen[..., 2:] + (959.5, 539.5) + noise_px * rng.normal(size=(sets, count, 2))
    weight = rng.uniform(0.1, 1, (sets, count))
    weight[:, 4:] *= rng.random((sets, max(0, count - 4))) > 0.2
    return {"ground": spread + rng.uniform(-3000, 3000, (sets, 1, 2)), "image": image, "weight": weight}


def largest_difference(files: dict[str, bytes]) -> float:
    """Between the places in the picture by the graphs and by torch, over sets of landmarks of all sizes, in px."""
    sessions = [onnxruntime.InferenceSession(files[name], providers=["CPUExecutionProvider"]) for name in ABOUT]
    worst = 0.0
    for count in range(4, 17):
        given = example(count, 50, count)
        # The source's own system is compared where it has digits to compare: about the origin, in units of 10 m.
        near = {"ground": (given["ground"] - given["ground"][:, :1]) / 10, "image": given["image"] / 500 - 1}
        fit, fit_raw = ([torch.from_numpy(array) for array in held.values()] for held in (given, near))
        results = homography.fit(*fit), homography.fit_raw(*fit_raw)
        for session, held, (wanted, valid), unit in zip(sessions, (given, near), results, (1, 500), strict=True):
            matrix, found_valid = session.run(None, held)
            if not (found_valid.all() and valid.all()):
                return float("inf")
            points = torch.from_numpy(held["ground"])
            there = homography.transfer(torch.from_numpy(matrix), points) - homography.transfer(wanted, points)
            worst = max(worst, unit * there.abs().max().item())
    return worst
