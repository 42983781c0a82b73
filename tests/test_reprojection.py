"""The transfer agrees with the front-end's geometry, and its derivatives with differences."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.backend.reprojection import transfer
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor

# Central differences with step 1e-6: truncation 1e-12 x third derivative (below 1e3 at depth over
# 0.05 m), cancellation 1e-16 / 1e-6 x values below 1e2; worst seen 4e-7.  Ten times that.
TOLERANCE_DERIVATIVE = 4e-6
TOLERANCE_RAY = 1e-12
STEP = 1e-6

angles = st.floats(-0.9, 0.9)
rolls = st.floats(-0.3, 0.3)
heights = st.floats(0.3, 3.0)
cameras = st.tuples(angles, rolls, heights)
poses = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3.1, 3.1))


def points_in_front(camera_a, pose, camera_b, seed):
    """Floor points that both cameras see with depth over 0.05 m, as rays in a."""
    rng = np.random.default_rng(seed)
    floor = rng.uniform(-2, 2, (200, 2))
    a, b = Attitude(*camera_a), Attitude(*camera_b)
    rays_a, rays_b = (
        rays_from_floor(a, floor),
        rays_from_floor(b, Se2(*pose).inverse().apply(floor)),
    )
    seen = (np.abs(rays_a) < 1).all(axis=1) & (np.abs(rays_b) < 1).all(axis=1)
    return rays_a[seen], rays_b[seen]


@given(cameras, poses, cameras, st.integers(0, 99))
def test_transfer_is_floor_then_image(camera_a, pose, camera_b, seed):
    rays_a, rays_b = points_in_front(camera_a, pose, camera_b, seed)
    got = transfer(rays_a, np.array(camera_a), np.array(pose), np.array(camera_b))
    np.testing.assert_allclose(got.rays_b, rays_b, atol=TOLERANCE_RAY * 100)
    floor = floor_from_rays(Attitude(*camera_a), rays_a)
    in_b = Se2(*pose).inverse().apply(floor)
    np.testing.assert_allclose(got.rays_b, rays_from_floor(Attitude(*camera_b), in_b), atol=1e-10)


@given(cameras, poses, cameras, st.integers(0, 99))
def test_derivatives_agree_with_differences(camera_a, pose, camera_b, seed):
    rays_a, _ = points_in_front(camera_a, pose, camera_b, seed)
    a, b, p = np.array(camera_a), np.array(camera_b), Se2(*pose)
    got = transfer(rays_a, a, p.vector(), b)

    def differ(plus, minus):
        return (plus.rays_b - minus.rays_b) / (2 * STEP)

    for k, unit in enumerate(np.eye(3) * STEP):
        step = Se2(*unit)
        cases = {
            "by_pose": (
                transfer(rays_a, a, (p @ step).vector(), b),
                transfer(rays_a, a, (p @ step.inverse()).vector(), b),
            ),
            "by_attitude_a": (
                transfer(rays_a, a + unit, p.vector(), b),
                transfer(rays_a, a - unit, p.vector(), b),
            ),
            "by_attitude_b": (
                transfer(rays_a, a, p.vector(), b + unit),
                transfer(rays_a, a, p.vector(), b - unit),
            ),
        }
        if k < 2:
            cases["by_rays_a"] = (
                transfer(rays_a + unit[:2], a, p.vector(), b),
                transfer(rays_a - unit[:2], a, p.vector(), b),
            )
        for name, (plus, minus) in cases.items():
            analytic = getattr(got, name)[:, :, k]
            scale = 1.0 + np.abs(analytic)
            assert (np.abs(analytic - differ(plus, minus)) / scale < TOLERANCE_DERIVATIVE).all(), (
                name
            )


def test_a_point_above_the_horizon_is_nan():
    got = transfer(
        np.array([[0.0, -3.0]]), np.array([1.0, 0, 1]), np.zeros(3), np.array([0.0, 0, 1])
    )
    assert np.isnan(got.rays_b).all()
