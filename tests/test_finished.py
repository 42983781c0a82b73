"""Work that writes files is done once, and again as soon as a file is not as it was left."""

import pytest

from groundfuse.tools.finished import unless_finished
from groundfuse.tools.store import Store


@pytest.fixture
def out(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "before.txt").write_text("there already")
    return tmp_path


class Work:
    """Writes three files, one over an old one, and counts how often."""

    def __init__(self, out):
        self.out, self.count = out, 0

    def __call__(self):
        self.count += 1
        for name in ("a.png", "sub/b.png", "before.txt"):
            (self.out / name).write_text(f"{name} as made")


MADE = {"a.png", "sub/b.png", "before.txt"}
NAMES = "a*", "sub/*.png", "before.txt"


def test_the_second_time_all_is_there(out):
    store, work = Store(), Work(out)
    assert unless_finished(store, out, "picture", (1,), NAMES, work) == set()
    (out / "other.txt").write_text("whatever else is written")
    assert unless_finished(store, out, "picture", (1,), NAMES, work) == MADE
    assert work.count == 1


@pytest.mark.parametrize("spoil", ["sub/b.png", "a.png"])
def test_a_file_that_is_gone_or_changed_is_made_again(out, spoil):
    store, work = Store(), Work(out)
    unless_finished(store, out, "picture", (1,), NAMES, work)
    (out / spoil).write_text("drawn over")
    assert unless_finished(store, out, "picture", (1,), NAMES, work) == set()
    (out / spoil).unlink()
    assert unless_finished(store, out, "picture", (1,), NAMES, work) == set()
    assert work.count == 3
    assert unless_finished(store, out, "picture", (1,), NAMES, work) == MADE


def test_other_inputs_another_kind_or_another_folder_are_other_work(out, tmp_path_factory):
    store, work = Store(), Work(out)
    unless_finished(store, out, "picture", (1,), NAMES, work)
    unless_finished(store, out, "picture", (2,), NAMES, work)
    unless_finished(store, out, "drawing", (1,), NAMES, work)
    assert work.count == 3
    other = tmp_path_factory.mktemp("other")
    (other / "sub").mkdir()
    elsewhere = Work(other)
    assert unless_finished(store, other, "picture", (1,), NAMES, elsewhere) == set()
    assert elsewhere.count == 1


def test_work_that_fails_is_not_finished(out):
    store, work = Store(), Work(out)

    def failing():
        work()
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        unless_finished(store, out, "picture", (1,), NAMES, failing)
    assert unless_finished(store, out, "picture", (1,), NAMES, work) == set()
    assert work.count == 2


def test_what_others_write_meanwhile_is_not_of_the_work(out):
    store, work = Store(), Work(out)
    names = "sub/*.png", "a.png"  # and not before.txt, which the work writes, too
    unless_finished(store, out, "picture", (1,), names, work)
    (out / "before.txt").write_text("written over")
    assert unless_finished(store, out, "picture", (1,), names, work) == {"a.png", "sub/b.png"}
