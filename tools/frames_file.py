"""A robot's `frames.csv`: which pictures, in which order, and what is known of each."""

import csv
import io
from dataclasses import dataclass, fields
from pathlib import Path

from groundfuse.tools.checks import finite_number, refuse_unknown
from groundfuse.tools.errors import DataError
from groundfuse.tools.files import read_text


@dataclass(frozen=True, slots=True)
class FrameRow:
    """One line; the columns bear the fields' names, in any order. None where a cell is empty.

    Attributes:
        image: name of a picture in `images/`.
        time_s: time stamp.
        height_m: of the camera over the floor when the picture was taken.
        height_sigma_m: its standard deviation.
        tilt_deg: from nadir.
        tilt_sigma_deg: its standard deviation.
        roll_deg: about the heading, positive where the left side is up.
        roll_sigma_deg: its standard deviation.
        odom_x_m: pose of the base in the robot's odometry frame.
        odom_y_m: to the left.
        odom_theta_deg: heading, counterclockwise.
        odom_sigma_m: standard deviation, along x and along y, of the motion since the last frame.
        odom_sigma_deg: standard deviation of the turn since the last frame.
    """

    image: str
    time_s: float | None = None
    height_m: float | None = None
    height_sigma_m: float | None = None
    tilt_deg: float | None = None
    tilt_sigma_deg: float | None = None
    roll_deg: float | None = None
    roll_sigma_deg: float | None = None
    odom_x_m: float | None = None
    odom_y_m: float | None = None
    odom_theta_deg: float | None = None
    odom_sigma_m: float | None = None
    odom_sigma_deg: float | None = None


COLUMNS = tuple(field.name for field in fields(FrameRow))
ODOMETRY = tuple(name for name in COLUMNS if name.startswith("odom_"))
POSITIVE = tuple(name for name in COLUMNS if "sigma" in name)


def read_frames(path: Path) -> tuple[FrameRow, ...]:
    """Return the lines of a `frames.csv`, at least one.

    Raises:
        DataError: unreadable, an unknown column, a cell that is no finite number, a picture named
            twice, times on some lines only or not increasing, half an odometry pose.
    """
    text = read_text(path)
    try:
        return _rows(text)
    except (ValueError, csv.Error) as error:
        raise DataError(f"{path}: {error}") from error


def frames_text(rows: tuple[FrameRow, ...]) -> str:
    """Return the text of a `frames.csv` from which `read_frames` gives back the rows."""
    used = [name for name in COLUMNS if any(getattr(row, name) is not None for row in rows)]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(used)
    writer.writerows([getattr(row, name) for name in used] for row in rows)
    return out.getvalue()


def _rows(text: str) -> tuple[FrameRow, ...]:
    reader = csv.reader(io.StringIO(text), strict=True)
    header = [cell.strip() for cell in next(reader, [])]
    if "image" not in header:
        semicolon = len(header) == 1 and ";" in header[0]
        hint = " (separate columns by commas, not semicolons)" if semicolon else ""
        raise ValueError(f"the first line must name the columns, image among them{hint}")
    refuse_unknown(header, COLUMNS, "column")
    if len(set(header)) < len(header):
        raise ValueError("a column stands there twice")
    rows: list[FrameRow] = []
    line_of: dict[str, int] = {}
    for cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        line = reader.line_num
        try:
            row = _row(header, cells)
            _check_after(row, rows[-1] if rows else row)
        except ValueError as error:
            raise ValueError(f"line {line}: {error}") from error
        if row.image in line_of:
            raise ValueError(f"line {line}: {row.image} stands on line {line_of[row.image]} too")
        line_of[row.image] = line
        rows.append(row)
    if not rows:
        raise ValueError("it lists no picture")
    return tuple(rows)


def _row(header: list[str], cells: list[str]) -> FrameRow:
    if len(cells) != len(header):
        raise ValueError(f"needs {len(header)} cells, got {len(cells)}")
    named = {name: cell.strip() for name, cell in zip(header, cells, strict=True)}
    image = named.pop("image")
    if not image:
        raise ValueError("no picture's name")
    numbers = {name: finite_number(cell, name) for name, cell in named.items() if cell}
    for name in POSITIVE:
        if name in numbers and numbers[name] <= 0.0:
            raise ValueError(f"{name} must be positive, got {numbers[name]:g}")
    missing = [name for name in ODOMETRY if name not in numbers]
    if 0 < len(missing) < len(ODOMETRY):
        raise ValueError(f"odometry needs all of its columns, {missing[0]} is empty or missing")
    return FrameRow(image, **numbers)


def _check_after(row: FrameRow, before: FrameRow) -> None:
    """Refuse times that don't increase, or that only some lines have."""
    if row is before:
        return
    if (row.time_s is None) != (before.time_s is None):
        raise ValueError("time_s must stand on every line or on none")
    if row.time_s is not None and before.time_s is not None and row.time_s <= before.time_s:
        raise ValueError(f"time_s must increase, got {row.time_s:.9g} after {before.time_s:.9g}")
