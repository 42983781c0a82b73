"""What the consensus' compiled loops are given."""

from typing import NamedTuple

import numpy as np

from groundfuse.frontend.arrays import Floats, Picture32


class Table(NamedTuple):
    """Candidate matches.

    Attributes:
        places: (n, 4) x and y in foot a, x and y in foot b, metres.
        turned: (n, 2) cosine and sine of the orientation in a minus that in b; nan where features
            have none.
        cumulative: (n,) running sum of the weights that candidates are drawn with.
        starts: (f + 1,) first candidate of each feature of a, and n.
        index_b: (n,) feature of b.
        num_b: features of b.
    """

    places: Floats
    turned: Picture32
    cumulative: Floats
    starts: np.ndarray
    index_b: np.ndarray
    num_b: int


class Limits(NamedTuple):
    """What is asked of a motion, in metres and radians.

    Attributes:
        tolerance_m: distance within which a candidate votes.
        least_cos: least cosine between a motion's turn and that of a candidate.
        max_scale: largest scale and inverse of the least; 1 for the isometry model.
        shortest_m: shortest segment that is drawn.
        distinct_m: motions further apart at the view's centre are distinct.
        distinct_rad: motions that turn this much apart are distinct.
        centre_x_m: the view's centre in foot b.
        centre_y_m: the same.
        gate: (4,) expected motion.
        gate_m: largest distance from it at the view's centre; infinite where nothing is expected.
        gate_m_per_rad: how much more for a turn from it.
        gate_rad: largest turn from it.
    """

    tolerance_m: float
    least_cos: float
    max_scale: float
    shortest_m: float
    distinct_m: float
    distinct_rad: float
    centre_x_m: float
    centre_y_m: float
    gate: Floats
    gate_m: float
    gate_m_per_rad: float
    gate_rad: float
