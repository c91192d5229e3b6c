"""Records, and how they are printed."""

from typing import Any

import numpy as np

_LONGEST = 240  # longest text of a record, in characters


class Record:
    """A record that is printed in one short line, with counts and ranges instead of arrays, and without defaults.

    >>> td.Detections([[40, 60, 20, 20], [80, 60, 10, 20]], [0.9, 0.5], label=["car", "person"])
    Detections(2 rows, box_px: 10 to 80, score: 0.5 to 0.9, label: car, person, class_id: -1)
    """

    def __init_subclass__(cls) -> None:
        # A dataclass makes its own repr unless its class defines one.
        cls.__repr__ = Record.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        parts = [_count(self, "row")] if hasattr(self, "__len__") else []
        for name, field in type(self).__dataclass_fields__.items():  # type: ignore[attr-defined]
            value = getattr(self, name)
            if isinstance(value, np.ndarray):
                words = _describe_array(value, is_column=hasattr(self, "__len__") and len(value) == len(self))
                parts += [f"{name}: {words}"] if words else []
            elif not (value is None or value == field.default or value in ("", (), {}) or value != value):
                parts.append(f"{name}={_describe_value(value)}")
        text = ", ".join(parts)
        return f"{type(self).__name__}({text if len(text) <= _LONGEST else text[: _LONGEST - 3] + '...'})"


def _describe_value(value: Any) -> str:
    """Return a field in words: sizes of tables, long lists and records replace their content."""
    if isinstance(value, Record):
        return f"{type(value).__name__}({_count(value, 'row') if hasattr(value, '__len__') else '...'})"
    text = f"{value:.6g}" if isinstance(value, float) else repr(value)
    if len(text) <= 40:
        return text
    return _count(value, "item") if isinstance(value, tuple | list | dict | set | frozenset) else text[:37] + "..."


def _count(items: Any, name: str) -> str:
    return f"{len(items)} {name}{'s' * (len(items) != 1)}"


def _describe_array(array: np.ndarray, *, is_column: bool) -> str:
    """Return the range of numbers, or the different texts, of an array. Its shape comes first unless it is a column."""
    shape = "" if is_column else "x".join(map(str, array.shape)) + " "
    if array.dtype.kind in "iufb":
        known = array[np.isfinite(array)]
        if not known.size:
            return ""
        low, high = (f"{value:.6g}" for value in (known.min(), known.max()))
        return shape + (low if low == high else f"{low} to {high}")
    texts = list(dict.fromkeys(str(value) for value in array.ravel().tolist() if value != ""))
    return (shape + ", ".join(texts[:3]) + (", ..." if len(texts) > 3 else "")).strip() if texts else ""
