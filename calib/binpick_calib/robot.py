"""The robot's poses: a table as its maker writes it, with columns or a setting that say which angles and units it has."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from binpick import geometry, poses
from binpick.calibration import REACH_M
from binpick.errors import InputError
from binpick.geometry import Transform
from binpick.poses import PoseFormat

UNITS_M = {"m": 1.0, "mm": 0.001}
NAMES = ("name", "image", "number", "nr", "no", "id", "sample", "file")
COLUMNS = {("qx", "qy", "qz", "qw"): PoseFormat.quaternion_xyzw, ("q1", "q2", "q3", "q4"): PoseFormat.quaternion_xyzw,
           ("a", "b", "c"): PoseFormat.kuka_abc_deg, ("w", "p", "r"): PoseFormat.fanuc_wpr_deg,
           ("rx", "ry", "rz"): PoseFormat.ur_rxryrz_rad}
"""How heads of columns name an orientation; ABB's q1 is the real part."""


class Row(NamedTuple):
    """One pose as written: position in metres, and the orientation's numbers."""

    name: str
    line: int
    position_m: tuple[float, ...]
    angles: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Table:
    """All poses of a file; `named` is False when rows have no names and are numbered from 1."""

    path: Path
    rows: tuple[Row, ...]
    pose_format: PoseFormat
    named: bool

    def T_base_flange(self, row: Row, pose_format: PoseFormat | None = None, scale: float = 1.0) -> Transform:
        """A row's pose; also as another format would read it, its angles multiplied. Raises InputError that names the line."""
        numbers = scale * np.array(row.angles)
        read_as = pose_format or self.pose_format
        if read_as is PoseFormat.quaternion_xyzw and abs(np.linalg.norm(numbers) - 1) > 0.01:
            raise InputError(f"{self.path}:{row.line}: a quaternion of length {np.linalg.norm(numbers):.3f}, it must be 1")
        return geometry.from_quaternion(np.array(row.position_m), poses.decode(numbers, read_as))


def read(path: Path, told: PoseFormat | None = None, unit: str = "") -> Table:
    """The poses of a .csv, .txt, .yaml or .yml file. Raises InputError that names file, line and what is expected."""
    table = _of_yaml(path) if path.suffix.lower() in (".yaml", ".yml") else _of_csv(path, told, unit)
    if not table.rows:
        raise InputError(f"{path}: there is no pose in it")
    for row in table.rows:
        far_m = float(np.linalg.norm(row.position_m))
        if far_m > REACH_M:
            raise InputError(f"{path}:{row.line}: the flange would be {far_m:.0f} m from its base: is the unit right?")
        table.T_base_flange(row)
    return table


def points(path: Path, unit: str = "") -> tuple[Row, ...]:
    """Named points of a .csv with the columns name, x, y, z. Raises InputError as `read` does."""
    cells = _lines(path)
    head = [_head(cell) for cell in cells[0][1]]
    names = [name for name, _ in head]
    if not {"name", "x", "y", "z"} <= set(names):
        raise InputError(f"{path}:{cells[0][0]}: the first line must name the columns: name,x_mm,y_mm,z_mm")
    unit_m = _unit_m(path, dict(head)["x"] or unit)
    rows = []
    for line, row in cells[1:]:
        if len(row) != len(head):
            raise InputError(f"{path}:{line}: {len(row)} columns, the head has {len(head)}")
        rows.append(Row(row[names.index("name")], line,
                        tuple(unit_m * _number(path, line, row[names.index(axis)]) for axis in "xyz"), ()))
    return tuple(rows)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: the table cannot be read: {getattr(error, 'strerror', error)}") from error


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """The cells of each line that says something, with its number."""
    cells = [(line, _cells(written)) for line, written in enumerate(_text(path).splitlines(), start=1)
             if written.strip() and not written.lstrip().startswith("#")]
    if not cells:
        raise InputError(f"{path}: there is nothing in it")
    return cells


def _of_csv(path: Path, told: PoseFormat | None, unit: str) -> Table:
    cells = _lines(path)
    head = [_head(cell) for cell in cells[0][1]]
    if "x" not in [name for name, _ in head]:
        return _without_head(path, cells, told, unit)
    names = [name for name, _ in head]
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        raise InputError(f"{path}:{cells[0][0]}: there is no column {', '.join(missing)}")
    columns = next((given for given in COLUMNS if set(given) <= set(names)), None)
    if columns is None:
        raise InputError(f"{path}:{cells[0][0]}: no columns tell the orientation; they are called "
                         f"{'; '.join(' '.join(known) for known in COLUMNS)}")
    pose_format = told or COLUMNS[columns]
    if columns == ("rx", "ry", "rz") and told is None and dict(head)["rx"] == "deg":
        raise InputError(f"{path}:{cells[0][0]}: rx ry rz in degrees: say which angles they are by --pose-format")
    unit_m = _unit_m(path, dict(head)["x"] or unit)
    places = [names.index(column) for column in ((*columns[1:], columns[0]) if columns[0] == "q1" else columns)]
    label = next((names.index(name) for name in NAMES if name in names), None)
    rows = []
    for number, (line, row) in enumerate(cells[1:], start=1):
        if len(row) != len(head):
            raise InputError(f"{path}:{line}: {len(row)} columns, the head has {len(head)}")
        xyz = tuple(unit_m * _number(path, line, row[names.index(axis)]) for axis in "xyz")
        rows.append(Row(row[label] if label is not None else str(number), line, xyz,
                        tuple(_number(path, line, row[place]) for place in places)))
    return Table(path, tuple(rows), pose_format, label is not None)


def _without_head(path: Path, cells: Sequence[tuple[int, list[str]]], told: PoseFormat | None, unit: str) -> Table:
    """x y z and the orientation's numbers in their order, a name before them or none."""
    if told is None:
        raise InputError(f"{path}:{cells[0][0]}: without a head such as name,x_mm,y_mm,z_mm,a,b,c the angles are not known: "
                         f"say --pose-format {', '.join(known.name for known in PoseFormat)}")
    unit_m, count = _unit_m(path, unit), 7 if told is PoseFormat.quaternion_xyzw else 6
    rows = []
    for number, (line, row) in enumerate(cells, start=1):
        if len(row) not in (count, count + 1) or len(row) != len(cells[0][1]):
            raise InputError(f"{path}:{line}: {len(row)} columns; {told.name} has {count}, and one more for names")
        values = [_number(path, line, cell) for cell in row[-count:]]
        rows.append(Row(row[0] if len(row) > count else str(number), line, tuple(unit_m * value for value in values[:3]),
                        tuple(values[3:])))
    return Table(path, tuple(rows), told, len(cells[0][1]) > count)


def _of_yaml(path: Path) -> Table:
    """A list of mappings: a name, position_m or position_mm, and one orientation as in the cell file."""
    try:
        document = yaml.safe_load(_text(path))
    except yaml.YAMLError as error:
        raise InputError(f"{path}: not YAML: {getattr(error, 'problem', error)}") from error
    if not isinstance(document, list) or not all(isinstance(entry, dict) for entry in document):
        raise InputError(f"{path}: write a list of poses: - {{name: 1, position_mm: [x, y, z], kuka_abc_deg: [a, b, c]}}")
    rows, formats = [], set()
    for number, entry in enumerate(document, start=1):
        where = f"{path}: pose {number}"
        given = [known for known in PoseFormat if known.name in entry]
        if len(given) != 1:
            raise InputError(f"{where}: give one orientation: {', '.join(known.name for known in PoseFormat)}")
        formats.add(given[0])
        unit = next((unit for unit in UNITS_M if f"position_{unit}" in entry), None)
        if unit is None:
            raise InputError(f"{where}: give position_m or position_mm")
        label = next((str(entry[name]) for name in NAMES if name in entry), "")
        rows.append(Row(label, number, tuple(UNITS_M[unit] * value for value in _numbers(where, entry[f"position_{unit}"], 3)),
                        tuple(_numbers(where, entry[given[0].name], 4 if given[0] is PoseFormat.quaternion_xyzw else 3))))
    if len(formats) > 1:
        raise InputError(f"{path}: the poses have orientations of {len(formats)} kinds; give all the same one")
    named = all(row.name for row in rows)
    return Table(path, tuple(row if named else row._replace(name=str(row.line)) for row in rows), formats.pop(), named)


def _numbers(where: str, values: Any, count: int) -> list[float]:
    if not isinstance(values, list) or len(values) != count or not all(isinstance(value, int | float) for value in values):
        raise InputError(f"{where}: {values} are not {count} numbers")
    return [float(value) for value in values]


def _cells(line: str) -> list[str]:
    """Between commas, semicolons (then a comma is a decimal point), tabs or blanks."""
    separator = next((each for each in ";\t," if each in line), " ")
    cells = next(csv.reader([" ".join(line.split()) if separator == " " else line], delimiter=separator))
    return [cell.strip().replace(",", ".") if separator == ";" else cell.strip() for cell in cells]


def _head(cell: str) -> tuple[str, str]:
    """A column's name and unit: x_mm, X [mm], A (deg)."""
    found = re.fullmatch(r"(\w+?)[_\s]*[\[(]?(mm|m|deg|rad|°)?[\])]?", cell.lower())
    return (found[1], found[2] or "") if found else (cell.lower(), "")


def _unit_m(path: Path, unit: str) -> float:
    if unit not in UNITS_M:
        raise InputError(f"{path}: positions in mm or m? Call the columns x_mm y_mm z_mm, or give --unit")
    return UNITS_M[unit]


def _number(path: Path, line: int, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise InputError(f"{path}:{line}: {cell!r} is not a number") from None
    if not np.isfinite(value):
        raise InputError(f"{path}:{line}: {cell!r} is not a finite number")
    return value
