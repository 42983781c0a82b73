"""The median of many values, quickly."""

import numpy as np

from groundfuse.frontend.arrays import Floats


def middle(values: Floats) -> Floats:
    """Return the median along the last axis (..., n), of two the higher.

    One place is found far quicker than the two that numpy.median looks for.
    """
    place = values.shape[-1] // 2
    found: Floats = np.partition(values, place)[..., place]
    return found
