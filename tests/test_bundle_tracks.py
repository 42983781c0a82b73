"""Floor points out of pairs: joining, contradictions, thinning, listing."""

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend.bundle_tracks import (
    Links,
    Sightings,
    matched,
    observations,
    single_links,
    tracks,
)
from groundfuse.backend.measurement import Correspondences, FrameId, RelativePose, Se2

FRAMES = [FrameId("A", index) for index in range(4)]
INDEX_OF = {frame: index for index, frame in enumerate(FRAMES)}


def edge(a, b, keypoints_a, keypoints_b, sigma=1e-3):
    """An edge whose keypoints are known by number: ray (number, frame)."""

    def rays(frame, numbers):
        return np.array([(float(n), float(frame)) for n in numbers]).reshape(-1, 2)

    sigmas = np.full(len(keypoints_a), sigma)
    pair = Correspondences(rays(a, keypoints_a), rays(b, keypoints_b), sigmas, sigmas)
    return RelativePose(FRAMES[a], FRAMES[b], Se2(0, 0, 0), np.eye(3), len(sigmas), 0.0, pair)


def keypoints(edges):
    found = matched(edges, INDEX_OF)
    return found.sightings, found.links


def joined(*edges):
    sightings, links = keypoints(edges)
    used, point = tracks(links, sightings)
    groups = {}
    for sighting, number in zip(used.tolist(), point.tolist(), strict=True):
        keypoint = int(sightings.ray[sighting, 0])
        groups.setdefault(number, set()).add((int(sightings.frame[sighting]), keypoint))
    return sorted(map(sorted, groups.values()))


def test_a_keypoint_of_several_pairs_is_one_sighting():
    edges = [edge(0, 1, [7, 8], [3, 4]), edge(0, 2, [7], [5]), edge(3, 0, [1], [8])]
    sightings, links = keypoints(edges)
    assert len(sightings) == 6
    assert links.edge.tolist() == [0, 0, 1, 2]
    assert links.a[0] == links.a[2]
    assert links.a[1] == links.b[3]
    got = [tuple(map(int, sightings.ray[n])) for n in links.b[:3]]
    assert got == [(3, 1), (4, 1), (5, 2)]


def test_the_same_ray_in_two_frames_is_two_sightings():
    pair = edge(0, 1, [2], [2])
    same = Correspondences(
        pair.correspondences.rays_a, pair.correspondences.rays_a, np.ones(1), np.ones(1)
    )
    edges = [RelativePose(FRAMES[0], FRAMES[1], Se2(0, 0, 0), np.eye(3), 1, 0.0, same)]
    sightings, links = keypoints(edges)
    assert len(sightings) == 2
    assert links.a[0] != links.b[0]


def test_a_keypoints_sigma_is_the_root_mean_square_over_its_pairs():
    edges = [edge(0, 1, [7], [3], 1e-3), edge(0, 2, [7], [5], 3e-3)]
    sightings, links = keypoints(edges)
    np.testing.assert_allclose(sightings.sigma[links.a[0]], np.sqrt(5.0) * 1e-3, rtol=1e-14)


def test_edges_without_pictures_have_no_links():
    bare = RelativePose(FRAMES[0], FRAMES[1], Se2(0, 0, 0), np.eye(3))
    sightings, links = keypoints([bare, edge(0, 1, [1], [1])])
    assert links.edge.tolist() == [1]
    sightings, links = keypoints([bare])
    assert len(sightings) == len(links) == 0


def test_some_of_the_edges_are_numbered_anew():
    edges = [edge(0, 1, [7], [3]), edge(1, 2, [5, 6], [4, 2]), edge(0, 2, [7], [2])]
    kept = np.array([False, True, True])
    some, alone = matched(edges, INDEX_OF).only_edges(kept), matched(edges[1:], INDEX_OF)
    assert some.links.edge.tolist() == alone.links.edge.tolist() == [0, 0, 1]
    for end in ("a", "b"):
        rays = [m.sightings.ray[getattr(m.links, end)].tolist() for m in (some, alone)]
        assert rays[0] == rays[1]


def test_links_join_over_frames():
    assert joined(edge(0, 1, [1, 2], [1, 2]), edge(1, 2, [1], [9]), edge(2, 3, [9], [4])) == [
        [(0, 1), (1, 1), (2, 9), (3, 4)],
        [(0, 2), (1, 2)],
    ]


def test_a_point_seen_twice_by_a_frame_loses_those_sightings():
    # 0 and 1 agree on the point, 2 shows it in two places.
    contradiction = [edge(0, 1, [1], [1]), edge(1, 2, [1], [5]), edge(0, 2, [1], [6])]
    assert joined(*contradiction) == [[(0, 1), (1, 1)]]
    # With one frame left there is nothing to compare.
    assert joined(edge(1, 2, [1, 1], [5, 6]), edge(0, 3, [2], [2])) == [[(0, 2), (3, 2)]]


@given(st.integers(1, 6), st.integers(0, 40), st.integers(0, 99))
def test_observations_list_every_pair_once(num_frames, num_points, seed):
    rng = np.random.default_rng(seed)
    sees = rng.random((num_frames, num_points)) < 0.5
    frame, point = np.nonzero(sees)
    order = rng.permutation(len(frame))
    frame, point = frame[order], point[order]
    sightings = Sightings(frame, rng.random((len(frame), 2)), np.ones(len(frame)))
    seen = observations(sightings, np.arange(len(frame)), point, num_frames)
    assert (np.diff(seen.frame) >= 0).all()
    for number in range(num_frames):
        part = slice(seen.frame_start[number], seen.frame_start[number + 1])
        assert (seen.frame[part] == number).all()
        assert (seen.frame == number).sum() == part.stop - part.start
    expected = {
        (i, j, p)
        for p in range(num_points)
        for i, j in itertools.combinations(np.flatnonzero(sees[:, p]).tolist(), 2)
    }
    got = []
    for key, start, end in zip(
        seen.pair_key, seen.pair_start[:-1], seen.pair_start[1:], strict=True
    ):
        for i, j in zip(seen.pair_i[start:end], seen.pair_j[start:end], strict=True):
            assert seen.frame[i] * num_frames + seen.frame[j] == key
            assert seen.point[i] == seen.point[j]
            got.append((int(seen.frame[i]), int(seen.frame[j]), int(seen.point[i])))
    assert len(got) == len(expected)
    assert set(got) == expected


def test_single_links_share_nothing():
    links = Links(np.array([4, 4]), np.array([5, 6]), np.array([0, 1]))
    used, point = single_links(links)
    assert used.tolist() == [4, 4, 5, 6]
    assert point.tolist() == [0, 1, 0, 1]
