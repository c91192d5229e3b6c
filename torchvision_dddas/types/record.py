"""How records print themselves."""

from typing import Any

import numpy as np

_LONGEST = 240  # characters of a record in words


class Record:
    """A record that prints itself in one short line: counts and ranges instead of arrays, and no defaults.

    >>> td.Detections([[40, 60, 20, 20], [80, 60, 10, 20]], [0.9, 0.5], label=["car", "person"])
    Detections(2 rows, box_px: 10 to 80, score: 0.5 to 0.9, label: car, person, class_id: -1)
    """

    def __init_subclass__(cls) -> None:
        # A dataclass makes a repr of its own, unless its class has one by itself.
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
    """A field in words: the size of a table, of a long list and of a record in place of its content."""
    if isinstance(value, Record):
        return f"{type(value).__name__}({_count(value, 'row') if hasattr(value, '__len__') else '...'})"
    text = f"{value:.6g}" if isinstance(value, float) else repr(value)
    if len(text) <= 40:
        return text
    return _count(value, "item") if isinstance(value, tuple | list | dict | set | frozenset) else text[:37] + "..."


def _count(items: Any, name: str) -> str:
    return f"{len(items)} {name}{'s' * (len(items) != 1)}"


def _describe_array(array: np.ndarray, *, is_column: bool) -> str:
    """The range of numbers, or the different texts of an array, behind its shape unless it is a column of the rows."""
    shape = "" if is_column else "x".join(map(str, array.shape)) + " "
    if array.dtype.kind in "iufb":
        known = array[np.isfinite(array)]
        if not known.size:
            return ""
        low, high = (f"{value:.6g}" for value in (known.min(), known.max()))
        return shape + (low if low == high else f"{low} to {high}")
    texts = list(dict.fromkeys(str(value) for value in array.ravel().tolist() if value != ""))
    return (shape + ", ".join(texts[:3]) + (", ..." if len(texts) > 3 else "")).strip() if texts else ""
