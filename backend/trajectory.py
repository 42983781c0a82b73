"""Trajectories as TUM text: `time_s x y z qx qy qz qw` per line, the format that evo reads."""

import math
from collections.abc import Iterable

from groundfuse.backend.measurement import Se2

FIELDS = "time_s x y z qx qy qz qw"
LEVEL = 1e-3  # |qx|, |qy| above this is a tilt of 0.1 deg: not a planar pose


def tum_text(stamped: Iterable[tuple[float, Se2]]) -> str:
    """Return one line per (time_s, map_from_base); every digit that a double has is kept."""
    lines = [f"# {FIELDS}"]
    for time_s, pose in stamped:
        half = pose.theta_rad / 2.0
        lines.append(
            f"{time_s!r} {pose.x_m!r} {pose.y_m!r} 0 0 0 {math.sin(half)!r} {math.cos(half)!r}"
        )
    return "\n".join(lines) + "\n"


def parsed_tum(text: str) -> list[tuple[float, Se2]]:
    """Read TUM text: planar poses in the order of the file; comments (#) and blank lines allowed.

    z is ignored.

    Raises:
        ValueError: a line has not eight finite numbers, its quaternion is not of unit length, or it
            leans out of the plane; with the line number.
    """
    stamped = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if words:
            stamped.append(_pose(words, number))
    return stamped


def _pose(words: list[str], number: int) -> tuple[float, Se2]:
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise ValueError(f"line {number}: {error}") from error
    if len(values) != 8:
        raise ValueError(f"line {number}: needs {FIELDS}, got {len(values)} numbers")
    if not all(map(math.isfinite, values)):
        raise ValueError(f"line {number}: every number must be finite")
    time_s, x, y, _, qx, qy, qz, qw = values
    length = math.hypot(qx, qy, qz, qw)
    if abs(length - 1.0) > LEVEL:
        raise ValueError(f"line {number}: quaternion must have unit length, got {length:.6g}")
    if max(abs(qx), abs(qy)) > LEVEL:
        raise ValueError(f"line {number}: pose leans out of the plane, qx {qx:.3g} qy {qy:.3g}")
    return time_s, Se2(x, y, 2.0 * math.atan2(qz, qw) if qw >= 0 else 2.0 * math.atan2(-qz, -qw))
