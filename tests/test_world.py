"""The team world: pictures, their light and the truth that is stated about them."""

import math
import pickle

import numpy as np
import pytest
from world_cameras import BARREL, SIGMA, camera

from groundfuse.backend.measurement import FrameId, Se2
from groundfuse.tools.overlap import in_view, true_overlap
from groundfuse.tools.photometry import PLAIN, Photometry, photograph
from groundfuse.tools.world import RobotSpec, make_team, set_scene, wobbled

SPECS = (
    RobotSpec("A", camera(place=Se2(0.1, 0.02, 0.1)), (Se2(0, 0, 0), Se2(0.3, 0.0, 0.4))),
    RobotSpec("B", camera(45.0, lens=BARREL, roll_deg=1.0), (Se2(1.2, 0.3, 3.0),)),
)


@pytest.fixture(scope="module")
def team():
    return make_team("terrazzo", 5, SPECS, PLAIN, num_obstacles=3)


def test_a_team_has_every_picture_and_its_truth(team):
    assert [str(frame.id) for frame in team.frames] == ["A0", "A1", "B0"]
    assert [frame.image.shape for frame in team.frames] == [(120, 160, 3)] * 2 + [(150, 200, 3)]
    assert team.frames[1].world_from_base == Se2(0.3, 0.0, 0.4)
    a, b = FrameId("A", 1), FrameId("B", 0)
    reached = Se2(0.3, 0.0, 0.4) @ team.true_motion(a, b)
    np.testing.assert_allclose(reached.vector(), (1.2, 0.3, 3.0), atol=1e-12)
    assert team.overlaps()[a, b] == team.true_overlap(a, b) == team.true_overlap(b, a) > 0.0
    assert pickle.loads(pickle.dumps(team)).frames[0].attitude == team.frames[0].attitude  # noqa: S301


def test_everything_follows_from_the_seed(team):
    again = make_team("terrazzo", 5, SPECS, PLAIN, num_obstacles=3)
    other = make_team("terrazzo", 6, SPECS[:1], PLAIN)
    assert again.obstacles == team.obstacles
    for frame, same in zip(team.frames, again.frames, strict=True):
        np.testing.assert_array_equal(frame.image, same.image)
        assert frame.attitude == same.attitude
    assert other.frames[0].attitude != team.frames[0].attitude
    assert (other.frames[0].image != team.frames[0].image).mean() > 0.5


def test_obstacles_stand_in_view_and_out_of_the_way():
    many = tuple(Se2(0.3 * k, 0.0, 0.3 * k) for k in range(6))
    scene = set_scene("tiles", 2, [RobotSpec("A", camera(), many)], 5)
    assert len(scene.world.obstacles) == 5
    for solid in scene.world.obstacles:
        at = np.array([[solid.world_from_solid.x_m, solid.world_from_solid.y_m]])
        assert any(in_view(of, at)[0] or true_overlap(of, of) == 0 for of in scene.views[0])
        feet = np.array([[v.world_from_foot.x_m, v.world_from_foot.y_m] for v in scene.views[0]])
        assert np.hypot(*(feet - at).T).min() > 0.3 * 0.55 + solid.radius_m
        assert solid.height_m < 0.55
    assert set_scene("tiles", 2, [RobotSpec("A", camera(), many)], 0).world.obstacles == ()


def test_wobble_is_gaussian_with_the_mounts_sigmas():
    cam, rng = camera(), np.random.default_rng(8)
    drawn = [wobbled(cam, rng) for _ in range(2000)]
    table = np.array([[a.tilt_rad, a.roll_rad, a.height_m] for a in drawn])
    nominal = np.array([math.radians(33.0), 0.0, 0.55])
    sigma = np.array([SIGMA.tilt_rad, SIGMA.roll_rad, SIGMA.height_m])
    scaled = (table - nominal) / sigma
    np.testing.assert_allclose(scaled.mean(axis=0), 0.0, atol=0.1)  # 4.5 deviations of 0.022
    np.testing.assert_allclose(scaled.std(axis=0), 1.0, atol=0.08)  # 5 of 0.016
    assert np.abs(np.corrcoef(scaled.T) - np.eye(3)).max() < 0.1


def test_a_team_needs_a_robot():
    with pytest.raises(ValueError, match="at least one robot, got none"):
        make_team("tiles", 1, [])


def test_a_plain_photograph_is_the_light():
    light = np.linspace(0, 255, 3 * 20 * 30).reshape(20, 30, 3).astype(np.float32)
    np.testing.assert_array_equal(
        photograph(light, PLAIN, np.random.default_rng(0)), np.rint(light)
    )


def test_vignetting_noise_and_exposure_are_as_asked():
    light = np.full((101, 201, 3), 128.0, dtype=np.float32)
    still = {"exposure_sigma": 0.0, "white_balance_sigma": 0.0}
    rng = np.random.default_rng(4)
    dim = photograph(light, Photometry(vignetting=0.25, noise=0.0, **still), rng).astype(float)
    assert dim[50, 100, 0] == 128
    np.testing.assert_allclose(dim[[0, 0, -1, -1], [0, -1, 0, -1]], 0.75 * 128, atol=2.0)
    noisy = photograph(light, Photometry(vignetting=0.0, noise=3.0, **still), rng).astype(float)
    assert noisy.std() == pytest.approx(3.0, rel=0.03)  # 6e4 numbers: 0.3 %, five times that
    only = Photometry(exposure_sigma=0.1, white_balance_sigma=0.05, vignetting=0.0, noise=0.0)
    means = np.array([photograph(light[:2, :2], only, rng)[0, 0] for _ in range(600)])
    logs = np.log(means / 128.0)
    assert logs.mean(axis=1).std() == pytest.approx(math.hypot(0.1, 0.05 / 3**0.5), rel=0.15)
    assert (logs[:, 0] - logs[:, 1]).std() == pytest.approx(0.05 * 2**0.5, rel=0.15)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [({"noise": -1.0}, "not be negative, got -1"), ({"vignetting": 1.0}, "below 1, got 1")],
)
def test_impossible_photometry_is_refused(wrong, text):
    with pytest.raises(ValueError, match=text):
        Photometry(**wrong)
