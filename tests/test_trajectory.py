"""TUM text: planar poses come back to the last digit but one, faults are told with their line."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend.measurement import Se2
from groundfuse.backend.trajectory import parsed_tum, tum_text

# Half angles through sine, cosine and atan2: a few units of the last place of pi; worst seen 9e-16.
ANGLE = 1e-14

number = st.floats(-1e6, 1e6)
pose = st.builds(Se2, number, number, st.floats(-math.pi, math.pi))


@given(st.lists(st.tuples(number, pose)))
def test_what_is_written_is_read(stamped):
    read = parsed_tum(tum_text(stamped))
    assert [(t, p.x_m, p.y_m) for t, p in read] == [(t, p.x_m, p.y_m) for t, p in stamped]
    for (_, one), (_, two) in zip(read, stamped, strict=True):
        turn = math.remainder(one.theta_rad - two.theta_rad, 2 * math.pi)
        assert abs(turn) < ANGLE


def test_the_line_is_that_of_the_format():
    (line,) = tum_text([(1.5, Se2(2.0, -3.0, math.pi / 2))]).splitlines()[1:]
    values = [float(word) for word in line.split()]
    half = math.sqrt(0.5)
    assert values == pytest.approx([1.5, 2.0, -3.0, 0.0, 0.0, 0.0, half, half])


def test_either_sign_of_a_quaternion_is_the_same_heading():
    (one,), (two,) = (parsed_tum(f"0 0 0 0 0 0 {s * 0.6} {s * 0.8}") for s in (1, -1))
    assert one[1].theta_rad == pytest.approx(two[1].theta_rad)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# head\n1 2 3", "line 2: needs time_s x y z qx qy qz qw, got 3 numbers"),
        ("0 0 0 0 0 0 0 1 0", "line 1: needs time_s .*, got 9 numbers"),
        ("0 0 0 0 0 0 0 one", "line 1: could not convert string to float: 'one'"),
        ("0 nan 0 0 0 0 0 1", "line 1: every number must be finite"),
        ("0 0 0 0 0 0 0 2", "line 1: quaternion must have unit length, got 2"),
        ("0 0 0 0 0.6 0 0 0.8", "line 1: pose leans out of the plane, qx 0.6 qy 0"),
    ],
)
def test_faults_are_told_with_their_line(text, message):
    with pytest.raises(ValueError, match=message):
        parsed_tum(text)


def test_height_is_ignored_and_blank_lines_too():
    assert parsed_tum("\n0 1 2 55 0 0 0 1  # here\n") == [(0.0, Se2(1.0, 2.0, 0.0))]
