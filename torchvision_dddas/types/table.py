"""Tables: records of columns of one length, and boxes."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np

from torchvision_dddas.errors import InputError


class Table:
    """A record whose arrays have one row an item each: rows can be selected, and tables of one kind joined."""

    def __getitem__(self, rows: np.ndarray | slice) -> Self:
        """The selected rows (indices, mask or slice); fields that are not arrays are kept."""
        return replace(self, **{name: column[rows] for name, column in columns_of(self).items()})  # type: ignore[type-var]

    @classmethod
    def concat(cls, tables: Sequence[Self]) -> Self:
        """All rows in one table; other fields come from the first, but the frames of rows become an array."""
        columns = [columns_of(table) for table in tables]
        for table, column in zip(tables, columns, strict=True):
            if hasattr(table, "frame"):
                column["frame"] = np.broadcast_to(table.frame, len(table))  # type: ignore[arg-type]
        joined = {name: np.concatenate([column[name] for column in columns]) for name in columns[0]}
        return replace(tables[0], **joined)  # type: ignore[type-var]

    def to_columns(self) -> dict[str, np.ndarray]:
        """Arrays (N,) by column name; wider arrays are split: box_px into x_px, y_px, width_px, height_px.

        The frame is a column, and `label` is called `class`, as in the tables of runs.
        """
        columns: dict[str, np.ndarray] = {}
        if hasattr(self, "frame"):
            columns["frame"] = np.broadcast_to(self.frame, len(self))  # type: ignore[arg-type]
        for name, values in columns_of(self).items():
            flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
            many = (name,) if values.ndim == 1 else tuple(f"{name}_{k}" for k in range(flat.shape[1]))
            columns |= dict(zip(_SPLIT.get(name, many), flat.T, strict=True))
        return columns

    def to_pandas(self) -> Any:
        """The columns of to_columns as a pandas DataFrame. Raises InputError where pandas is not installed."""
        try:
            import pandas
        except ImportError:
            raise InputError("to_pandas needs pandas: pip install pandas; to_columns gives plain arrays") from None
        return pandas.DataFrame(self.to_columns())


# Names of the columns of arrays that have several, or another name than a table's column.
_SPLIT = {
    "label": ("class",),
    "box_px": ("x_px", "y_px", "width_px", "height_px"),
    "window_px": ("window_x_px", "window_y_px", "window_width_px", "window_height_px"),
    "middle_px": ("middle_u_px", "middle_v_px"),
    "image_px": ("u_px", "v_px"),
    "east_north_m": ("east_m", "north_m"),
    "lonlat_deg": ("longitude_deg", "latitude_deg"),
    "covariance_m2": ("var_east_m2", "cov_east_north_m2", "cov_north_east_m2", "var_north_m2"),
}


class Boxes(Table):
    """A table with boxes, box_px (N, 4), scores, and classes: names and numbers."""

    box_px: np.ndarray
    score: np.ndarray
    label: np.ndarray
    class_id: np.ndarray

    @property
    def xyxy(self) -> np.ndarray:
        """(N, 4) left, top, right and bottom edge in pixels, as torchvision and supervision have boxes."""
        return np.concatenate([self.box_px[:, :2], self.box_px[:, :2] + self.box_px[:, 2:]], axis=1)

    def to_supervision(self) -> Any:
        """A supervision.Detections of the boxes, as its annotators draw it; class_id is 0 if no class is known.

        Raises InputError where supervision is not installed.
        """
        try:
            import supervision
        except ImportError:
            raise InputError("to_supervision needs supervision: pip install supervision") from None
        data = {"class_name": self.label.astype(str)} if any(self.label.tolist()) else {}
        number = self.class_id if (self.class_id >= 0).any() else np.zeros_like(self.class_id)
        identity = getattr(self, "identity", None)
        return supervision.Detections(
            xyxy=self.xyxy, confidence=self.score, class_id=number, tracker_id=identity, data=data
        )


def columns_of(table: Any) -> dict[str, np.ndarray]:
    """The columns of a table by name."""
    values = ((name, getattr(table, name)) for name in table.__dataclass_fields__)  # `fields` takes much longer
    return {name: value for name, value in values if isinstance(value, np.ndarray)}


def complete_table(table: Any, count: int, **unknown: Any) -> None:
    """Fill the arrays that were not given with what is unknown. Raises InputError for arrays of other lengths."""
    for name, values in columns_of(table).items():
        if len(values) == 0 < count and name in unknown:
            filled = np.full((count, *values.shape[1:]), unknown[name], values.dtype)
            object.__setattr__(table, name, filled)
        elif len(values) not in (0, count):
            raise InputError(f"{name} of {type(table).__name__} must have {count} rows, got {len(values)}")
