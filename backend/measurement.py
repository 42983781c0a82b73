"""What crosses the border between front-end, back-end and tools: frozen values, numpy only.

Conventions: metres and radians; `a_from_b` maps b-coordinates to a-coordinates; a covariance is
3x3 in the order x, y, theta, in the tangent space at the pose, perturbed on the right, exactly as
`gtsam.BetweenFactorPose2(a, b, a_from_b, noise)` reads it.
"""

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def wrap_rad(angle_rad: float) -> float:
    """Return the angle in [-pi, pi]; values already inside come back unchanged to the bit."""
    if -math.pi <= angle_rad <= math.pi:
        return angle_rad
    return math.remainder(angle_rad, 2.0 * math.pi)


@dataclass(frozen=True, slots=True, order=True)
class FrameId:
    """The `index`-th picture of a robot, counted from 0."""

    robot: str
    index: int

    def __str__(self) -> str:
        """Return A11, or r1.1 where the robot's name ends like a number: no two frames share it."""
        dot = "." if self.robot[-1:].isdecimal() or self.robot[-1:] == "." else ""
        return f"{self.robot}{dot}{self.index}"


@dataclass(frozen=True, slots=True)
class Se2:
    """A planar rigid motion `a_from_b`: the pose of b in a, metres and radians."""

    x_m: float
    y_m: float
    theta_rad: float

    def __post_init__(self) -> None:
        """Refuse anything that is not a number.

        Raises:
            ValueError: a coordinate is nan or infinite.
        """
        if not all(map(math.isfinite, (self.x_m, self.y_m, self.theta_rad))):
            found = f"{self.x_m}, {self.y_m}, {self.theta_rad}"
            raise ValueError(f"a pose must be finite, got {found}")

    def __matmul__(self, other: Self) -> "Se2":
        """Compose: `a_from_b @ b_from_c = a_from_c`."""
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        return Se2(
            self.x_m + c * other.x_m - s * other.y_m,
            self.y_m + s * other.x_m + c * other.y_m,
            wrap_rad(self.theta_rad + other.theta_rad),
        )

    def inverse(self) -> "Se2":
        """Return `b_from_a` of `a_from_b`."""
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        return Se2(
            -c * self.x_m - s * self.y_m, s * self.x_m - c * self.y_m, wrap_rad(-self.theta_rad)
        )

    def matrix(self) -> Array:
        """Return the 3x3 homogeneous matrix."""
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        return np.array([[c, -s, self.x_m], [s, c, self.y_m], [0.0, 0.0, 1.0]])

    def apply(self, points: Array) -> Array:
        """Map points (n, 2) in b to a."""
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        mapped: Array = points @ np.array([[c, s], [-s, c]]) + np.array([self.x_m, self.y_m])
        return mapped

    def adjoint(self) -> Array:
        """Return the 3x3 adjoint: `a_from_b exp(d) = exp(adjoint d) a_from_b`, order x y theta."""
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        return np.array([[c, -s, self.y_m], [s, c, -self.x_m], [0.0, 0.0, 1.0]])

    def vector(self) -> Array:
        """Return (x_m, y_m, theta_rad)."""
        return np.array([self.x_m, self.y_m, self.theta_rad])


IDENTITY = Se2(0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Attitude:
    """A camera over the floor, or the standard deviations of the three numbers.

    Attributes:
        tilt_rad: from nadir; 0 looks straight down.
        roll_rad: lean about the heading, positive where the left side goes up.
        height_m: of the camera's centre over the floor.
    """

    tilt_rad: float
    roll_rad: float
    height_m: float


class Reason(StrEnum):
    """Why a pair that was tried gave no relative pose, or why the graph turned an edge down."""

    FEW_FEATURES = "few_features"
    FEW_CANDIDATES = "few_candidates"
    FEW_INLIERS = "few_inliers"
    AMBIGUOUS = "ambiguous"
    DEGENERATE = "degenerate"
    NOT_CONVERGED = "not_converged"
    RESIDUAL = "residual"
    ATTITUDE = "attitude"
    PRIOR = "prior"
    UNREADABLE = "unreadable"
    INCONSISTENT = "inconsistent"
    UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """The same floor points in two cameras, as undistorted rays (x/z, y/z) in the OpenCV frame.

    Attributes:
        rays_a: (n, 2) in camera a.
        rays_b: (n, 2) in camera b.
        sigma_a: (n,) one-axis standard deviation of `rays_a` (pixels over focal length).
        sigma_b: (n,) the same for `rays_b`.
    """

    rays_a: Array
    rays_b: Array
    sigma_a: Array
    sigma_b: Array

    def __len__(self) -> int:
        return len(self.rays_a)


def checked_covariance(covariance: Array, what: str) -> Array:
    """Return a symmetric 3x3 covariance as it is.

    Raises:
        ValueError: not 3x3, not finite, not symmetric, or not positive definite; with the number.
    """
    covariance = np.asarray(covariance, dtype=np.float64)
    if covariance.shape != (3, 3):
        raise ValueError(f"covariance of {what} must be 3x3, got shape {covariance.shape}")
    if not np.isfinite(covariance).all():
        raise ValueError(f"covariance of {what} is not finite")
    scale = np.abs(covariance).max()
    if np.abs(covariance - covariance.T).max() > 1e-9 * scale:
        raise ValueError(f"covariance of {what} is not symmetric")
    smallest = float(np.linalg.eigvalsh(covariance)[0])
    if smallest <= 0.0:
        raise ValueError(
            f"covariance of {what} must be positive definite, "
            f"its smallest eigenvalue is {smallest:.3g}"
        )
    return covariance


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """An accepted pair: the pose of frame b in frame a with its covariance.

    Attributes:
        a: reference frame.
        b: measured frame.
        a_from_b: Pose2 of robot base b in robot base a.
        covariance: (3, 3), tangent at b, order x y theta, m and rad, right perturbed.
        num_inliers: correspondences that support the pose; 0 where there are none (odometry).
        ambiguity: votes of the second-best motion over those of the best, 0 (unique) to 1.
        correspondences: the inliers, or None where the edge does not come from pictures.
    """

    a: FrameId
    b: FrameId
    a_from_b: Se2
    covariance: Array
    num_inliers: int = 0
    ambiguity: float = 0.0
    correspondences: Correspondences | None = None

    def __post_init__(self) -> None:
        """Refuse a self-loop and a covariance that is not one (ValueError)."""
        if self.a == self.b:
            raise ValueError(f"an edge needs two different frames, got {self.a} twice")
        checked_covariance(self.covariance, f"edge {self.a}-{self.b}")

    def reversed(self) -> "RelativePose":
        """Return the same measurement as the pose of a in b."""
        ad = self.a_from_b.adjoint()
        covariance = ad @ self.covariance @ ad.T
        c = self.correspondences
        swapped = None if c is None else Correspondences(c.rays_b, c.rays_a, c.sigma_b, c.sigma_a)
        return RelativePose(
            self.b,
            self.a,
            self.a_from_b.inverse(),
            (covariance + covariance.T) / 2.0,
            self.num_inliers,
            self.ambiguity,
            swapped,
        )


@dataclass(frozen=True, slots=True)
class Rejected:
    """A pair that was tried and not accepted: the reason, the number found and the one needed."""

    a: FrameId
    b: FrameId
    reason: Reason
    value: float
    limit: float


class EdgeKind(StrEnum):
    """What an edge is for the team: a step of a trajectory, or a meeting of two places of it."""

    CHAIN = "chain"
    LOOP = "loop"
    OVERLAP = "overlap"


@dataclass(frozen=True, slots=True)
class EdgeVerdict:
    """What the team graph made of one measured edge.

    Attributes:
        a: reference frame.
        b: measured frame.
        accepted: whether the edge took part in the final solution.
        chi2: squared Mahalanobis residual at the solution, 3 degrees of freedom; infinite where
            its two frames ended in different components.
        limit: the chi2 above which an edge is turned down.
        kind: a step along a trajectory, a loop within one map, or an overlap of two maps.
        reason: why it was turned down: INCONSISTENT with the rest, or UNDECIDED (another answer
            has comparable support); None for an accepted edge.
    """

    a: FrameId
    b: FrameId
    accepted: bool
    chi2: float
    limit: float
    kind: EdgeKind = EdgeKind.OVERLAP
    reason: Reason | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """Where a robot's own map lies in its component's frame.

    Attributes:
        robot: name of the robot.
        fragment: 0 for the robot's first connected piece of trajectory, then 1, 2, ...
        component: index of the connected part of the team; each has a frame of its own.
        first: the frame that is the origin of the robot's own map.
        team_from_map: the anchor.
        covariance: (3, 3) tangent at the anchor, relative to the component's reference frame; None
            for the map that is the reference itself.
        num_overlaps: accepted edges between this map and others of the component.
        rests_on_one: a single accepted edge alone ties this map to the component's reference.
    """

    robot: str
    fragment: int
    component: int
    first: FrameId
    team_from_map: Se2
    covariance: Array | None
    num_overlaps: int
    rests_on_one: bool = False


@dataclass(frozen=True, slots=True)
class Answer:
    """One possible place of a map relative to another.

    Attributes:
        a: first frame of the one map.
        b: first frame of the other.
        a_from_b: pose of b in a.
        support: overlaps between the two maps that agree with it.
    """

    a: FrameId
    b: FrameId
    a_from_b: Se2
    support: int


@dataclass(frozen=True, slots=True)
class Ambiguity:
    """Two maps whose overlaps allow several answers of comparable support; none was used.

    Attributes:
        answers: the possible answers, the best supported first.
    """

    answers: tuple[Answer, ...]


@dataclass(frozen=True, slots=True, eq=False)
class TeamEstimate:
    """All robots in one frame per connected component.

    Attributes:
        team_from_base: pose of every frame in its component's frame.
        component_of: index of the component that each frame belongs to; 0 is the largest.
        covariance: (3, 3) per frame, tangent at the frame, relative to the component's reference
            (the first frame of the component's first robot, whose own covariance is absent).
        anchors: one per connected piece of each robot's trajectory.
        verdicts: one per edge that was given, in the order given.
        chi2: sum of squared Mahalanobis residuals over accepted edges.
        degrees_of_freedom: 3 (accepted edges) - 3 (frames - components).
        ambiguities: pairs of maps that could lie in several ways.
        map_of: number of the map (connected piece of a trajectory) of every frame; index of
            `anchors`.
        map_from_base: pose of every frame in its map, chained along the trajectory's steps alone.
    """

    team_from_base: dict[FrameId, Se2]
    component_of: dict[FrameId, int]
    covariance: dict[FrameId, Array]
    anchors: tuple[Anchor, ...]
    verdicts: tuple[EdgeVerdict, ...]
    chi2: float
    degrees_of_freedom: int
    ambiguities: tuple[Ambiguity, ...] = ()
    map_of: dict[FrameId, int] = field(default_factory=dict)
    map_from_base: dict[FrameId, Se2] = field(default_factory=dict)
