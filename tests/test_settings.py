"""Options by name: every one can be set by the name that options.json shows, or is refused."""

import dataclasses
import enum
import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.tools.errors import TeamError
from groundfuse.tools.fuse_team import RunOptions
from groundfuse.tools.settings import option_names, record, with_settings

NAMES = tuple(option_names(RunOptions()))


class Colour(enum.StrEnum):
    RED = "red"
    BLUE = "blue"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Inner:
    share: float = 0.5
    number: int = 3
    on: bool = False
    word: str = "plain"
    colour: Colour = Colour.RED
    widths: tuple[float, ...] = (3.0, 1.5)
    cell_m: float | None = None

    def __post_init__(self):
        if self.number == 13:
            raise ValueError("number must not be 13")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Outer:
    inner: Inner = dataclasses.field(default_factory=Inner)
    number: int = 7
    size: int = 1


def found(options, name):
    for part in name.split("."):
        options = getattr(options, part)
    return options


def as_text(value):
    if isinstance(value, tuple):
        return ",".join(map(repr, value))
    return str(value)


def refusal(*settings, options=None):
    with pytest.raises(TeamError) as caught:
        with_settings(options or Outer(), settings)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("inner.share=0.25", 0.25),
        ("inner.share=1e-3", 1e-3),
        ("inner.share=inf", math.inf),
        ("inner.share=2", 2.0),
        ("inner.number=12", 12),
        ("inner.on=TRUE", True),
        ("inner.on=false", False),
        ("inner.word=with=equals", "with=equals"),
        ("inner.colour=blue", Colour.BLUE),
        ("inner.widths=4, 2,1", (4.0, 2.0, 1.0)),
        ("inner.cell_m=0.02", 0.02),
        (" inner.size_of = 1", None),
        ("size = 9 ", 9),
    ],
)
def test_a_value_is_read_as_its_type(setting, value):
    if value is None:
        assert refusal(setting).startswith("--set inner.size_of: no option 'size_of'")
        return
    name = setting.partition("=")[0].strip()
    changed = with_settings(Outer(), [setting])
    assert found(changed, name) == value
    assert type(found(changed, name)) is type(value)
    rest = [n for n in option_names(Outer()) if n != name]
    assert [found(changed, n) for n in rest] == [found(Outer(), n) for n in rest]


def test_settings_are_applied_in_order_and_leave_the_given_options_alone():
    before = Outer()
    after = with_settings(before, ["size=2", "inner.share=0.1", "size=3"])
    assert (after.size, after.inner.share) == (3, 0.1)
    assert before == Outer()
    assert with_settings(before, []) == before


@given(st.floats(min_value=0.0, allow_nan=False))
def test_every_digit_of_a_number_survives(value):
    assert with_settings(Outer(), [f"inner.share={value!r}"]).inner.share == value


@pytest.mark.parametrize("name", [n for n in NAMES if found(RunOptions(), n) is not None])
def test_every_option_of_a_run_can_be_set_by_its_name(name):
    """Its own value changes nothing; another number arrives at the right place and only there."""
    value = found(RunOptions(), name)
    assert with_settings(RunOptions(), [f"{name}={as_text(value)}"]) == RunOptions()
    if isinstance(value, int | float) and not isinstance(value, bool):
        other = 2 * value or 1 if isinstance(value, int) else 0.75 * value or 1.0
        changed = with_settings(RunOptions(), [f"{name}={as_text(other)}"])
        assert found(changed, name) == other
        assert [n for n in NAMES if found(changed, n) != found(RunOptions(), n)] == [name]


def test_the_record_is_json_with_every_option_by_its_name():
    content = json.loads(json.dumps(record(RunOptions())))
    for name in NAMES:
        value = content
        for part in name.split("."):
            value = value[part]
        assert value == json.loads(json.dumps(found(RunOptions(), name)))
    assert set(content) == {"front_end", "team", "patches", "bundle", "more_looks", "mosaic"}


def test_option_names_are_in_the_records_order():
    inner = [f"inner.{field.name}" for field in dataclasses.fields(Inner)]
    assert list(option_names(Outer())) == [*inner, "number", "size"]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("size", "--set size: needed STAGE.OPTION=VALUE"),
        ("sise=1", "--set sise: no option 'sise' (did you mean 'size'?)"),
        ("iner.share=1", "--set iner.share: did you mean inner.share?"),
        ("share=1", "--set share: did you mean inner.share?"),
        ("other.number=1", "--set other.number: did you mean inner.number or number?"),
        (
            "inner.colours=red",
            "--set inner.colours: no option 'colours' (did you mean 'colour'?)",
        ),
        ("zzz=1", "--set zzz: no option 'zzz', known are inner, number, size"),
        ("=1", "--set : no option '', known are inner, number, size"),
        (
            "inner=1",
            (
                "--set inner: names a group of options "
                "(share, number, on, word, colour, widths, cell_m)"
            ),
        ),
        ("size.of=1", "--set size.of: 'size' is an option, not a group"),
        ("inner.number=1.5", "--set inner.number: got '1.5', needed a whole number"),
        ("inner.number=-1", "--set inner.number: got '-1', needed a whole number from 0 on"),
        ("inner.number=13", "--set inner.number: number must not be 13"),
        ("inner.share=", "--set inner.share: got '', needed a number"),
        ("inner.share=0,5", "--set inner.share: got '0,5', needed a number"),
        ("inner.share=nan", "--set inner.share: got 'nan', needed a number from 0 on"),
        ("inner.share=-0.1", "--set inner.share: got '-0.1', needed a number from 0 on"),
        ("inner.widths=3;1", "--set inner.widths: got '3;1', needed a number"),
        ("inner.cell_m=small", "--set inner.cell_m: got 'small', needed a number"),
        ("inner.on=yes", "--set inner.on: got 'yes', needed true or false"),
        ("inner.colour=green", "--set inner.colour: got 'green', needed one of red, blue"),
    ],
)
def test_what_is_refused(setting, message):
    assert refusal(setting) == message


def test_a_stage_s_own_check_is_one_line():
    assert refusal("bundle.min_links=0", options=RunOptions()) == (
        "--set bundle.min_links: min_links must be positive, got 0"
    )
