"""The calibration that a bundle leaves: read back, corrected, and honest about what is unknown."""

import math
from dataclasses import replace

import numpy as np
import pytest
from bundle_world import FOCAL_PX, pair_team, simulate

from groundfuse.backend.bundle import bundle
from groundfuse.backend.bundle_estimate import Estimated, MountEstimate
from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount
from groundfuse.tools.calibration_file import (
    calibrated_camera,
    calibration_text,
    corrected_lens,
    write_calibrations,
)
from groundfuse.tools.camera_file import read_camera
from groundfuse.tools.robot import Robot
from groundfuse.tools.yaml_file import read_mapping

LENSES = {
    "pinhole": Intrinsics(640, 480, 525.0, 520.0, 321.0, 238.0),
    "plumb_bob": Intrinsics(
        640, 480, 525.0, 520.0, 321.0, 238.0, Distortion.PLUMB_BOB, (-0.1, 0.04, 5e-4, -4e-4, 0.0)
    ),
    "equidistant": Intrinsics(
        640, 480, 548.0, 549.0, 317.0, 243.0, Distortion.EQUIDISTANT, (0.012, -0.004, 0.001, 0.0)
    ),
}
# What two fitted numbers leave of corrections of 0.2 % and 0.005: worst seen 0.014 px.
TOLERANCE_PX = 0.03
MOUNT = Mount(Attitude(0.6, 0.01, 0.5), Attitude(0.01, 0.003, 0.002), Se2(0.1, 0.0, 0.05))


def estimated(value, sigma=0.001, *, used=True):
    return Estimated(value, sigma, 0.03, used)


def found(**changes):
    nothing = {name: estimated(0.0, used=False) for name in ("tilt_rad", "roll_rad", "height")}
    return MountEstimate(**{"robot": "A", **nothing, "focal": None, "distortion": None, **changes})


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
@pytest.mark.parametrize(("focal", "term"), [(0.002, 0.0), (0.0, 0.005), (-0.002, 0.005)])
def test_a_corrected_lens_gives_true_rays(lens, focal, term):
    rng = np.random.default_rng(1)
    pixels = rng.uniform(0, 1, (200, 2)) * (lens.width_px - 1, lens.height_px - 1)
    longer = replace(lens, fx_px=lens.fx_px * (1 + focal), fy_px=lens.fy_px * (1 + focal))

    def seen(true):
        return longer.px_from_rays((1 + term * np.sum(true**2, axis=1, keepdims=True)) * true)

    off = seen(corrected_lens(lens, focal, term).rays_from_px(pixels)) - pixels
    assert np.abs(off).max() < TOLERANCE_PX
    # Uncorrected, pixels at the edge are off by 0.2 to 0.8 px.
    assert np.abs(seen(lens.rays_from_px(pixels)) - pixels).max() > 5 * TOLERANCE_PX


def test_a_pinhole_stays_one_when_only_its_focal_length_changes():
    better = corrected_lens(LENSES["pinhole"], 0.002, 0.0)
    assert better.coefficients == ()
    assert better.fx_px == pytest.approx(525.0 * 1.002, rel=1e-12)
    assert better.fy_px == pytest.approx(520.0 * 1.002, rel=1e-12)


def test_nothing_found_changes_nothing():
    camera = Camera(LENSES["plumb_bob"], MOUNT, 10, 400)
    assert calibrated_camera(camera, found()) == camera


def test_only_used_numbers_are_replaced():
    camera = Camera(LENSES["pinhole"], MOUNT)
    change = found(
        tilt_rad=estimated(0.02), roll_rad=estimated(-0.01, used=False), height=estimated(0.01)
    )
    attitude = calibrated_camera(camera, change).mount.attitude
    assert attitude.tilt_rad == pytest.approx(0.62)
    assert attitude.roll_rad == 0.01
    assert attitude.height_m == pytest.approx(0.505)


def test_the_text_reads_back_as_the_calibrated_camera(tmp_path):
    camera = Camera(LENSES["equidistant"], MOUNT, 5, 470, "front")
    change = found(tilt_rad=estimated(0.02), focal=estimated(0.002), distortion=estimated(None))
    path = tmp_path / "camera.yaml"
    path.write_text(calibration_text(camera, change, 0.007))
    got, wanted = read_camera(path), calibrated_camera(camera, change)
    assert got.used_rows == wanted.used_rows
    assert got.intrinsics.focal_px == pytest.approx(wanted.intrinsics.focal_px, rel=1e-12)
    assert got.mount.attitude.tilt_rad == pytest.approx(0.62, rel=1e-12)
    told = read_mapping(path)["estimated"]
    assert told["tilt_deg"]["file"] == pytest.approx(math.degrees(0.6))
    assert told["tilt_deg"]["value"] == pytest.approx(math.degrees(0.62))
    assert told["tilt_deg"]["sigma"] == pytest.approx(math.degrees(0.001))
    assert told["tilt_deg"]["used"] is True
    assert told["roll_deg"]["used"] is False
    assert told["focal_px"]["value"] == pytest.approx(camera.intrinsics.focal_px * 1.002)
    assert told["first_distortion"] == {"file": 0.012, "used": False, "value": None, "sigma": None}
    assert told["scale_sigma"] == 0.007


def test_a_bundles_calibration_starts_the_next_run_right(tmp_path):
    team = simulate(pair_team(), np.random.default_rng(3), density=800.0)
    lens = Intrinsics(640, 480, FOCAL_PX, FOCAL_PX, 319.5, 239.5)
    bundled = bundle(*team.arguments)
    robots = tuple(
        Robot(name, Camera(lens, Mount(team.prior[FrameId(name, 0)], MOUNT.sigma)), ())
        for name in ("A", "B")
    )
    write_calibrations(tmp_path, robots, bundled)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "A_calibration.yaml",
        "B_calibration.yaml",
    ]
    for robot in robots:
        again = read_camera(tmp_path / f"{robot.name}_calibration.yaml")
        tilt_rad = again.mount.attitude.tilt_rad
        assert tilt_rad == pytest.approx(robot.camera.mount.attitude.tilt_rad, abs=1e-12)
