"""The floor under a tilted camera: rays to floor points and back (paper eq. 1).

Frames: see `camera.py`. With tilt a, roll r and height h the axes of the camera in `foot` are
R = Rx(r) B(a), B(a) = [[0, -cos a, sin a], [-1, 0, 0], [0, -sin a, -cos a]].
"""

import math

import numpy as np

from groundfuse.backend.measurement import Attitude
from groundfuse.frontend.arrays import Matrix, Points


def foot_from_cam(tilt_rad: float, roll_rad: float) -> Matrix:
    """Return the 3x3 rotation that takes camera axes to the foot frame."""
    ca, sa = math.cos(tilt_rad), math.sin(tilt_rad)
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    lean = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    rotation: Matrix = lean @ np.array([[0.0, -ca, sa], [-1.0, 0.0, 0.0], [0.0, -sa, -ca]])
    return rotation


def floor_from_rays(attitude: Attitude, rays: Points) -> Points:
    """Intersect rays (n, 2) with the floor: metres (n, 2) in `foot`; nan above the horizon."""
    rotation = foot_from_cam(attitude.tilt_rad, attitude.roll_rad)
    direction = rays @ rotation[:, :2].T + rotation[:, 2]
    fall = np.where(direction[:, 2] < 0.0, -direction[:, 2], np.nan)
    floor: Points = direction[:, :2] * (attitude.height_m / fall)[:, None]
    return floor


def rays_from_floor(attitude: Attitude, floor_m: Points) -> Points:
    """Project floor points (n, 2) in `foot` to rays (n, 2); nan behind the camera."""
    rotation = foot_from_cam(attitude.tilt_rad, attitude.roll_rad)
    in_cam = floor_m @ rotation[:2, :] - attitude.height_m * rotation[2, :]
    depth = np.where(in_cam[:, 2] > 0.0, in_cam[:, 2], np.nan)
    rays: Points = in_cam[:, :2] / depth[:, None]
    return rays
