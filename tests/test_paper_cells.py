"""The paper's matcher gets one overhead cell for robots of different heights."""

import math
from dataclasses import replace

import pytest

from groundfuse.backend.measurement import Attitude
from groundfuse.frontend.camera import Camera, Intrinsics, Mount
from groundfuse.frontend.overhead_view import raster_cell_m
from groundfuse.tools.front_end_options import FrontEndOptions, Matcher, comparable, with_matcher
from groundfuse.tools.robot import Robot


def robot(name, height_m):
    attitude = Attitude(math.radians(33.0), 0.0, height_m)
    mount = Mount(attitude, Attitude(0.01, 0.003, 0.004 * height_m))
    return Robot(name, Camera(Intrinsics(320, 240, 260.0, 260.0, 159.5, 119.5), mount), ())


TEAM = (robot("A", 0.55), robot("B", 0.85))


def test_the_coarsest_camera_sets_the_cell():
    options = comparable(with_matcher(FrontEndOptions(), Matcher.PAPER), TEAM)
    cells = [raster_cell_m(r.camera, options.paper.overhead) for r in TEAM]
    assert cells[0] == cells[1] == pytest.approx(0.85 / 260.0, rel=1e-12)


def test_a_cell_that_was_asked_for_stays():
    options = with_matcher(FrontEndOptions(), Matcher.PAPER)
    overhead = replace(options.paper.overhead, m_per_px=0.004)
    asked = replace(options, paper=replace(options.paper, overhead=overhead))
    assert comparable(asked, TEAM) == asked


def test_other_matchers_are_left_alone():
    assert comparable(FrontEndOptions(), TEAM) == FrontEndOptions()
