"""A store does not grow with what no run will ask for again."""

import sqlite3

import pytest
from painted_team import QUICK, painted_pair

from groundfuse.tools import superseded
from groundfuse.tools.fuse_team import main


def entries(store):
    base = sqlite3.connect(store)
    try:
        query = "SELECT kind, label, count(*) FROM entry GROUP BY kind, label"
        return {(kind, label): count for kind, label, count in base.execute(query)}
    finally:
        base.close()


@pytest.mark.parametrize("most", [1, 8])
def test_the_command_forgets_what_is_superseded(tmp_path, monkeypatch, most):
    monkeypatch.setattr(superseded, "MOST_OF_EACH", most)
    words = ["--team", str(painted_pair()), "--out", str(tmp_path), "--quiet", "--no-mosaic"]
    quick = [word for setting in QUICK for word in ("--set", setting)]
    left = []
    for skip in (5, 6, 7):
        assert main([*words, *quick, "--set", f"team.max_skip={skip}"]) == 0
        left.append(entries(tmp_path / "store.sqlite"))
    for whole in (("graphs", "team"), ("graph", "A"), ("graph", "B"), ("bundle", "team")):
        made = left[0][whole]
        assert left[-1][whole] == min(most, 3 * made)
    for kind in ("look", "pair"):
        first, last = ({w: n for w, n in found.items() if w[0] == kind} for found in left[::2])
        assert last == first
