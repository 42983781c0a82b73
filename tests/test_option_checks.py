"""Every number of a run's options is refused where it makes no sense, or stands in a list here."""

import dataclasses
import math

import pytest

from groundfuse.backend.option_checks import check_numbers
from groundfuse.tools.errors import TeamError
from groundfuse.tools.fuse_team import RunOptions
from groundfuse.tools.settings import option_names, with_settings

OFF_AT_0 = {
    "bundle.min_link_share",
    "bundle.observed_share",
    "front_end.features.contrast_threshold",
    "front_end.features.sigma_image_px",
    "front_end.match.consensus.refinements",
    "front_end.match.rigid_tolerance_heights",
    "front_end.match.scale_sigmas",
    "front_end.match.tolerance_sigmas",
    "front_end.motion.max_ambiguity",
    "front_end.pairs.max_skip",
    "front_end.pairs.predicted.least_pairs",
    "front_end.pairs.predicted.near_edges",
    "front_end.pairs.predicted.num_frames",
    "front_end.pairs.retrieval.least_votes",
    "front_end.pairs.retrieval.num_frames",
    "front_end.pairs.retrieval.num_others",
    "front_end.paper.corners.harris_k",
    "front_end.paper.corners.min_corners",
    "front_end.paper.decomposition.min_sin_theta",
    "front_end.paper.invariants.contrast_radius_cells",
    "front_end.paper.min_inlier_ratio",
    "front_end.paper.segments.length_tolerance_ratio",
    "front_end.paper.segments.min_correlation",
    "more_looks",
    "mosaic.keep_within_cells",
    "mosaic.keep_within_levels",
    "team.max_cuts",
    "team.max_trials",
    "team.refine_below",
    "team.rival_trust",
    "team.voting.max_alternatives",
}
"""What 0 switches off or leaves out."""
OF_ANY_SIGN = {"front_end.paper.segments.min_correlation"}
LIMITS = {
    "front_end.match.max_log_size",
    "front_end.match.rigid_tolerance_heights",
    "front_end.motion.fit.cauchy_sigmas",
    "front_end.motion.fit.gate_sigmas",
    "front_end.motion.max_ambiguity",
    "front_end.motion.max_attitude_chi2",
    "front_end.motion.max_noise",
    "front_end.motion.max_photometric_chi2",
    "front_end.motion.max_sigma_heights",
    "front_end.motion.photometric.max_residual",
    "front_end.motion.photometric.max_stretch",
    "front_end.odometry_gate_sigmas",
    "front_end.paper.refine.max_difference",
    "front_end.paper.segments.max_length",
    "mosaic.num_sigmas",
}
"""What infinity switches off."""


def holder(options, name):
    """The options that a field is of, and its own name."""
    *path, last = name.split(".")
    for part in path:
        options = getattr(options, part)
    return options, last


def numeric(name):
    options, last = holder(RunOptions(), name)
    (kind,) = (f.type for f in dataclasses.fields(options) if f.name == last)
    return kind in {int, float, float | None, tuple[float, ...]}


NUMBERS = [name for name in option_names(RunOptions()) if numeric(name)]
WHOLE = [n for n in NUMBERS if isinstance(getattr(*holder(RunOptions(), n)), int)]


def refusal(name, number):
    """Why an option can't be this number; None where it can."""
    options, last = holder(RunOptions(), name)
    value = (number,) if isinstance(getattr(options, last), tuple) else number
    try:
        dataclasses.replace(options, **{last: value})
    except ValueError as error:
        return str(error)
    return None


def test_every_number_of_a_run_is_found():
    plain = option_names(RunOptions())
    others = [name for name in plain if name not in NUMBERS]
    assert {type(getattr(*holder(RunOptions(), n))).__name__ for n in others} == {
        "Matcher",
        "Refine",
        "bool",
        "str",
    }
    assert len(NUMBERS) > 100
    assert set(NUMBERS) >= OFF_AT_0 | OF_ANY_SIGN | LIMITS


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_below_0_and_none_at_all_are_refused_by_name(name):
    last = name.rpartition(".")[2]
    if name in OF_ANY_SIGN:
        assert refusal(name, -1) is None
    else:
        assert (refusal(name, -1) or "").startswith(f"{last} must ")
        assert (refusal(name, -1) or "").endswith(", got -1")
    why = refusal(name, math.nan)
    assert (why or "").startswith(f"{last} must ")
    assert (why or "").endswith(", got nan")


@pytest.mark.parametrize("name", NUMBERS)
def test_0_is_refused_but_where_it_is_told_what_it_means(name):
    why = refusal(name, 0)
    if name in OFF_AT_0:
        assert why is None
    else:
        assert (why or "").startswith(f"{name.rpartition('.')[2]} must ")
        assert (why or "").endswith(", got 0")


@pytest.mark.parametrize("name", NUMBERS)
def test_infinity_is_for_limits(name):
    assert (refusal(name, math.inf) is None) == (name in LIMITS)


@pytest.mark.parametrize("name", WHOLE)
def test_counts_are_whole(name):
    assert (refusal(name, 2.5) or "").startswith(f"{name.rpartition('.')[2]} must be ")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Some:
    count: int = 1
    share: float = 0.5
    free: float = 1.0
    widths: tuple[float, ...] = (1.0, 2.0)
    cell_m: float | None = None
    on: bool = False
    kind: str = ""

    def __post_init__(self):
        check_numbers(
            self,
            may_be_zero=("share",),
            may_be_inf=("cell_m",),
            may_be_negative=("free",),
            shares=("share",),
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 0}, "count must be positive, got 0"),
        ({"count": 1.5}, "count must be a whole number, got 1.5"),
        ({"count": math.inf}, "count must be finite, got inf"),
        ({"share": 1.01}, "share must lie within 0 to 1, got 1.01"),
        ({"share": -0.01}, "share must lie within 0 to 1, got -0.01"),
        ({"free": math.nan}, "free must be a number, got nan"),
        ({"widths": (1.0, 0.0)}, "widths must be positive, got 0"),
        ({"cell_m": 0.0}, "cell_m must be positive, got 0"),
    ],
)
def test_what_a_number_needs_is_said(change, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        Some(**change)


@pytest.mark.parametrize(
    "change", [{"share": 0.0}, {"share": 1.0}, {"free": -9.0}, {"cell_m": math.inf}, {"count": 3.0}]
)
def test_what_is_named_is_allowed(change):
    (name,) = change
    assert getattr(Some(**change), name) == change[name]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("match.num_neighbours=0", "num_neighbours must be positive, got 0"),
        ("pairs.retrieval.num_words=0", "num_words must be positive, got 0"),
        ("match.consensus.max_turn_rad=4", "max_turn_rad must be pi at most, got 4"),
    ],
)
def test_the_command_line_says_it_in_one_line(setting, message):
    name = setting.partition("=")[0]
    with pytest.raises(TeamError) as caught:
        with_settings(RunOptions(), [f"front_end.{setting}"])
    assert str(caught.value) == f"--set front_end.{name}: {message}"


def test_rounds_of_ever_the_same_are_refused():
    assert refusal("team.robust.growth", 1.0) == "growth must be above 1, got 1"
