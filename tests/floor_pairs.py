"""Pairs of views with known truth for the front-end's tests: pure geometry, and photographs.

Geometry goes through `frontend.overhead`, not through the fit's own model. Photographs are small
and of a floor that is quick to draw; each is taken once per process.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import IDENTITY, Attitude, Correspondences, FrameId, Se2
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount
from groundfuse.frontend.features import FeatureOptions, Features, detect
from groundfuse.frontend.fit import FitOptions, PairFit, Prior, fit_pair
from groundfuse.frontend.motion import View
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor
from groundfuse.tools.floor_raster import FloorRaster
from groundfuse.tools.floors import CELL_PER_HEIGHT, make_floor
from groundfuse.tools.noise import octaves
from groundfuse.tools.photometry import Photometry
from groundfuse.tools.render import World
from groundfuse.tools.world import RenderedFrame, take, wobbled
from groundfuse.tools.world import View as TrueView

HEIGHT_M = 0.55
WOBBLE = Attitude(math.radians(0.5), math.radians(0.15), 0.002 / HEIGHT_M)
"""Of a camera at 1 m."""
HALF_VIEW = np.array([0.62, 0.46])  # rays at the edge of the pictures below
RAY_SIGMA = 0.3 / 257.0


def wobble(height_m=HEIGHT_M, factor=1.0):
    """Standard deviations of a camera's attitude."""
    return Attitude(
        factor * WOBBLE.tilt_rad, factor * WOBBLE.roll_rad, factor * WOBBLE.height_m * height_m
    )


def drawn(prior: Prior, rng) -> Attitude:
    """A true attitude as the prior has it."""
    mean, sigma = prior.mean, prior.sigma
    tilt, roll, height = rng.standard_normal(3)
    return Attitude(
        mean.tilt_rad + tilt * sigma.tilt_rad,
        mean.roll_rad + roll * sigma.roll_rad,
        mean.height_m + height * sigma.height_m,
    )


def prior(tilt_deg=33.0, height_m=HEIGHT_M, factor=1.0, roll_deg=0.0):
    mean = Attitude(math.radians(tilt_deg), math.radians(roll_deg), height_m)
    return Prior(mean, wobble(height_m, factor))


@dataclass(frozen=True)
class GeometricPair:
    """Correspondences by construction."""

    points: Correspondences
    truth: Se2
    attitudes: tuple[Attitude, Attitude]
    priors: tuple[Prior, Prior]

    def fit(self, start: Se2 | None = None, options: FitOptions | None = None) -> PairFit:
        return fit_pair(self.points, start or self.truth, *self.priors, options or FitOptions())

    def swapped(self) -> "GeometricPair":
        p = self.points
        points = Correspondences(p.rays_b, p.rays_a, p.sigma_b, p.sigma_a)
        return GeometricPair(points, self.truth.inverse(), self.attitudes[::-1], self.priors[::-1])


def seen_by_both(rng, truth, attitudes, count, half_view=HALF_VIEW):
    """Exact rays (count, 2) of floor points that lie in both pictures."""
    parts_a, parts_b, found = [], [], 0
    for _ in range(200):
        rays_a = rng.uniform(-half_view, half_view, (4 * count, 2))
        in_b = truth.inverse().apply(floor_from_rays(attitudes[0], rays_a))
        rays_b = rays_from_floor(attitudes[1], in_b)
        keep = (np.abs(rays_b) < half_view).all(axis=1)
        parts_a.append(rays_a[keep])
        parts_b.append(rays_b[keep])
        found += int(keep.sum())
        if found >= count:
            break
    assert found >= count, "the views share too little floor"
    return np.vstack(parts_a)[:count], np.vstack(parts_b)[:count]


def geometric_pair(
    rng, truth, priors, *, count=120, noise=1.0, wobbling=True, half_view=HALF_VIEW, wrong=0
) -> GeometricPair:
    """Simulate a pair: wobble as the priors have it, ray noise, and some wrong matches (last)."""
    attitudes = tuple(drawn(p, rng) if wobbling else p.mean for p in priors)
    rays_a, rays_b = seen_by_both(rng, truth, attitudes, count, half_view)
    if wrong:
        rays_b[-wrong:] = rng.uniform(-half_view, half_view, (wrong, 2))
    sigma = RAY_SIGMA * rng.uniform(0.7, 1.5, (2, count))
    rays_a = rays_a + noise * sigma[0][:, None] * rng.standard_normal((count, 2))
    rays_b = rays_b + noise * sigma[1][:, None] * rng.standard_normal((count, 2))
    points = Correspondences(rays_a, rays_b, *sigma)
    return GeometricPair(points, truth, attitudes, priors)


def error_of(found: Se2, truth: Se2):
    """Error (3,) in the tangent at b."""
    return (truth.inverse() @ found).vector()


def nees(found: Se2, covariance, truth: Se2) -> float:
    """Squared error in units of the covariance; 3 degrees of freedom."""
    error = error_of(found, truth)
    return float(error @ np.linalg.solve(covariance, error))


def camera(
    tilt_deg=33.0,
    height_m=HEIGHT_M,
    *,
    roll_deg=0.0,
    base_from_foot=IDENTITY,
    focal_px=257.0,
    coefficients=(),
    sigma=None,
    rows=(0, -1),
):
    """A camera of 320 x 240 pixels."""
    lens = Intrinsics(
        320, 240, focal_px, 1.003 * focal_px, 158.9, 120.4, Distortion.PLUMB_BOB, coefficients
    )
    attitude = Attitude(math.radians(tilt_deg), math.radians(roll_deg), height_m)
    return Camera(lens, Mount(attitude, sigma or wobble(height_m), base_from_foot), *rows)


def speckle(seed, rect):
    """A floor with detail of every size that never repeats and is quick to draw."""
    grey = 128.0 + octaves((seed,), rect, {48: 12.0, 12: 14.0, 5: 16.0, 3: 12.0})
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


@functools.cache
def world(floor="speckle", height_m=HEIGHT_M, seed=7) -> World:
    """A floor by name, of a grain that suits cameras at a height."""
    if floor == "speckle":
        return World(FloorRaster(speckle, seed, CELL_PER_HEIGHT * height_m))
    return World(make_floor(floor, seed, height_m))


@functools.cache
def photo(
    view_camera: Camera,
    pose: Se2,
    floor="speckle",
    frame=FrameId("A", 0),  # noqa: B008
    light=Photometry(),  # noqa: B008
    *,
    still=False,
    grain_m=None,
) -> RenderedFrame:
    """A photograph by a wobbling camera; wobble and noise belong to the frame's name.

    The floor's grain suits cameras at `grain_m`, by default this one.
    """
    rng = np.random.default_rng([11, ord(frame.robot[0]), frame.index])
    attitude = view_camera.mount.attitude if still else wobbled(view_camera, rng)
    view = TrueView(view_camera, attitude, pose)
    image = take(world(floor, grain_m or view_camera.mount.attitude.height_m), view, light, rng)
    return RenderedFrame(frame, image, view)


@functools.cache
def features_of(frame: RenderedFrame, options: FeatureOptions | None = None) -> Features:
    """What detection finds with the mount's prior."""
    mount = frame.view.camera.mount
    found = options or FeatureOptions()
    return detect(frame.image, frame.view.camera, mount.attitude, mount.sigma, found)


def view_of(frame: RenderedFrame, grey=None) -> View:
    """What the motion stage knows of a photograph."""
    mount = frame.view.camera.mount
    return View(frame.id, Prior(mount.attitude, mount.sigma), mount.base_from_foot, grey)


def true_motion(a: RenderedFrame, b: RenderedFrame) -> Se2:
    """Pose of base b in base a."""
    return a.world_from_base.inverse() @ b.world_from_base


def true_foot_motion(a: RenderedFrame, b: RenderedFrame) -> Se2:
    """Pose of foot b in foot a."""
    return a.view.world_from_foot.inverse() @ b.view.world_from_foot
