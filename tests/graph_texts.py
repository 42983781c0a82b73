"""Random graphs for the readers' tests, and every way to spoil a text."""

from hypothesis import strategies as st

from groundfuse.backend.graph_lines import Edge, Graph
from groundfuse.backend.measurement import Se2

finite = st.floats(allow_nan=False, allow_infinity=False, width=64)
positive = st.floats(1e-3, 1e3)
poses = st.builds(Se2, finite, finite, finite)
keys = st.one_of(st.integers(0, 9), st.integers(65 << 56, (65 << 56) + 5), st.just(2**64 - 1))


@st.composite
def graphs(draw):
    """Graphs with any ids, full information matrices and FIX lines."""
    ids = draw(st.lists(keys, min_size=2, max_size=6, unique=True))
    vertices = {key: draw(poses) for key in ids}
    edges = []
    for _ in range(draw(st.integers(0, 5))):
        a, b = draw(st.lists(st.sampled_from(ids), min_size=2, max_size=2, unique=True))
        edges.append(Edge(a, b, draw(poses), draw(informations())))
    fixed = draw(st.lists(st.sampled_from(ids), max_size=2))
    return Graph(vertices, tuple(edges), tuple(fixed))


@st.composite
def informations(draw):
    """Upper triangles: positive definite by Gershgorin, off-diagonals below a third."""
    x, y, t = draw(positive), draw(positive), draw(positive)
    bound = min(x, y, t) / 3.0
    off = [draw(st.floats(-bound, bound)) for _ in range(3)]
    return (x, off[0], off[1], y, off[2], t)


@st.composite
def spoiled(draw, text, words):
    """A text with a line dropped, doubled, moved, cut short or changed in one word."""
    lines = text.splitlines()
    k = draw(st.integers(0, len(lines) - 1))
    match draw(st.sampled_from(["drop", "double", "cut", "word", "insert", "join", "end"])):
        case "drop":
            del lines[k]
        case "double":
            lines.insert(k, lines[k])
        case "cut":
            lines[k] = lines[k][: draw(st.integers(0, len(lines[k])))]
        case "word":
            parts = lines[k].split(" ")
            parts[draw(st.integers(0, len(parts) - 1))] = draw(st.sampled_from(words))
            lines[k] = " ".join(parts)
        case "insert":
            lines.insert(k, draw(st.text(alphabet="VERTEX2_SEDGFI#0123456789.-+einfa ")))
        case "join":
            lines[k : k + 2] = ["".join(lines[k : k + 2])]
        case "end":
            return text[: draw(st.integers(0, len(text)))]
    return "\n".join(lines)


def told(read, text):
    """The refusal, or None."""
    try:
        read(text)
    except ValueError as error:
        return str(error)
    return None


def rows(text):
    """What a text says: its words line by line, comments and empty lines left out."""
    parts = (line.split("#", 1)[0].split() for line in text.splitlines())
    return [words for words in parts if words]
