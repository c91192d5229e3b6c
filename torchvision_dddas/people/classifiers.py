"""Read linear SVMs: the shipped coefficients, or a user's file in text, NumPy or OpenCV format."""

import math
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO

import cv2
import numpy as np

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.types import LinearSvm

SHIPPED = {"opencv": Path(__file__).parents[1] / "models" / "opencv_people.txt"}

Layout = Mapping[str, object]
"""Layout of the descriptor that a classifier was trained on: some or all keys of `PeopleParameters.descriptor`."""

_PARAMETERS = {
    "window": "people.window_width_px and people.window_height_px",
    "cell": "people.cell_px",
    "block": "people.block_px",
    "stride": "people.block_stride_px",
    "bins": "people.bins",
    "signed": "people.signed",
    "clip": "people.clip",
    "gamma": "people.gamma",
}
_HOG_KEYS = {
    "window": "winSize",
    "cell": "cellSize",
    "block": "blockSize",
    "stride": "blockStride",
    "bins": "nbins",
    "signed": "signedGradient",
    "clip": "L2HysThreshold",
    "gamma": "gammaCorrection",
}
"""The keys of a HOGDescriptor that OpenCV saved."""
_MOST_NUMBERS = 1_000_000  # largest accepted array; descriptors have thousands of numbers
_LONGEST_HEADER = 10_000  # bytes of an array header; NumPy allocates memory before it refuses more
_MARK = re.compile(r"[\[{:]|<[^/!?]|-(?![\d.])")  # the start of a key, list, item or tag in a file that OpenCV saved
_MOST_MARKS = 10_000  # OpenCV crashes on parts that are nested more than twice as deep
_DIGITS = 1e-6  # tolerance of a comparison: files store a clip of 0.2 with different rounding


def read_classifier(name: str | Path, features: int, wanted: Layout | None = None) -> LinearSvm:
    """Read a classifier from a file, or a shipped classifier by its name.

    Files hold the weights, optionally followed by a bias. Formats: text (numbers separated by blanks, commas or lines;
    `#` begins a comment); .npy; .npz (weights, bias, and any of the keys of `PeopleParameters.descriptor`); and .yml,
    .yaml, .xml or .json saved by OpenCV (a HOGDescriptor with its SVMDetector, or a linear SVM of cv2.ml). features:
    length of the descriptor, which is the required number of weights. wanted: the descriptor in use; if the file states
    a descriptor, both must agree.
    Raises InputError if the file is missing or unreadable, or has another length, another descriptor or numbers that
    are not finite.
    """
    path = SHIPPED.get(str(name), Path(name))
    try:
        there = path.exists()
    except OSError as error:  # the name is too long, or the folder may not be entered
        raise InputError(f"classifier {str(name)[:200]} cannot be read: {error.strerror or error}") from None
    if not there:
        raise InputError(f"no classifier or file is named '{name}'; give {', '.join(SHIPPED)}, or a file")
    reader = _READERS.get(path.suffix.lower(), _read_text)
    try:
        numbers, stated = reader(path, features)
    except OSError as error:
        raise InputError(f"classifier {path} cannot be read: {error.strerror or error}") from None
    for name, parameter in _PARAMETERS.items():
        if wanted is not None and name in stated and name in wanted and not _is_same(stated[name], wanted[name]):
            raise InputError(
                f"classifier {path} was trained with a {name} of {_format(stated[name], wanted[name])}, but the "
                f"settings say {_format(wanted[name], wanted[name])}; change {parameter}"
            )
    return _svm(numbers, features, path)


def load_classifier(parameters: PeopleParameters) -> LinearSvm:
    """Read the classifier that the settings name. Raises InputError as `read_classifier` does."""
    return read_classifier(parameters.classifier, parameters.features, parameters.descriptor)


def _svm(numbers: np.ndarray, features: int, path: Path) -> LinearSvm:
    numbers = np.asarray(numbers)
    if numbers.dtype.kind not in "fiu":
        raise InputError(f"classifier {path} holds {numbers.dtype}; wanted numbers")
    with np.errstate(over="ignore"):
        numbers = numbers.ravel().astype(np.float32)
    if len(numbers) == 0:
        raise InputError(f"classifier {path} is empty; wanted {features} weights, or {features} weights and a bias")
    if len(numbers) not in (features, features + 1):
        raise InputError(
            f"classifier {path} has {len(numbers)} numbers; a descriptor of these settings has {features}, so "
            f"{features} weights, or these and a bias, were expected; set people.window_width_px, people.cell_px and "
            "the other descriptor parameters to the training layout"
        )
    if not np.isfinite(numbers).all():
        first = int(np.argmin(np.isfinite(numbers)))
        raise InputError(f"classifier {path}: number {first + 1} is {numbers[first]:g}; wanted finite numbers")
    return LinearSvm(numbers[:features], float(numbers[features:].sum()), str(path))


def _is_same(one: object, other: object) -> bool:
    a, b = np.ravel(np.asarray(one, float)), np.ravel(np.asarray(other, float))
    return a.shape == b.shape and bool((np.abs(a - b) <= _DIGITS).all())


def _format(value: object, like: object) -> str:
    if isinstance(like, bool):
        return "false" if _is_same(value, 0) else "true"
    return " x ".join(f"{number:g}" for number in np.ravel(np.asarray(value, float)))


def _read_text(path: Path, features: int) -> tuple[np.ndarray, Layout]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"classifier {path} is not text: {error.reason}; wanted numbers, .npy, .npz or .yml") from None
    numbers = []
    for place, line in enumerate(lines, 1):
        for cell in line.partition("#")[0].replace(",", " ").replace(";", " ").split():
            try:
                numbers.append(float(cell.replace("_", "?")))  # only Python reads 1_0 as a number, so refuse it
            except ValueError:
                raise InputError(f"classifier {path}, line {place}: '{cell[:40]}' is not a number") from None
            if not math.isfinite(numbers[-1]):
                raise InputError(f"classifier {path}, line {place}: '{cell}'; wanted finite numbers")
    return np.array(numbers, np.float64), {}


def _read_numpy(path: Path, features: int) -> tuple[np.ndarray, Layout]:
    try:
        with path.open("rb") as file:
            if file.read(2) != b"PK":
                return _read_array(file, path), {}
            with zipfile.ZipFile(file) as archive:
                held = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
                content = {}
                for name in ("weights", "bias", *_PARAMETERS):
                    if name in held:
                        with archive.open(f"{name}.npy") as member:
                            content[name] = _read_array(member, path)
    except (InputError, OSError):
        raise
    except (ValueError, EOFError, KeyError) as error:
        raise InputError(f"classifier {path} is not an array of numbers in NumPy's format: {error}") from None
    except Exception as error:  # zipfile and zlib raise their own classes for a broken archive
        raise InputError(f"classifier {path} is a broken file: {error}") from None
    if "weights" not in content:
        raise InputError(f"classifier {path} holds {', '.join(held[:9]) or 'no array'}; wanted weights (and bias)")
    parts = [np.ravel(content[name]) for name in ("weights", "bias") if name in content]
    if len(parts) == 2 and parts[1].size != 1:
        raise InputError(f"classifier {path} has a bias of {parts[1].size} numbers; wanted one")
    stated = {name: content[name] for name in _PARAMETERS if name in content}
    if text := [name for name, value in stated.items() if value.dtype.kind not in "fiub"]:
        raise InputError(f"classifier {path}: {text[0]} is of type {stated[text[0]].dtype}; wanted numbers")
    return np.concatenate(parts), stated


def _read_array(file: IO[bytes], path: Path) -> np.ndarray:
    """Read an array if its header announces at most _MOST_NUMBERS: NumPy would allocate memory for any header."""
    file.seek(0)
    start = file.read(12)
    length = int.from_bytes(start[8 : 10 if start[6:7] == b"\1" else 12], "little")
    if start.startswith(np.lib.format.MAGIC_PREFIX) and length > _LONGEST_HEADER:
        raise InputError(f"classifier {path} has a header of {length:,} bytes; wanted at most {_LONGEST_HEADER:,}")
    file.seek(0)
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = read(file)
    if math.prod(shape) * max(kind.itemsize // 16, 1) > _MOST_NUMBERS:
        sides = " x ".join(map(str, shape))
        raise InputError(f"classifier {path} announces {sides} numbers; wanted at most {_MOST_NUMBERS:,}")
    file.seek(0)
    found: np.ndarray = np.lib.format.read_array(file, allow_pickle=False)
    return found


def _read_opencv(path: Path, features: int) -> tuple[np.ndarray, Layout]:
    try:
        text = path.read_text(encoding="utf-8")
        if (count := sum(1 for _ in _MARK.finditer(text))) > _MOST_MARKS:
            raise InputError(
                f"classifier {path} has {count:,} keys, lists and items; wanted at most {_MOST_MARKS:,}, as in a "
                "HOGDescriptor with its SVMDetector, or a linear SVM of cv2.ml"
            )
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        top = storage.getFirstTopLevelNode()
        # The top-level node may be an SVM or a HOGDescriptor, whatever its name.
        inside = set(top.keys()) if not top.empty() and top.isMap() else set()
    except (UnicodeDecodeError, cv2.error, SystemError):
        raise InputError(f"classifier {path} is not a file that OpenCV saved (YAML, XML or JSON)") from None
    try:
        if "SVMDetector" in inside:
            values = {name: _numbers(top.getNode(key), 2).tolist() for name, key in _HOG_KEYS.items() if key in inside}
            # A layout has one number for square cells, blocks and strides.
            stated = {name: v if name == "window" or len(set(v)) > 1 else v[0] for name, v in values.items()}
            detector = top.getNode("SVMDetector")
            if detector.size() > features + 1:  # the caller reports its length; the numbers are not needed
                return np.full(detector.size(), np.nan), stated
            return _numbers(detector, features + 1), stated
        if "support_vectors" in inside:
            return _read_support_vectors(top, path, features), {}
    except InputError:
        raise
    except (ValueError, IndexError, cv2.error, SystemError):
        raise InputError(f"classifier {path} is a broken file: its parts do not fit together; save it again") from None
    raise InputError(
        f"classifier {path} has neither an SVMDetector (cv2.HOGDescriptor.save) nor the support vectors of cv2.ml"
    )


def _read_support_vectors(node: "cv2.FileNode", path: Path, features: int) -> np.ndarray:
    """Return the weights and the bias of a saved cv2.ml.SVM.

    The SVM computes alpha . K - rho. In a classification a positive value means the first label, which is the lower
    number. People have the second label, so the score is the negative of that value. In a regression the value is the
    label itself, and people have the higher label.
    """
    kind, kernel = node.getNode("svmType").string(), node.getNode("kernel").getNode("type").string()
    if kernel != "LINEAR":
        raise InputError(f"classifier {path} has the kernel {kernel or '(none)'}; wanted a linear SVM")
    vectors, functions = node.getNode("support_vectors"), node.getNode("decision_functions")
    sign = {"C_SVC": -1.0, "NU_SVC": -1.0, "EPS_SVR": 1.0, "NU_SVR": 1.0}.get(kind)
    if sign is None:
        raise InputError(
            f"classifier {path} is an SVM of type {kind or 'unknown'}; wanted C_SVC, NU_SVC or a regression"
        )
    if functions.size() != 1:
        raise InputError(f"classifier {path} has {functions.size()} decision functions; wanted one, of two classes")
    if vectors.size() > _MOST_MARKS:
        raise InputError(f"classifier {path} has {vectors.size():,} support vectors; wanted at most {_MOST_MARKS:,}")
    rows = np.array([_numbers(vectors.at(i), features + 1) for i in range(vectors.size())])
    function = functions.at(0)
    if lacking := [name for name in ("alpha", "rho") if function.getNode(name).empty()]:
        raise InputError(f"classifier {path} lacks {lacking[0]}, a part of its decision function; save it again")
    alpha, index = _numbers(function.getNode("alpha"), len(rows)), function.getNode("index")
    place = np.arange(len(rows)) if index.empty() else _numbers(index, len(rows))
    if not ((place >= 0) & (place < len(rows))).all():
        raise InputError(f"classifier {path} names support vectors that it does not hold; save it again")
    with np.errstate(over="ignore", invalid="ignore"):  # `_svm` refuses numbers that are not finite
        return sign * np.append(alpha @ rows[place.astype(int)], -function.getNode("rho").real())


def _numbers(node: "cv2.FileNode", most: int) -> np.ndarray:
    """Return the numbers of a node. Raise ValueError for more than `most`, since OpenCV takes quadratic time."""
    if not node.isSeq():
        return np.array([node.real()])
    if node.size() > most:
        raise ValueError(f"{node.size()} numbers")
    return np.array([node.at(i).real() for i in range(node.size())])


_Reader = Callable[[Path, int], tuple[np.ndarray, Layout]]
_READERS: dict[str, _Reader] = dict.fromkeys((".npy", ".npz"), _read_numpy)
_READERS |= dict.fromkeys((".yml", ".yaml", ".xml", ".json"), _read_opencv)
