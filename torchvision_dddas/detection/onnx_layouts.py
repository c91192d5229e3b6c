"""The outputs of detection networks: the usual exports of YOLO and DETR, recognized by their names and shapes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from torchvision_dddas.errors import InputError

Size = tuple[int, int]
"""(width, height) of the network's input, px."""

_STRIDES = ((8, 16, 32), (4, 8, 16, 32), (8, 16, 32, 64), (16, 32))
"""Strides of the grids of YOLO networks: usual networks, networks with P2, networks with P6, tiny networks."""

# Mean and standard deviation of ImageNet's channels.
_MEAN, _SPREAD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)

# Raw outputs of YOLOX, in cells and logarithms, are smaller than this; boxes in pixels reach over the picture.
_MOST_RAW = 20.0

LAYOUTS = (
    "YOLOv5 (1, N, 5+C), YOLOv8 to 12 (1, 4+C, N), YOLO that needs no NMS (1, N, 6), YOLOX (1, N, 5+C), DETR and "
    "RT-DETR of transformers (logits, pred_boxes), RT-DETR and D-FINE (labels, boxes, scores), RF-DETR (dets, labels)"
)


class Found(NamedTuple):
    """The boxes that a network found.

    corners_px: (N, 4) left, top, right, bottom in its input. score: (N,) in [0, 1]. number: (N,) of the class.
    """

    corners_px: np.ndarray
    score: np.ndarray
    number: np.ndarray


Outputs = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class OutputLayout:
    """How a network wants its picture, and how its outputs become boxes.

    fit: the picture keeps its shape in the middle (centre) or at the top left (corner) of a grey input, or is stretched
    over it. mean, spread: normalization of the input's three channels, in grey levels. overlap: drop the worse of two
    boxes of a class with a larger IoU; 1 for networks that do this. classes: their number; 0 if unknown.
    """

    name: str
    decode: Callable[[Outputs, Size], Found]
    classes: int = 0
    fit: str = "stretch"
    overlap: float = 1.0
    is_rgb: bool = True
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    spread: tuple[float, ...] = (255.0, 255.0, 255.0)


def tell_layout(
    outputs: Outputs, size: Size, is_final: bool, names: int = 0, softmax: bool | None = None
) -> OutputLayout:
    """Tell the layout from the outputs of a network for a grey picture.

    is_final: whether the network takes the size of the picture and gives boxes in its pixels. names: number of classes
    that the file names. softmax: whether the last class of a DETR is "no object"; None: yes if it has 100 queries, as
    the first DETR has. Raise InputError for an unknown layout.
    """
    shapes = {name: values.shape for name, values in outputs.items()}
    if {"logits", "pred_boxes"} <= shapes.keys():
        _, queries, classes = shapes["logits"]
        if queries == 100 if softmax is None else softmax:
            decode = partial(_decode_queries, "logits", "pred_boxes", True)
            return OutputLayout("DETR", decode, classes - 1, mean=_MEAN, spread=_SPREAD)
        return OutputLayout("RT-DETR", partial(_decode_queries, "logits", "pred_boxes", False), classes)
    if {"labels", "boxes", "scores"} <= shapes.keys() and is_final:
        return OutputLayout("D-FINE", lambda given, _: Found(given["boxes"][0], given["scores"][0], given["labels"][0]))
    if len(shapes.get("labels", ())) == 3 and shapes.get("dets", ())[2:] == (4,):
        return OutputLayout("RF-DETR", partial(_decode_queries, "labels", "dets", False), mean=_MEAN, spread=_SPREAD)
    tables = [name for name, shape in shapes.items() if len(shape) == 3 and shape[0] == 1]
    masks = sum(shape[1] for shape in shapes.values() if len(shape) == 4)
    if len(tables) == 1 and (layout := _tell_yolo(tables[0], outputs[tables[0]], size, names, masks)) is not None:
        return layout
    shown = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
    raise InputError(
        f"the network's outputs for a picture of {size[0]}x{size[1]} px are {shown}; wanted {LAYOUTS}. Wrap another "
        "network in a function: td.Pipeline(detector=f)"
    )


def _tell_yolo(key: str, table: np.ndarray, size: Size, names: int, masks: int) -> OutputLayout | None:
    """Return the layout of a single table. names: number of classes; it tells classes from keypoints.

    masks: number of coefficients of masks, which follow the classes; 0 for a network without masks.
    """
    _, rows, columns = table.shape
    cells = [sum((size[0] // s) * (size[1] // s) for s in strides) for strides in _STRIDES]
    is_turned = columns in cells and rows > 4
    classes = rows - 4 if is_turned else columns - 5
    classes -= masks if masks < classes else 0
    classes = names if 0 < names < classes else classes
    if is_turned:
        return OutputLayout("YOLOv8", lambda given, _: _best(given[key][0].T, 4, classes), classes, "centre", 0.7)
    if columns > 5 and rows in cells:
        is_raw = np.abs(table[..., :4]).max() < _MOST_RAW
        if is_raw or (table[..., 4] != 1).any():
            strides = _STRIDES[cells.index(rows)] if is_raw else ()
            decode = partial(_decode_grid, key, strides, classes)
            return OutputLayout("YOLOX", decode, classes, "corner", 0.45, is_rgb=False, spread=(1.0, 1.0, 1.0))
    if columns > 5 and rows in [*cells, *(3 * count for count in cells)]:  # YOLOv6 has one box a cell, YOLOv5 three
        name = "YOLOv6" if rows in cells else "YOLOv5"
        return OutputLayout(name, lambda given, _: _best(given[key][0], 5, classes), classes, "centre", 0.45)
    if columns == 6:
        return OutputLayout(
            "YOLO without NMS", lambda given, _: Found(*np.split(given[key][0], [4, 5], 1)), 0, "centre"
        )
    return None


def _best(table: np.ndarray, first: int, classes: int) -> Found:
    """Return the likeliest class of each row. Columns: centre, size, objectness (only if `first` is 5), classes."""
    share = table[:, first : first + classes] * (table[:, 4:5] if first == 5 else 1.0)
    return Found(_corners(table[:, :4]), share.max(axis=1), share.argmax(axis=1))


def _corners(box: np.ndarray) -> np.ndarray:
    return np.concatenate([box[:, :2] - box[:, 2:] / 2, box[:, :2] + box[:, 2:] / 2], axis=1)


def _decode_grid(key: str, strides: Sequence[int], classes: int, given: Outputs, size: Size) -> Found:
    """Decode one row per cell of the strides; no strides: rows are in pixels. Source: YOLOX, `demo_postprocess`."""
    table, start = given[key][0].copy(), 0
    for stride in strides:
        down, across = np.mgrid[: size[1] // stride, : size[0] // stride]
        rows = slice(start, start := start + across.size)
        table[rows, :2] = (table[rows, :2] + np.stack([across.ravel(), down.ravel()], axis=1)) * stride
        table[rows, 2:4] = np.exp(table[rows, 2:4]) * stride
    return _best(table, 5, classes)


def _decode_queries(logits: str, boxes: str, softmax: bool, given: Outputs, size: Size) -> Found:
    """Decode boxes that are shares of the picture. softmax: classes exclude each other, the last is "no object"."""
    logit = given[logits][0]
    share = 1 / (1 + np.exp(-logit))
    if softmax:
        odds = np.exp(logit - logit.max(axis=1, keepdims=True))
        share = (odds / odds.sum(axis=1, keepdims=True))[:, :-1]
    return Found(_corners(given[boxes][0]) * (*size, *size), share.max(axis=1), share.argmax(axis=1))
