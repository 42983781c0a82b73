"""Parts of correspondences and floor points: how many, and never by order or name."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend.bundle_sample import sampled, thinned
from groundfuse.backend.bundle_tracks import Links, Sightings


def star(sizes, seed=0):
    """A frame paired with others: `sizes` links each, with keypoints of their own."""
    rng = np.random.default_rng(seed)
    total = sum(sizes)
    edge = np.repeat(np.arange(len(sizes)), sizes)
    frame = np.concatenate([np.zeros(total, dtype=np.int64), edge + 1])
    sightings = Sightings(frame, rng.random((2 * total, 2)), np.ones(2 * total))
    return Links(np.arange(total), total + np.arange(total), edge), sightings


def test_thinning_keeps_about_the_quota_of_each_pair():
    sizes = [20, 400, 1000, 4000]
    links, sightings = star(sizes)
    kept = np.bincount(links.edge[thinned(links, sightings, 200)], minlength=4)
    # The other frames have one pair each and ask for 200 of it; a binomial spreads by sqrt(200).
    assert kept[0] == 20
    assert (np.abs(kept[1:] - 200) < 5 * np.sqrt(200)).all()


def test_a_frame_of_many_pairs_takes_part_of_each():
    rng = np.random.default_rng(2)
    total = 3 * 2000
    edge = np.repeat([0, 1, 2], 2000)
    first, second = np.array([0, 0, 1])[edge], np.array([1, 2, 2])[edge]
    frame = np.concatenate([first, second])
    sightings = Sightings(frame, rng.random((2 * total, 2)), np.ones(2 * total))
    links = Links(np.arange(total), total + np.arange(total), edge)
    kept = np.bincount(edge[thinned(links, sightings, 1000)])
    assert (np.abs(kept - 500) < 5 * np.sqrt(500)).all()


@given(st.integers(1, 300), st.integers(0, 99))
def test_order_and_direction_of_links_do_not_matter(most, seed):
    links, sightings = star([30, 120, 7], seed)
    kept = thinned(links, sightings, most)
    order = np.concatenate([np.flatnonzero(links.edge == e) for e in (2, 0, 1)])
    number = np.array([1, 2, 0])[links.edge[order]]
    turned = Links(links.b[order], links.a[order], number)
    np.testing.assert_array_equal(thinned(turned, sightings, most), kept[order])


@given(st.integers(2, 8), st.integers(1, 60), st.integers(1, 30), st.integers(0, 99))
def test_a_sample_keeps_points_whole(num_frames, num_points, most, seed):
    rng = np.random.default_rng(seed)
    frame, point = np.nonzero(rng.random((num_frames, num_points)) < 0.5)
    sightings = Sightings(frame, rng.random((len(frame), 2)), np.ones(len(frame)))
    if len(frame) == 0:
        return
    _, point = np.unique(point, return_inverse=True)
    used, number = sampled(np.arange(len(frame)), point, sightings, most)
    kept = set(point[used].tolist())
    assert len(used) == np.isin(point, list(kept)).sum()  # all sightings of a kept point
    assert len(set(zip(number.tolist(), point[used].tolist(), strict=True))) == len(kept)
    assert set(number.tolist()) == set(range(len(kept)))
    if (np.bincount(frame) <= most).all():
        assert len(used) == len(frame)


def test_a_sample_leaves_frames_rich():
    rng = np.random.default_rng(3)
    frame, point = np.nonzero(rng.random((6, 5000)) < 0.4)
    sightings = Sightings(frame, rng.random((len(frame), 2)), np.ones(len(frame)))
    used, _ = sampled(np.arange(len(frame)), point, sightings, 300)
    kept = np.bincount(frame[used])
    assert (np.abs(kept - 300) < 5 * np.sqrt(300)).all()


def test_a_sample_does_not_depend_on_numbers():
    rng = np.random.default_rng(4)
    frame, point = np.nonzero(rng.random((5, 200)) < 0.4)
    ray = rng.random((len(frame), 2))
    used, _ = sampled(np.arange(len(frame)), point, Sightings(frame, ray, np.ones(len(frame))), 30)
    order, names, numbers = rng.permutation(len(frame)), rng.permutation(5), rng.permutation(200)
    other = Sightings(names[frame[order]], ray[order], np.ones(len(frame)))
    again, _ = sampled(np.arange(len(frame)), numbers[point[order]], other, 30)
    assert set(order[again].tolist()) == set(used.tolist())
