"""Cameras for the tests of the rendered world."""

import math

from groundfuse.backend.measurement import IDENTITY, Attitude
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount
from groundfuse.tools.overlap import View

SIGMA = Attitude(math.radians(0.5), math.radians(0.15), 0.002)
LENS = Intrinsics(160, 120, 131.0, 131.0, 79.5, 59.5)
BARREL = Intrinsics(
    200, 150, 164.0, 163.0, 97.0, 76.0, Distortion.PLUMB_BOB, (-0.15, 0.04, 1e-3, -1e-3)
)


def camera(tilt_deg=33.0, height_m=0.55, lens=LENS, place=IDENTITY, roll_deg=0.0, rows=(0, -1)):
    attitude = Attitude(math.radians(tilt_deg), math.radians(roll_deg), height_m)
    sigma = Attitude(SIGMA.tilt_rad, SIGMA.roll_rad, SIGMA.height_m * height_m / 0.55)
    return Camera(lens, Mount(attitude, sigma, place), *rows)


def view(cam, pose=IDENTITY):
    return View(cam, cam.mount.attitude, pose)
