"""JSON Robot Log (JRL) datasets of planar teams, as COSMO-Bench distributes them: the content.

A dataset has, per robot, entries in the order of time with the measurements made then: priors and
relative poses, each with a covariance (order x y theta, row after row). Keys are gtsam's symbols,
whose letter is the robot. A measurement is found by (entry, number within it). McGann et al.,
https://github.com/DanMcGann/jrl, whose reader and writer decide where its documents differ.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from groundfuse.backend.measurement import Se2

Nine = tuple[float, float, float, float, float, float, float, float, float]
Values = dict[int, Se2]
Factors = tuple[tuple[int, int], ...]
PRIOR, BETWEEN, POSE = "PriorFactorPose2", "BetweenFactorPose2", "Pose2"


@dataclass(frozen=True, slots=True)
class Prior:
    """A measured pose of `key` in the frame of all robots."""

    key: int
    pose: Se2
    covariance: Nine


@dataclass(frozen=True, slots=True)
class Between:
    """A measured pose of `b` in `a`."""

    a: int
    b: int
    a_from_b: Se2
    covariance: Nine


@dataclass(frozen=True, slots=True)
class Entry:
    """What a robot measured at one time."""

    stamp: int
    measurements: tuple[Prior | Between, ...]


@dataclass(frozen=True, slots=True)
class Dataset:
    """The content of a JRL file.

    Attributes:
        name: of the dataset.
        robots: their letters.
        measurements: entries by robot.
        groundtruth: true poses by robot, or None where the file has none.
        initialization: start values by robot, or None.
        potential_outlier_factors: (entry, measurement) that may be wrong, by robot, or None.
        outlier_factors: (entry, measurement) that are known to be wrong, by robot, or None.
    """

    name: str
    robots: tuple[str, ...]
    measurements: dict[str, tuple[Entry, ...]]
    groundtruth: dict[str, Values] | None = None
    initialization: dict[str, Values] | None = None
    potential_outlier_factors: dict[str, Factors] | None = None
    outlier_factors: dict[str, Factors] | None = None


def text_of(dataset: Dataset) -> str:
    """Write JSON; `jrl_reader.parsed` gives back the same content to the bit."""
    content: dict[str, Any] = {
        "name": dataset.name,
        "robots": [ord(robot) for robot in dataset.robots],  # a C++ char is a number
        "measurements": {
            robot: [_entry(entry) for entry in entries]
            for robot, entries in dataset.measurements.items()
        },
    }
    for name, values in (
        ("groundtruth", dataset.groundtruth),
        ("initialization", dataset.initialization),
    ):
        if values is not None:
            content[name] = {robot: _values(own) for robot, own in values.items()}
    for name, factors in (
        ("potential_outlier_factors", dataset.potential_outlier_factors),
        ("outlier_factors", dataset.outlier_factors),
    ):
        if factors is not None:
            content[name] = {robot: [list(f) for f in own] for robot, own in factors.items()}
    return json.dumps(content, separators=(",", ":")) + "\n"


def _entry(entry: Entry) -> dict[str, Any]:
    return {"stamp": entry.stamp, "measurements": [_measured(m) for m in entry.measurements]}


def _measured(measured: Prior | Between) -> dict[str, Any]:
    covariance = [float(value) for value in measured.covariance]
    if isinstance(measured, Prior):
        pose = _pose(measured.pose)
        return {"type": PRIOR, "key": measured.key, "prior": pose, "covariance": covariance}
    ends = {"key1": measured.a, "key2": measured.b}
    pose = _pose(measured.a_from_b)
    return {"type": BETWEEN, **ends, "measurement": pose, "covariance": covariance}


def _values(values: Mapping[int, Se2]) -> list[dict[str, Any]]:
    return [{"key": key, **_pose(pose)} for key, pose in values.items()]


def _pose(pose: Se2) -> dict[str, Any]:
    numbers = {"x": pose.x_m, "y": pose.y_m, "theta": pose.theta_rad}
    return {"type": POSE, **{name: float(value) for name, value in numbers.items()}}
