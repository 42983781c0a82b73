"""JRL: exact round trips, gtsam's own keys and noise, what the library writes, every fault."""

import copy
import json

import gtsam
import numpy as np
import pytest
from graph_texts import informations, poses, told
from hypothesis import given, settings
from hypothesis import strategies as st

from groundfuse.backend import jrl, jrl_reader
from groundfuse.backend.graph_lines import matrix
from groundfuse.backend.measurement import Se2

UNIT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
JUNK = [
    None,
    True,
    -1,
    2**64,
    0.5,
    "x",
    "NaN",
    [],
    {},
    [1],
    {"x": 1},
    10**400,
    "BetweenFactorPose3",
]


def key(letter, index):
    return gtsam.symbol(letter, index)


@st.composite
def covariances(draw):
    return tuple(matrix(draw(informations())).ravel().tolist())


@st.composite
def datasets(draw):
    robots = draw(st.lists(st.sampled_from("abAZ"), min_size=1, max_size=3, unique=True))
    own = st.sampled_from([key(r, k) for r in robots for k in range(3)])
    measurements, factors = {}, {}
    for robot in robots:
        entries = []
        for _ in range(draw(st.integers(0, 2))):
            made = []
            for _ in range(draw(st.integers(0, 2))):
                if draw(st.booleans()):
                    made.append(jrl.Prior(draw(own), draw(poses), draw(covariances())))
                else:
                    a, b = draw(st.lists(own, min_size=2, max_size=2, unique=True))
                    made.append(jrl.Between(a, b, draw(poses), draw(covariances())))
            entries.append(jrl.Entry(draw(st.integers(0, 2**64 - 1)), tuple(made)))
        measurements[robot] = tuple(entries)
        pairs = [(i, j) for i, e in enumerate(entries) for j in range(len(e.measurements))]
        factors[robot] = tuple(draw(st.lists(st.sampled_from(pairs), max_size=2)) if pairs else ())
    values = st.one_of(
        st.none(),
        st.fixed_dictionaries({r: st.dictionaries(own, poses, max_size=2) for r in robots}),
    )
    wrong = draw(st.sampled_from([None, factors, {}]))
    name = draw(st.text(max_size=5))
    return jrl.Dataset(
        name, tuple(robots), measurements, draw(values), draw(values), factors, wrong
    )


@settings(max_examples=60)
@given(datasets())
def test_every_digit_survives(dataset):
    assert jrl_reader.parsed(jrl.text_of(dataset)) == dataset


def places(content, path=()):
    """Every place of a JSON text."""
    yield path
    if isinstance(content, dict):
        for name in content:
            yield from places(content[name], (*path, name))
    elif isinstance(content, list):
        for k in range(len(content)):
            yield from places(content[k], (*path, k))


def spoil(content, path, draw):
    """Drop, double, rename or replace what stands at a place."""
    if not path:
        return draw(st.sampled_from(JUNK))
    content = copy.deepcopy(content)
    inner = content
    for step in path[:-1]:
        inner = inner[step]
    match draw(st.sampled_from(["drop", "double", "rename", "replace"])):
        case "drop":
            del inner[path[-1]]
        case "double" if isinstance(inner, list):
            inner.insert(path[-1], inner[path[-1]])
        case "rename" if isinstance(inner, dict):
            inner["more"] = inner.pop(path[-1])
        case _:
            inner[path[-1]] = draw(st.sampled_from(JUNK))
    return content


def whole(content):
    """What a content says, in the writer's own form: empty lists and known tags filled in."""
    robots = [r if isinstance(r, int) else ord(r) for r in content["robots"] or []]
    said = content | {"robots": robots}
    measured = content["measurements"] or {}
    said["measurements"] = {
        r: [
            {"stamp": e["stamp"], "measurements": [typed(m) for m in e.get("measurements") or []]}
            for e in measured.get(r) or []
        ]
        for r in map(chr, robots)
    }
    for name in ("groundtruth", "initialization"):
        if name in content:
            said[name] = {
                r: [v | {"type": "Pose2"} for v in own or []]
                for r, own in (content[name] or {}).items()
            }
    for name in ("potential_outlier_factors", "outlier_factors"):
        if name in content:
            said[name] = {r: own or [] for r, own in (content[name] or {}).items()}
    return said


def typed(measured):
    return {
        name: v | {"type": "Pose2"} if isinstance(v, dict) else v for name, v in measured.items()
    }


@settings(max_examples=80)
@given(datasets(), st.data())
def test_a_spoiled_file_is_refused_or_wholly_read(dataset, data):
    content = json.loads(jrl.text_of(dataset))
    path = data.draw(st.sampled_from(sorted(places(content), key=str)))
    content = spoil(content, path, data.draw)
    text = json.dumps(content)
    if told(jrl_reader.parsed, text) is None:
        assert json.loads(jrl.text_of(jrl_reader.parsed(text))) == whole(content)


@settings(max_examples=60)
@given(datasets(), st.data())
def test_a_file_cut_short_is_refused(dataset, data):
    text = jrl.text_of(dataset).strip()
    cut = data.draw(st.integers(0, len(text) - 1))
    assert told(jrl_reader.parsed, text[:cut]) is not None


# As the library writes it: codes of letters, null for what is empty, types inside of poses.
LIBRARY = """{
 "name": "two", "robots": [97, 98],
 "measurements": {
  "a": [{"stamp": 0, "measurements": [
    {"type": "PriorFactorPose2", "key": 6989586621679009792,
     "prior": {"type": "Pose2", "x": 0, "y": 0, "theta": 0.5},
     "covariance": [1, 0, 0, 0, 1, 0, 0, 0, 1]}]},
   {"stamp": 1, "measurements": null}],
  "b": [{"stamp": 7, "measurements": [
    {"type": "BetweenFactorPose2", "key1": 7061644215716937728, "key2": 6989586621679009792,
     "measurement": {"type": "Pose2", "x": 1.5, "y": -2, "theta": 0.25},
     "covariance": [4, 1, 0, 1, 5, 0, 0, 0, 6]}]}]},
 "groundtruth": {"a": [{"type": "Pose2", "x": 1, "y": 2, "theta": 3, "key": 6989586621679009792}],
                 "b": null},
 "outlier_factors": {"b": [[0, 0]]}}"""


def test_what_the_library_writes_is_read():
    read = jrl_reader.parsed(LIBRARY)
    a0, b0 = key("a", 0), key("b", 0)
    assert read.robots == ("a", "b")
    assert read.measurements["a"] == (
        jrl.Entry(0, (jrl.Prior(a0, Se2(0.0, 0.0, 0.5), UNIT),)),
        jrl.Entry(1, ()),
    )
    (entry,) = read.measurements["b"]
    assert entry.measurements == (
        jrl.Between(b0, a0, Se2(1.5, -2.0, 0.25), (4.0, 1.0, 0.0, 1.0, 5.0, 0.0, 0.0, 0.0, 6.0)),
    )
    assert read.groundtruth == {"a": {a0: Se2(1.0, 2.0, 3.0)}, "b": {}}
    assert (read.initialization, read.potential_outlier_factors) == (None, None)
    assert read.outlier_factors == {"b": ((0, 0),)}


def test_what_the_documents_say_is_read():
    """Letters as texts and values by key, as DATASET_FORMAT and VALUE_FORMAT have it."""
    text = LIBRARY.replace("[97, 98]", '["a", "b"]').replace(
        '[{"type": "Pose2", "x": 1, "y": 2, "theta": 3, "key": 6989586621679009792}]',
        '{"6989586621679009792": {"type": "Pose2", "x": 1, "y": 2, "theta": 3}}',
    )
    assert '["a", "b"]' in text
    assert 'theta": 3}}' in text
    assert jrl_reader.parsed(text) == jrl_reader.parsed(LIBRARY)


def test_a_covariance_is_gtsams():
    """Row after row, order x y theta: the noise that gtsam's factor is given."""
    (entry,) = jrl_reader.parsed(LIBRARY).measurements["b"]
    (measured,) = entry.measurements
    covariance = np.reshape(measured.covariance, (3, 3))
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    assert np.allclose(noise.sigmas() ** 2, [4, 5, 6])
    assert covariance[0, 1] == 1.0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"name": "two", ', "", 'the file: "name" is missing'),
        ('"two"', "2", "name: needs a text, got 2"),
        ('"name": "two"', '"name": "two", "extra": 1', 'the file: unknown member "extra"'),
        ('"name": "two"', '"name": "two", "name": "two"', "'name' is given twice"),
        ("[97, 98]", "[97, 97]", r"robots\[1\]: a is given twice"),
        ("[97, 98]", '[97, "bb"]', r'robots\[1\]: needs a letter or its code, got "bb"'),
        ("[97, 98]", "[97, 7]", r"robots\[1\]: needs a letter or its code, got 7"),
        ("[97, 98]", "[97]", 'measurements: unknown member "b"'),
        ("[97, 98]", "97", "robots: needs a list, got 97"),
        ('"stamp": 7', '"stamp": -7', r"measurements.b\[0\].stamp: needs a whole number .* -7"),
        ('"stamp": 7', '"stamp": 0.5', r"measurements.b\[0\].stamp: needs a whole number .* 0.5"),
        ('"stamp": 7, ', "", r'measurements.b\[0\]: "stamp" is missing'),
        (
            "BetweenFactorPose2",
            "BetweenFactorPose3",
            r"measurements.b\[0\].measurements\[0\]: unknown type BetweenFactorPose3: it is three-",
        ),
        ("BetweenFactorPose2", "RangeFactor2D", "unknown type RangeFactor2D; PriorFactorPose2 and"),
        ('"type": "BetweenFactorPose2", ', "", r'measurements\[0\]: "type" is missing'),
        ('"y": -2', '"y": NaN', "every number must be finite, got NaN"),
        ('"y": -2', '"y": 1e999', "measurement.y: every number must be finite"),
        ('"y": -2', '"y": "2"', 'measurement.y: needs a number, got "2"'),
        ('"y": -2, ', "", r'measurements.b\[0\].measurements\[0\].measurement: "y" is missing'),
        ("7061644215716937728", "6989586621679009792", "an edge needs two different frames"),
        ("[4, 1, 0, 1, 5, 0, 0, 0, 6]", "[4, 1]", "covariance: needs 9 numbers, got 2"),
        ("[4, 1, 0, 1,", "[4, 1, 0, 2,", "covariance: must be symmetric"),
        ("[4, 1, 0, 1, 5", "[4, 1, 0, 1, -5", "covariance: must be positive definite, .* -5.11"),
        ('"Pose2", "x": 1,', '"Point2", "x": 1,', r"groundtruth.a\[0\]: unknown type Point2"),
        ("[[0, 0]]", "[[0, 1]]", r"outlier_factors.b\[0\]: no measurement \[0, 1\]"),
        ("[[0, 0]]", "[[1, 0]]", r"outlier_factors.b\[0\]: no measurement \[1, 0\]"),
        ("[[0, 0]]", "[[0]]", r"outlier_factors.b\[0\]: needs \[entry, measurement\], got \[0\]"),
        ('"b": null', '"c": null', 'groundtruth: unknown member "c"'),
        ('"b": null', '"b": 3', "groundtruth.b: needs a list, got 3"),
        ('"b": null', '"b": {"x": {}}', "groundtruth.b: a key must be a whole number .*, got x"),
        ("{\n", "[\n", "line "),
    ],
)
def test_faults_are_told_with_their_place(old, new, message):
    assert old in LIBRARY
    with pytest.raises(ValueError, match=message):
        jrl_reader.parsed(LIBRARY.replace(old, new, 1))


def test_a_key_twice_is_refused():
    text = LIBRARY.replace('"b": null', '"b": [{"key": 1, "x": 0, "y": 0, "theta": 0}]')
    assert jrl_reader.parsed(text).groundtruth["b"] == {1: Se2(0.0, 0.0, 0.0)}
    twice = '{"key": 1, "x": 0, "y": 0, "theta": 0}'
    with pytest.raises(ValueError, match=r"groundtruth.b\[1\]: key 1 is given twice"):
        jrl_reader.parsed(text.replace(f"[{twice}]", f"[{twice}, {twice}]"))


@pytest.mark.parametrize("text", ["[" * 200_000, '{"a":' * 100_000])
def test_what_nests_too_deeply_is_refused(text):
    with pytest.raises(ValueError, match="nested too deeply"):
        jrl_reader.parsed(text)


@pytest.mark.parametrize("text", ["[]", "3", "null"])
def test_what_is_no_object_is_refused(text):
    with pytest.raises(ValueError, match="the file: needs an object, got"):
        jrl_reader.parsed(text)
