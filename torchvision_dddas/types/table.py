"""Tables: records with columns of one length; and boxes."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types.record import Record

# Fields that all rows of a table share. They become columns when tables are joined.
_COMMON = ("time_s", "frame", "by")
# Fields that give columns their meaning. Tables that differ in them cannot be joined.
_MEANING = ("names", "classes", "geographic", "origin_deg", "height_zero")


class Table(Record):
    """A record whose arrays have one row per item. Rows can be selected, and tables of one kind joined.

    >>> boxes = td.Detections([[40, 60, 20, 20], [80, 60, 10, 20]], [0.9, 0.5])
    >>> len(boxes), boxes[0].score, boxes[boxes.score > 0.8].score, [float(row.score[0]) for row in boxes]
    (2, array([0.9]), array([0.9]), [0.9, 0.5])
    >>> len(td.Detections.concat([boxes, boxes[1:]]))
    3
    """

    def __len__(self) -> int:
        values = (getattr(self, name) for name in self.__dataclass_fields__)  # type: ignore[attr-defined]
        return next(len(value) for value in values if isinstance(value, np.ndarray | list))

    def __iter__(self) -> Iterator[Self]:
        return (self[row] for row in range(len(self)))

    def __getitem__(self, rows: int | slice | Sequence[int] | np.ndarray) -> Self:
        """Return the selected rows (a number, indices, mask or slice). Fields that are not arrays are kept."""
        if isinstance(rows, int | np.integer):
            rows = [range(len(self))[rows]]
        return replace(self, **{name: column[rows] for name, column in columns_of(self).items()})  # type: ignore[type-var]

    @classmethod
    def concat(cls, tables: Iterable[Self]) -> Self:
        """Join tables. Fields that are not arrays come from the first table, but frames and times become arrays.

        Raise InputError without tables, and for tables whose columns, their meaning or their kind differ.
        """
        tables = list(tables)
        if not tables:
            raise InputError(f"{cls.__name__}.concat got no tables; wanted at least one")
        columns = [columns_of(table) | _common_columns(table) for table in tables]
        for table, column in zip(tables, columns, strict=True):
            wrong = sorted(column.keys() ^ columns[0].keys())
            wrong += [name for name in _MEANING if getattr(table, name, None) != getattr(tables[0], name, None)]
            if wrong:
                raise InputError(f"tables of {cls.__name__} that are joined must have the same {', '.join(wrong)}")
        kinds = [kind for table in tables if isinstance(kind := getattr(table, "kind", None), str)]
        if len(set(kinds)) > 1:
            raise InputError(
                f"tables of {cls.__name__} that are joined must have the same kind, got "
                f"{' and '.join(dict.fromkeys(kinds))}; dataclasses.replace(table, kind=...) changes it"
            )
        joined = {name: np.concatenate([column[name] for column in columns]) for name in columns[0]}
        return replace(tables[0], **joined)  # type: ignore[type-var]

    def to_columns(self) -> dict[str, np.ndarray]:
        """Return arrays (N,) by column name. Wider arrays are split: box_px into x_px, y_px, width_px, height_px.

        The frame is a column, and `label` is called `class`, as in the tables of runs.
        """
        columns = _common_columns(self)
        for name, values in columns_of(self).items():
            flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
            many = (name,) if values.ndim == 1 else tuple(f"{name}_{k}" for k in range(flat.shape[1]))
            if name == "place":
                many = _SPLIT["lonlat_deg" if getattr(self, "geographic", False) else "east_north_m"]
            columns |= dict(zip(_SPLIT.get(name, many), flat.T, strict=True))
        return columns

    def to_pandas(self) -> Any:
        """Return the columns of to_columns as a pandas DataFrame. Raise InputError if pandas is not installed."""
        try:
            import pandas
        except ImportError:
            raise InputError("to_pandas needs pandas: pip install pandas; to_columns gives plain arrays") from None
        return pandas.DataFrame(self.to_columns())


# Names of the columns of arrays with several columns, or with another name than the table's column.
_SPLIT = {
    "label": ("class",),
    "box_px": ("x_px", "y_px", "width_px", "height_px"),
    "window_px": ("window_x_px", "window_y_px", "window_width_px", "window_height_px"),
    "middle_px": ("middle_u_px", "middle_v_px"),
    "image_px": ("u_px", "v_px"),
    "east_north_m": ("east_m", "north_m"),
    "lonlat_deg": ("longitude_deg", "latitude_deg"),
    "velocity_m_s": ("velocity_east_m_s", "velocity_north_m_s"),
    "state": ("east_m", "north_m", "velocity_east_m_s", "velocity_north_m_s"),
    "place_m": ("east_m", "north_m", "up_m"),
    "covariance_m2": ("var_east_m2", "cov_east_north_m2", "cov_north_east_m2", "var_north_m2"),
}


class Boxes(Table):
    """A table with boxes, box_px (N, 4), scores, and classes: names and numbers.

    >>> boxes = td.Detections([[40, 60, 20, 20]], [0.9])
    >>> boxes.xyxy, boxes.foot_px
    (array([[40., 60., 60., 80.]]), array([[49.5, 79. ]]))
    """

    box_px: np.ndarray
    score: np.ndarray
    label: np.ndarray
    class_id: np.ndarray

    @property
    def xyxy(self) -> np.ndarray:
        """Left, top, right and bottom edges in pixels, (N, 4), as in torchvision and supervision."""
        return np.concatenate([self.box_px[:, :2], self.box_px[:, :2] + self.box_px[:, 2:]], axis=1)

    @property
    def foot_px(self) -> np.ndarray:
        """The middle of the lower edge, (N, 2) u, v from the first pixel's centre."""
        return self.box_px[:, :2] + self.box_px[:, 2:] * (0.5, 1.0) - (0.5, 1.0)

    def to_supervision(self) -> Any:
        """Return the boxes as supervision.Detections, which its annotators draw; class_id is 0 if no class is known.

        Raise InputError if supervision is not installed.
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
    """Return the columns of a table by name."""
    values = ((name, getattr(table, name)) for name in table.__dataclass_fields__)  # `fields` takes much longer
    return {name: value for name, value in values if isinstance(value, np.ndarray)}


def _common_columns(table: Any) -> dict[str, np.ndarray]:
    """Return the values that all rows of a table share, as columns."""
    values = {name: getattr(table, name) for name in _COMMON if name in table.__dataclass_fields__}
    return {name: np.full(len(table), v) for name, v in values.items() if not isinstance(v, np.ndarray)}


def complete_table(table: Any, count: int, **unknown: Any) -> None:
    """Fill arrays that were not given with unknown values. Raise InputError for arrays of other lengths."""
    for name, values in columns_of(table).items():
        if len(values) == 0 < count and name in unknown:
            filled = np.full((count, *values.shape[1:]), unknown[name], values.dtype)
            object.__setattr__(table, name, filled)
        elif len(values) not in (0, count):
            raise InputError(f"{name} of {type(table).__name__} must have {count} rows, got {len(values)}")
