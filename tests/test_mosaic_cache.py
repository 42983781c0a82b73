"""Pictures are loaded when needed, and only so many are held."""

import threading

import cv2
import numpy as np
import pytest

from groundfuse.frontend.picture_cache import Cache
from groundfuse.frontend.pyramid import halvings, pyramid


def counted_makes(number, size=64):
    calls = [0] * number

    def make(index):
        calls[index] += 1
        return np.full((size, size), index, np.uint8)

    return make, calls


def test_a_held_picture_is_not_loaded_again():
    make, calls = counted_makes(3)
    cache = Cache(make, 10**9)
    for index in (0, 1, 0, 2, 1, 0):
        assert (cache.get(index) == index).all()
    assert calls == [1, 1, 1]


def test_the_longest_unused_goes_when_the_budget_is_spent():
    make, calls = counted_makes(3)
    cache = Cache(make, 2 * 64 * 64)
    for index in (0, 1, 0, 2, 0, 1):  # 2 drops 1, then 1 drops 2
        cache.get(index)
    assert calls == [1, 2, 1]


def test_a_budget_too_small_for_one_picture_still_serves():
    make, calls = counted_makes(2)
    cache = Cache(make, 0)
    assert [int(cache.get(i)[0, 0]) for i in (0, 1, 0, 0)] == [0, 1, 0, 0]
    assert calls == [2, 1]


def test_threads_get_the_right_pictures():
    make, _ = counted_makes(8, size=33)
    cache = Cache(make, 3 * 33 * 33)
    wrong = []

    def work(seed):
        order = np.random.default_rng(seed).integers(0, 8, 200).tolist()
        wrong.extend(i for i in order if not (cache.get(i) == i).all())

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_a_picture_that_two_threads_want_at_once_is_loaded_once():
    calls, asked, found = [], threading.Event(), []

    def make(index):
        calls.append(index)
        assert asked.wait(10.0)
        return np.full(4, index, np.uint8)

    cache = Cache(make, 10**9)
    threads = [threading.Thread(target=lambda: found.append(cache.get(5))) for _ in range(2)]
    for thread in threads:
        thread.start()
    asked.set()
    for thread in threads:
        thread.join()
    assert calls == [5]
    assert found[0] is found[1]


def test_what_loading_raises_comes_through_and_is_tried_again():
    calls = []

    def broken(index):
        calls.append(index)
        raise OSError("gone")

    cache = Cache(broken, 10)
    for _ in range(2):
        with pytest.raises(OSError, match="gone"):
            cache.get(0)
    assert calls == [0, 0]


def test_halvings_keep_the_place_of_pixels():
    u = np.arange(128.0)
    ramp = np.tile(u, (96, 1))[..., None].repeat(3, axis=2).astype(np.uint8)
    made = pyramid(ramp, 9)
    levels = [made.level(k) for k in range(len(made.table))]
    assert [level.shape[:2] for level in levels] == [(96, 128), (48, 64), (24, 32)]
    assert np.array_equal(levels[0][:, 1:-1, :3], ramp[:, 1:-1])
    inner = levels[2][:, 4:-4, 0].astype(float)
    assert np.abs(inner - 4.0 * np.arange(4, 28)).max() <= 0.5
    assert made.nbytes >= sum(level.size for level in levels)


def test_a_grey_picture_has_three_channels_alike():
    grey = np.random.default_rng(1).integers(0, 256, (40, 50), dtype=np.uint8)
    level = pyramid(grey, 0).level(0)
    colour = pyramid(np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)), 0).level(0)
    assert np.array_equal(level[..., :3], colour[..., :3])
    assert np.array_equal(level[..., 0], level[..., 2])


def test_only_the_halvings_asked_for_are_made():
    assert [halvings(x) for x in (0.3, 1.0, 3.9, 4.0, 7.9, 8.0)] == [0, 0, 0, 1, 1, 2]
    picture = np.zeros((200, 300, 3), np.uint8)
    assert [len(pyramid(picture, most).table) for most in (0, 1, 9)] == [1, 2, 4]
