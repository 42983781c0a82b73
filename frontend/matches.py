"""What every matcher gives: correspondences with a start for the motion, or why there are none."""

import math
from dataclasses import dataclass

from groundfuse.backend.measurement import Correspondences, Reason, Se2


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Floor points found in both pictures, mostly right.

    Attributes:
        correspondences: the inliers, as rays of both cameras.
        a_from_b: foot of b in the foot frame of a; a start for the motion fit, not its result.
        ambiguity: votes of the second-best distinct motion over those of the best, 0 to 1; near 1
            the floor repeats and the motion cannot be trusted.
    """

    correspondences: Correspondences
    a_from_b: Se2
    ambiguity: float

    def __post_init__(self) -> None:
        """Refuse arrays of unequal length and a ratio outside 0 to 1 (ValueError)."""
        found = self.correspondences
        rays, sigmas = (found.rays_a, found.rays_b), (found.sigma_a, found.sigma_b)
        count = len(found)
        if {r.shape for r in rays} != {(count, 2)} or {s.shape for s in sigmas} != {(count,)}:
            shapes = ", ".join(str(array.shape) for array in (*rays, *sigmas))
            raise ValueError(f"correspondences must be (n, 2) and (n,), got shapes {shapes}")
        if not (math.isfinite(self.ambiguity) and 0.0 <= self.ambiguity <= 1.0):
            raise ValueError(f"ambiguity must lie in [0, 1], got {self.ambiguity}")


@dataclass(frozen=True, slots=True)
class Miss:
    """A pair without matches.

    Attributes:
        reason: why.
        value: the number that was found.
        limit: the number that was needed.
    """

    reason: Reason
    value: float
    limit: float
