"""Real photographs become team folders whose frames mean what ours mean."""

import csv
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from groundfuse.backend.measurement import FrameId, Se2
from groundfuse.frontend.overhead import floor_from_rays, foot_from_cam
from groundfuse.tools.prepare_real import main
from groundfuse.tools.real_planar import world_from_base
from groundfuse.tools.real_seneca import foot_pose
from groundfuse.tools.team_folder import list_robots, load_image, read_team

REAL = Path(__file__).parents[1].parent / "shared" / "real"
needs_real = pytest.mark.skipif(
    not REAL.is_dir(),
    reason=f"needs the real photographs, which are not part of the project: {REAL}",
)


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-math.pi, math.pi))
def test_a_reference_pose_is_taken_apart_as_ours_are_put_together(tilt, roll, heading):
    """W = Rz(heading) R_foot_from_cam, through scipy's quaternion. Worst seen 1e-15."""
    world_from_cam = Rotation.from_euler("z", heading).as_matrix() @ foot_from_cam(tilt, roll)
    x, y, z, w = Rotation.from_matrix(world_from_cam).as_quat()
    row = {"qw_c2w": w, "qx": x, "qy": y, "qz": z}
    row |= {"east_m": 3.0, "north_m": -4.0, "height_above_plane_m": 65.0}
    pose, seen = foot_pose({name: str(value) for name, value in row.items()})
    assert (pose.x_m, pose.y_m, seen.height_m) == (3.0, -4.0, 65.0)
    assert (seen.tilt_rad, seen.roll_rad) == pytest.approx((tilt, roll), abs=1e-12)
    assert math.remainder(pose.theta_rad - heading, 2 * math.pi) == pytest.approx(0.0, abs=1e-12)


def test_a_planar_pose_has_x_up_in_the_picture():
    pose = world_from_base({"x_m": "1", "y_m": "2", "yaw_deg": "-90"})
    assert pose == Se2(1.0, 2.0, 0.0)


def test_a_source_that_is_not_there(tmp_path, capsys):
    assert main(["--source", str(tmp_path / "no"), "--out", str(tmp_path)]) == 2
    expected = f"{tmp_path}/no/seneca: no such folder, needed real photographs (see --help)"
    assert capsys.readouterr().err == f"prepare_real: {expected}\n"


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    out = tmp_path_factory.mktemp("real")
    assert main(["--source", str(REAL), "--out", str(out), "--priors"]) == 0
    return out


@needs_real
def test_every_team_is_read(real):
    sizes = {
        team.name: [(robot.name, len(robot.frames)) for robot in read_team(team, list_robots(team))]
        for team in real.iterdir()
    }
    three, six = [("A", 3), ("B", 3)], [("A", 6)]
    assert sizes == {
        "seneca": [("A", 72), ("B", 88)],
        **{f"planar_{floor}": three for floor in ("mosaic", "floorplan")},
        **{f"planar_{floor}_one": six for floor in ("mosaic", "floorplan")},
    }


@needs_real
def test_the_reference_agrees_with_its_own_columns(real):
    """Tilt and picture-up stand in the reference too, to 5e-4 deg: worst seen 5.5e-4."""
    robot = read_team(real / "seneca", ["A"])[0]
    lens = robot.camera.intrinsics
    assert (lens.cx_px, lens.cy_px) == (449.5, 337.0)  # its pixels begin at 0, ours at -0.5
    assert robot.truth is not None
    with (REAL / "seneca" / "ref_poses_colmap.csv").open() as stream:
        columns = {row["file"]: row for row in csv.DictReader(stream)}
    with (real / "seneca" / "A" / "reference_attitude.csv").open() as stream:
        attitudes = {row["image"]: row for row in csv.DictReader(stream)}
    scored = [frame for frame in robot.frames if frame.id in robot.truth]
    assert len(scored) == len(robot.frames) - 1 == len(attitudes)  # one has no reference
    for frame in scored:
        seen, column = attitudes[frame.path.name], columns[frame.path.name]
        tilt, roll = (math.radians(float(seen[name])) for name in ("tilt_deg", "roll_deg"))
        from_nadir = math.degrees(math.acos(math.cos(tilt) * math.cos(roll)))
        assert from_nadir == pytest.approx(float(column["tilt_from_nadir_deg"]), abs=1e-3)
        up = -foot_from_cam(tilt, roll)[:, 1]
        heading = robot.truth[frame.id].theta_rad + math.atan2(up[1], up[0])
        clockwise = 90.0 - math.degrees(heading)
        wanted = float(column["yaw_image_up_from_north_cw_deg"])
        assert math.remainder(clockwise - wanted, 360.0) == pytest.approx(0.0, abs=1e-3)


@needs_real
def test_gps_priors_are_in_the_frame_of_the_reference(real):
    """Coarse: a sign or an axis that is wrong would give 90 deg or hundreds of metres."""
    robot = read_team(real / "seneca", ["B"])[0]
    assert robot.truth is not None
    away_m, turned_deg = [], []
    for frame in robot.frames:
        assert frame.odometry is not None
        error = robot.truth[frame.id].inverse() @ frame.odometry.map_from_base
        away_m.append(math.hypot(error.x_m, error.y_m))
        turned_deg.append(abs(math.degrees(error.theta_rad)))
        assert frame.sigma.height_m == 6.0
    assert np.median(away_m) < 4.0
    assert np.median(turned_deg) < 20.0


def measured(robot, first, second):
    """Return the pose of one picture in another by plain SIFT on undistorted nadir pictures."""
    sift, clouds = cv2.SIFT_create(2000), []
    for index in (first, second):
        frame = robot.frames[index]
        grey = cv2.cvtColor(load_image(frame, robot.camera), cv2.COLOR_BGR2GRAY)
        points, words = sift.detectAndCompute(grey, None)
        rays = robot.camera.intrinsics.rays_from_px(np.array([p.pt for p in points]))
        clouds.append((floor_from_rays(frame.attitude, rays), words))
    (floor_a, words_a), (floor_b, words_b) = clouds
    best = [
        m
        for m, n in cv2.BFMatcher().knnMatch(words_b, words_a, k=2)
        if m.distance < 0.7 * n.distance
    ]
    in_b = floor_b[[m.queryIdx for m in best]].astype(np.float32)
    in_a = floor_a[[m.trainIdx for m in best]].astype(np.float32)
    M, _ = cv2.estimateAffinePartial2D(in_b, in_a, ransacReprojThreshold=0.004)
    return Se2(M[0, 2], M[1, 2], math.atan2(M[1, 0], M[0, 0]))


@needs_real
def test_planar_truth_is_what_the_pictures_show(real):
    """Worst seen 0.2 mm and 0.01 deg. The last pair turns by 20 deg and so tells the sign."""
    robot = read_team(real / "planar_mosaic_one", ["A"])[0]
    assert robot.truth is not None
    for first, second in ((2, 3), (4, 5)):
        a, b = (robot.truth[FrameId("A", index)] for index in (first, second))
        error = (a.inverse() @ b).inverse() @ measured(robot, first, second)
        assert math.hypot(error.x_m, error.y_m) < 0.001
        assert abs(math.degrees(error.theta_rad)) < 0.05
