"""Write columns as Parquet or GeoPackage, with places as points for maps (GeoParquet 1.1, GeoPackage 1.3)."""

import json
import sqlite3
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import save_file

PLACE = ("longitude_deg", "latitude_deg")
"""The columns that become points."""

_WGS84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433]]'
)
_GEOPACKAGE = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
    organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
    description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
    min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL REFERENCES gpkg_contents(table_name),
    column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
    srs_id INTEGER NOT NULL REFERENCES gpkg_spatial_ref_sys(srs_id), z TINYINT NOT NULL, m TINYINT NOT NULL,
    PRIMARY KEY (table_name, column_name));
"""

Columns = Mapping[str, Sequence[Any] | np.ndarray]
"""Values by column name; NaN, None and "" are unknown."""


def write_columns(columns: Columns, path: Path) -> None:
    """Write columns to a .parquet or .gpkg file. The columns PLACE become points in WGS84.

    Raise InputError if pyarrow is missing for Parquet, if a GeoPackage has no places, or if the disk refuses.
    """
    values = {name: [_known(value) for value in np.asarray(column).tolist()] for name, column in columns.items()}
    places = np.array([values[name] for name in PLACE], float).T if set(PLACE) <= values.keys() else None
    save_file(path, (_geopackage if path.suffix.lower() == ".gpkg" else _parquet)(values, places, path))


def _known(value: Any) -> Any:
    return None if value == "" or value != value else value


def _wkb(place: np.ndarray) -> bytes | None:
    return struct.pack("<BI2d", 1, 1, *place) if np.isfinite(place).all() else None


def _bounds(places: np.ndarray) -> list[float]:
    known = places[np.isfinite(places).all(axis=1)]
    return [*known.min(axis=0).tolist(), *known.max(axis=0).tolist()] if len(known) else []


def _parquet(values: dict[str, list[Any]], places: np.ndarray | None, path: Path) -> bytes:
    """Return a GeoParquet file. A missing `crs` means WGS84, longitude first. Source: geoparquet.org, version 1.1.0."""
    pyarrow, parquet = _import_parquet(path)
    table = pyarrow.table(values)
    if places is not None:
        table = table.append_column("geometry", pyarrow.array(list(map(_wkb, places)), pyarrow.binary()))
        column: dict[str, Any] = {"encoding": "WKB", "geometry_types": ["Point"]}
        column |= {"bbox": bounds} if (bounds := _bounds(places)) else {}
        geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
        table = table.replace_schema_metadata({"geo": json.dumps(geo)})
    sink = pyarrow.BufferOutputStream()
    parquet.write_table(table, sink)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def _import_parquet(path: Path) -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InputError(f"{path} needs pyarrow: pip install 'torchvision-dddas[parquet]'") from None
    return pyarrow, pyarrow.parquet


def _geopackage(values: dict[str, list[Any]], places: np.ndarray | None, path: Path) -> bytes:
    """Return a GeoPackage file. Source: OGC 12-128r18."""
    if places is None:
        raise InputError(f"{path} needs places: wanted the columns {' and '.join(PLACE)}, got {', '.join(values)}")
    values = {name: column for name, column in values.items() if name != "fid"}
    points = [None if (point := _wkb(p)) is None else struct.pack("<2sBBi", b"GP", 0, 1, 4326) + point for p in places]
    kinds = {int: "INTEGER", bool: "BOOLEAN", float: "REAL", str: "TEXT"}
    kind_of = {n: next((kinds[type(v)] for v in column if v is not None), "TEXT") for n, column in values.items()}
    names = ['"' + name.replace('"', '""') + '"' for name in values]
    columns = "".join(f", {name} {kind}" for name, kind in zip(names, kind_of.values(), strict=True))
    base = sqlite3.connect(":memory:")
    try:
        base.execute("PRAGMA application_id = 1196444487")  # GPKG
        base.execute("PRAGMA user_version = 10300")
        base.executescript(_GEOPACKAGE)
        systems = [
            ("Undefined cartesian SRS", -1, "NONE", -1, "undefined", None),
            ("Undefined geographic SRS", 0, "NONE", 0, "undefined", None),
            ("WGS 84 geodetic", 4326, "EPSG", 4326, _WGS84, "longitude and latitude in degrees"),
        ]
        base.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", systems)
        bounds: list[float | None] = [*_bounds(places)] or [None] * 4
        content = "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, max_x, max_y, srs_id)"
        base.execute(f"{content} VALUES ('positions', 'features', 'positions', ?, ?, ?, ?, 4326)", bounds)
        base.execute("INSERT INTO gpkg_geometry_columns VALUES ('positions', 'geom', 'POINT', 4326, 0, 0)")
        base.execute(f"CREATE TABLE positions (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom POINT{columns})")
        marks = ", ".join("?" * (len(names) + 1))
        insert = f"INSERT INTO positions ({', '.join(['geom', *names])}) VALUES ({marks})"
        base.executemany(insert, zip(points, *values.values(), strict=True))
        base.commit()
        return base.serialize()
    finally:
        base.close()


def read_columns(path: Path, name: str) -> dict[str, list[Any]]:
    """Return the columns of a .parquet file, without geometry. name: for messages. Raise InputError if unreadable."""
    pyarrow, parquet = _import_parquet(path)
    try:
        values: dict[str, list[Any]] = parquet.read_table(path).to_pydict()
    except (pyarrow.ArrowException, OSError) as error:
        raise InputError(f"{name} cannot be read as Parquet: {str(error).splitlines()[0]}") from None
    values.pop("geometry", None)
    return values
