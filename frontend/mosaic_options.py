"""How a mosaic is made, as people choose it."""

from dataclasses import dataclass

from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.selection_compiled import DEEPEST


@dataclass(frozen=True, slots=True, kw_only=True)
class MosaicOptions:
    """How a mosaic is made."""

    m_per_px: float | None = None
    """Side of a cell, m; None: what a quarter of the finest robot's pixels resolve."""
    far_footprint: float = 3.0
    """Floor is used as far as a pixel covers this many times that length of its own robot."""
    max_depth: int = 16
    """Views of a cell that take part in the robust mean; the finest are taken."""
    num_sigmas: float = 3.0
    """Views this near to the mean of the surviving half take part in the final mean, sigmas."""
    compensate: bool = True
    """Estimate and remove differences of exposure, white balance and vignetting."""
    tile_cells: int = 256
    """Side of the square worked on at once, cells."""
    max_cells: int = 2_000_000_000
    """Largest mosaic, cells; a cell that was not asked for grows to meet it."""
    memory_cells: int = 60_000_000
    """Larger mosaics go tile by tile to a file, and their PNG is a reduced preview, cells."""
    cache_bytes: int = 256 * 2**20
    """Pictures held in memory at once, bytes."""
    workers: int = 2
    """Threads; each holds one tile."""
    keep_within_cells: float = 0.1
    """A tile or sample of an earlier run is kept while none of its views, as it was rendered, would
    move by more, cells, and cells keep their size; 0: any change renders anew."""
    keep_within_levels: float = 0.25
    """And while no colour or limit of a view would change by more, levels of a middle grey."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        if not 1 <= self.max_depth <= DEEPEST:
            raise ValueError(f"max_depth must be 1 to {DEEPEST}, got {self.max_depth}")
        zeros = "keep_within_cells", "keep_within_levels"
        check_numbers(self, may_be_inf=("num_sigmas",), may_be_zero=zeros)
