"""Options of the front-end, and what goes with each matcher."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend import paper_matcher, sift_matcher
from groundfuse.frontend.features import FeatureOptions
from groundfuse.frontend.motion import MotionOptions
from groundfuse.frontend.overhead_view import raster_cell_m
from groundfuse.frontend.pairs import PairOptions
from groundfuse.tools.robot import Robot


class Matcher(StrEnum):
    """Matchers by name."""

    SIFT = "sift"
    FAST = "fast"
    PAPER = "paper"


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontEndOptions:
    """Options of the front-end.

    Attributes:
        matcher: which matcher compares two frames.
        features: detection.
        match: the default matcher.
        paper: the paper's matcher.
        motion: when a fitted motion is believed.
        pairs: which pairs are tried.
        photometric: refine every accepted motion from grey values.
        odometry_gate_sigmas: a motion must lie within this many sigmas of the odometry, if any.
    """

    matcher: Matcher = Matcher.SIFT
    features: FeatureOptions = field(default_factory=FeatureOptions)
    match: sift_matcher.MatchOptions = field(default_factory=sift_matcher.MatchOptions)
    paper: paper_matcher.PaperOptions = field(default_factory=paper_matcher.PaperOptions)
    motion: MotionOptions = field(default_factory=MotionOptions)
    pairs: PairOptions = field(default_factory=PairOptions)
    photometric: bool = False
    odometry_gate_sigmas: float = 4.0

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_inf=("odometry_gate_sigmas",))


def with_matcher(options: FrontEndOptions, matcher: Matcher) -> FrontEndOptions:
    """Return the options with a matcher and what goes with it: `fast` is ORB plus light."""
    if matcher is Matcher.FAST:
        features = replace(options.features, kind="orb")
        return replace(options, matcher=matcher, features=features, photometric=True)
    return replace(options, matcher=matcher)


def comparable(options: FrontEndOptions, robots: Sequence[Robot]) -> FrontEndOptions:
    """Give the paper's matcher one overhead cell for the whole team: it compares equal cells only.

    The coarsest camera's cell serves all; a cell that was asked for stays.
    """
    overhead = options.paper.overhead
    if options.matcher is not Matcher.PAPER or overhead.m_per_px is not None:
        return options
    cell_m = max(raster_cell_m(robot.camera, overhead) for robot in robots)
    return replace(
        options, paper=replace(options.paper, overhead=replace(overhead, m_per_px=cell_m))
    )
