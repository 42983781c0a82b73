"""Pictures are loaded when needed, and only so many are held."""

import threading

import numpy as np
import pytest

from groundfuse.frontend.picture_cache import PictureCache


def counted_loads(number, size=64):
    calls = [0] * number

    def load_of(index):
        def load():
            calls[index] += 1
            return np.full((size, size, 3), index, np.uint8)

        return load

    return [load_of(index) for index in range(number)], calls


def test_a_held_picture_is_not_loaded_again():
    loads, calls = counted_loads(3)
    cache = PictureCache(loads, 10**9)
    for index in (0, 1, 0, 2, 1, 0):
        assert (cache.pyramid(index)[0] == index).all()
    assert calls == [1, 1, 1]


def test_the_longest_unused_goes_when_the_budget_is_spent():
    loads, calls = counted_loads(3)
    one = sum(level.nbytes for level in PictureCache(loads, 0).pyramid(0))
    cache = PictureCache(loads, 2 * one)
    calls[:] = [0, 0, 0]
    for index in (0, 1, 0, 2, 0, 1):  # 2 drops 1, then 1 drops 2
        cache.pyramid(index)
    assert calls == [1, 2, 1]


def test_a_budget_too_small_for_one_picture_still_serves():
    loads, calls = counted_loads(2)
    cache = PictureCache(loads, 0)
    assert [int(cache.pyramid(i)[0][0, 0, 0]) for i in (0, 1, 0, 0)] == [0, 1, 0, 0]
    assert calls == [2, 1]


def test_halvings_keep_the_place_of_pixels():
    u = np.arange(128.0)
    ramp = np.tile(u, (96, 1))[..., None].repeat(3, axis=2).astype(np.uint8)
    levels = PictureCache([lambda: ramp], 10**9).pyramid(0)
    assert [level.shape[:2] for level in levels] == [(96, 128), (48, 64), (24, 32)]
    inner = levels[2][:, 4:-4, 0].astype(float)
    assert np.abs(inner - 4.0 * np.arange(4, 28)).max() <= 0.5


def test_the_list_is_the_callers_own():
    loads, _ = counted_loads(1)
    cache = PictureCache(loads, 10**9)
    for _ in range(2):
        cache.pyramid(0).clear()
    assert len(cache.pyramid(0)) > 1


def test_threads_get_the_right_pictures():
    loads, _ = counted_loads(8, size=33)
    cache = PictureCache(loads, 3 * 33 * 33 * 3)
    wrong = []

    def work(seed):
        order = np.random.default_rng(seed).integers(0, 8, 200).tolist()
        wrong.extend(i for i in order if not (cache.pyramid(i)[0] == i).all())

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_what_loading_raises_comes_through():
    def broken():
        raise OSError("gone")

    with pytest.raises(OSError, match="gone"):
        PictureCache([broken], 10).pyramid(0)
