"""Array types by their meaning; the shape stands in each docstring."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""Any float64 array."""
Points = NDArray[np.float64]
"""(n, 2) points: rays x/z, y/z; pixels u, v; or metres x, y."""
Matrix = NDArray[np.float64]
"""(3, 3) homography or rotation."""
Image = NDArray[np.uint8]
"""(rows, columns, 3) BGR or (rows, columns) grey picture."""
Picture32 = NDArray[np.float32]
"""Float picture."""
Mask = NDArray[np.bool_]
"""(n,) or (rows, columns) truth values."""
