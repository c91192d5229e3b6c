"""A detection network in an ONNX file, as the detector of a pipeline. `OnnxDetector` needs neither torch nor a GPU."""

import ast
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.detection.onnx_layouts import OutputLayout, Size, tell_layout
from torchvision_dddas.errors import InputError
from torchvision_dddas.runtime import open_session
from torchvision_dddas.types import Detections, Frame, as_picture

_GREY = 114  # grey level around the picture, as in the training of YOLO
_USUAL_PX, _STRIDE = 640, 32  # default size of an input with free sides
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
_MOST_BOXES = 1000  # keep at most this number of boxes a frame, the likeliest


class OnnxDetector:
    """Finds what a detection network was trained to find. Call it with a frame; it returns Detections.

    >>> for result in td.Pipeline(detector=td.OnnxDetector("yolo11n.onnx"))("clip.mp4"):  # doctest: +SKIP
    ...     print(result.tracks.label)

    layout: layout of its outputs. size_px: (width, height) of its input. names: the classes by number. notes:
    assumptions, such as classes without names. delay_frames: frames between a picture and its result, always 0.
    """

    delay_frames = 0

    def __init__(
        self,
        path: str | Path,
        *,
        provider: str = "cpu",
        score: float = 0.25,
        classes: Sequence[str] | str | Path | None = None,
    ) -> None:
        """path: the ONNX file. provider: cpu, cuda, openvino or another that the installed ONNX Runtime has.

        score: boxes below it are left out. classes: names in the order of their numbers, or a text file with a name a
        line; None: take the names of the file, or of the config.json beside it.
        Raises InputError for a file that ONNX Runtime cannot open, inputs or outputs of an unknown layout, a missing
        provider, or a number of names that differs from the number of classes.
        """
        self.path, self.notes = Path(path), list[str]()
        if not 0 <= score <= 1:
            raise InputError(f"score must be in [0, 1], got {score:g}")
        if not self.path.is_file():
            raise InputError(f"the detector {path} is no file; wanted a network in an ONNX file")
        self.provider, self._score = provider, score
        self._session = open_session(str(path), self.path, provider)
        self._inputs = {given.name: given for given in self._session.get_inputs()}
        self._image = self._find_image()
        self._outputs = [output.name for output in self._session.get_outputs()]
        metadata = self._session.get_modelmeta().custom_metadata_map
        # Another config.json may lie beside a YOLO.
        beside = _read_beside(self.path) if "pred_boxes" in self._outputs else {}
        self.names = _known_names(metadata, beside)
        self.size_px = self._choose_size(metadata, beside)
        self.layout = self._tell_layout(metadata, beside)
        is_free = not all(isinstance(side, int) for side in self._inputs[self._image].shape[2:])
        self._adapts = is_free and (self.layout.fit != "stretch" or "longest_edge" in str(beside.get("size")))
        if classes is not None:
            self.names = _read_names(classes)
            if self.layout.classes not in (0, len(self.names)):
                raise InputError(f"{path} has {self.layout.classes} classes, and {len(self.names)} names were given")
        if not self.names:
            self.notes.append(f"{self.path.name} names no classes: they are numbers, unless --classes FILE is given")

    @property
    def facts(self) -> dict[str, Any]:
        """The detector as run.json records it."""
        facts = {"file": str(self.path), "layout": self.layout.name, "size_px": self.size_px, "score": self._score}
        return {**facts, "provider": self.provider, "classes": list(self.names.values())}

    def __call__(self, frame: Frame | np.ndarray) -> Detections:
        """Return the boxes of a frame, best first, with the names and numbers of their classes."""
        image = as_picture(frame.image if isinstance(frame, Frame) else frame)
        size = image.shape[1], image.shape[0]
        fitted = self._adapt_size(size) if self._adapts else self.size_px
        blob, scale, offset = fit_picture(image, fitted, self.layout)
        found = self.layout.decode(self._run(blob), fitted)
        corners = (found.corners_px.astype(float) - [*offset, *offset]) / [*scale, *scale]
        corners = np.clip(corners, 0, [*size, *size])
        score, number = np.ravel(found.score).astype(float), np.ravel(found.number).astype(np.int64)
        keep = (score >= self._score) & (corners[:, 2:] > corners[:, :2]).all(axis=1)
        rows = np.flatnonzero(keep)[np.argsort(-score[keep], kind="stable")][:_MOST_BOXES]
        box = np.concatenate([corners[rows, :2], corners[rows, 2:] - corners[rows, :2]], axis=1)
        if self.layout.overlap < 1 and len(rows):
            # OpenCV drops scores that equal its threshold, and returns () for no box, which would select every row.
            found_best = cv2.dnn.NMSBoxesBatched(box, score[rows], number[rows], 0.0, self.layout.overlap)  # type: ignore[arg-type]
            best = np.array(found_best, np.intp).ravel()
            rows, box = rows[best], box[best]
        score, number = np.clip(score[rows], 0, 1), number[rows]
        label = np.array([self.names.get(k, str(k)) for k in number.tolist()], object)
        return Detections(box, score, box[:, 2:].prod(axis=1), kind="given", label=label, class_id=number)

    def _find_image(self) -> str:
        """Return the name of the input that takes the picture. Raise InputError if no input does."""
        for name, given in self._inputs.items():
            if len(given.shape) == 4 and given.type in _TYPES and _fixed(given.shape[:2], (1, 3)) == [1, 3]:
                return name
        shown = ", ".join(f"{name} {given.type} {given.shape}" for name, given in self._inputs.items())
        raise InputError(f"{self.path} takes {shown}; wanted one picture, float32 or float16 of shape (1, 3, H, W)")

    def _choose_size(self, metadata: Mapping[str, str], beside: Mapping[str, Any]) -> Size:
        """Return the size of the input. A free side gets its size in training, or _USUAL_PX if it is unknown."""
        trained = _literal(metadata.get("imgsz"))
        if not isinstance(trained, list | tuple) or len(trained) != 2:
            given = beside["size"] if isinstance(beside.get("size"), dict) else {}
            trained = [given.get(side, given.get("longest_edge", _USUAL_PX)) for side in ("height", "width")]
        height, width = _fixed(self._inputs[self._image].shape[2:], trained)
        return width, height

    def _adapt_size(self, size: Size) -> Size:
        """Return the input size for a picture: the training size or less, rounded up to multiples of _STRIDE."""
        ratio = min(self.size_px[0] / size[0], self.size_px[1] / size[1])
        width, height = (-(-round(side * ratio) // _STRIDE) * _STRIDE for side in size)
        return width, height

    def _tell_layout(self, metadata: Mapping[str, str], beside: Mapping[str, Any]) -> OutputLayout:
        """Return the layout of the outputs by a run on a grey picture. Raise InputError as `tell_layout` does."""
        task = metadata.get("task", "detect")
        if task not in ("detect", "segment", "pose"):
            raise InputError(f"{self.path} is a network for '{task}'; wanted one that detects boxes")
        blank = np.full((1, 3, *self.size_px[::-1]), 0.5)
        kind = beside.get("model_type")
        softmax = None if kind is None else kind in ("detr", "yolos", "table-transformer")
        is_final = "orig_target_sizes" in self._inputs
        # Only classes follow the boxes of a network for `detect`. A list of names that is too short must not hide any.
        names = 0 if metadata.get("task") == "detect" else len(self.names)
        layout = tell_layout(self._run(blank), self.size_px, is_final, names, softmax)
        if self.names and layout.classes > len(self.names):
            self.notes.append(
                f"{self.path.name} names {len(self.names)} of {layout.classes} classes; others are numbers"
            )
        if "pred_boxes" not in self._outputs:
            return layout
        if kind is None:
            self.notes.append(f"no config.json lies beside {self.path.name}: it is taken for a {layout.name}")
        elif "image_mean" in beside:
            is_normal = beside.get("do_normalize", True)
            mean, spread = (beside["image_mean"], beside["image_std"]) if is_normal else ([0.0] * 3, [1.0] * 3)
            layout = replace(layout, mean=tuple(255 * m for m in mean), spread=tuple(255 * s for s in spread))
        return layout

    def _run(self, blob: np.ndarray) -> dict[str, np.ndarray]:
        """Return the outputs for a picture (1, 3, H, W), in float32."""
        given = {self._image: blob.astype(_TYPES[self._inputs[self._image].type])}
        for name, other in self._inputs.items():
            if name == "orig_target_sizes":
                given[name] = np.array([blob.shape[:1:-1]], np.int64)
            elif name == "pixel_mask":
                given[name] = np.ones((1, *_fixed(other.shape[-2:], blob.shape[2:])), np.int64)
        try:
            outputs = self._session.run(self._outputs, given)
        except Exception as error:  # as in `open_session`
            raise InputError(f"ONNX Runtime cannot run {self.path}: {str(error).splitlines()[0]}") from None
        return {name: np.asarray(values, np.float32) for name, values in zip(self._outputs, outputs, strict=True)}


def fit_picture(image: np.ndarray, size: Size, layout: OutputLayout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a network's input (1, 3, H, W) for a picture, and the scale (2,) and offset (2,) from picture to input.

    The point (x, y) of the picture lies at scale * (x, y) + offset of the input, in pixels from the outer corner.
    """
    whole, wanted = np.array(image.shape[1::-1]), np.array(size)
    inner = wanted
    if layout.fit != "stretch":
        inner = np.maximum(1, np.round(whole * (wanted / whole).min())).astype(int)
    offset = (wanted - inner) // 2 if layout.fit == "centre" else np.zeros(2, int)
    # YOLO is trained on pictures that OpenCV reduced linearly. Other networks are trained on smoothly reduced pictures.
    way = cv2.INTER_AREA if layout.fit == "stretch" and (inner < whole).all() else cv2.INTER_LINEAR
    colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
    canvas = np.full((size[1], size[0], 3), _GREY, np.uint8)
    (x, y), (width, height) = offset, inner
    canvas[y : y + height, x : x + width] = cv2.resize(colour, (int(width), int(height)), interpolation=way)
    levels = canvas[..., ::-1] if layout.is_rgb else canvas
    blob = (levels - np.array(layout.mean, np.float32)) / np.array(layout.spread, np.float32)
    return blob.transpose(2, 0, 1)[None], inner / whole, offset


def _fixed(sides: Sequence[Any], otherwise: Sequence[Any]) -> list[int]:
    """Return the sides of an input. Free sides are replaced by the sides in `otherwise`."""
    return [side if isinstance(side, int) else int(other) for side, other in zip(sides, otherwise, strict=True)]


def _literal(text: str | None) -> Any:
    try:
        return ast.literal_eval(text or "None")
    except (ValueError, SyntaxError):
        return None


def _known_names(metadata: Mapping[str, str], beside: Mapping[str, Any]) -> dict[int, str]:
    """Return the class names from the file's metadata (ultralytics) or from a config.json (transformers)."""
    given = _literal(metadata.get("names")) or beside.get("id2label")
    pairs = given.items() if isinstance(given, dict) else enumerate(given if isinstance(given, list) else ())
    return {int(number): str(name) for number, name in pairs if str(number).isdecimal()}


def _read_names(given: Sequence[str] | str | Path) -> dict[int, str]:
    """Return the names of a sequence or a text file. Raise InputError if the file cannot be read or is empty."""
    if not isinstance(given, str | Path):
        return dict(enumerate(map(str, given)))
    try:
        names = Path(given).read_text("utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise InputError(f"the classes {given} cannot be read: {getattr(error, 'strerror', error)}") from None
    if not any(names):
        raise InputError(f"the classes {given} are empty; wanted a name a line, in the order of their numbers")
    return {number: name.strip() for number, name in enumerate(names)}


def _read_beside(path: Path) -> dict[str, Any]:
    """Return config.json and preprocessor_config.json (transformers) from the file's folder or its parent folder."""
    content: dict[str, Any] = {}
    for name in ("config.json", "preprocessor_config.json"):
        file = next((f for f in (path.parent / name, path.parent.parent / name) if f.is_file()), None)
        if file is None:
            continue
        try:
            read = json.loads(file.read_text("utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{file}, which lies beside the detector, cannot be read: {error}") from None
        content |= read if isinstance(read, dict) else {}
    return content
