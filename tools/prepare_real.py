"""Make team folders of real photographs: `python tools/prepare_real.py --source ../shared/real`.

- `seneca`: robots A and B, two passes of a drone over a field (72 and 88 pictures). `--priors` adds
  GPS heights and GPS motion to the frame lists. Ground truth is a structure-from-motion reference,
  there to score results; nothing else reads it.
- `planar_mosaic`, `planar_floorplan`: robots A and B, three pictures each, straight down, exact
  truth. `planar_mosaic_one`, `planar_floorplan_one`: the same six pictures of a single robot A.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from groundfuse.tools.errors import DataError, TeamError
from groundfuse.tools.real_planar import HALVES, WHOLE, planar
from groundfuse.tools.real_seneca import seneca
from groundfuse.tools.real_team import RealRobot, write_team


def teams(source: Path, *, priors: bool) -> dict[str, tuple[RealRobot, ...]]:
    """Return the robots of every team by the team's name.

    Raises:
        DataError: the source isn't there.
    """
    flat = source / "planar_frames"
    for folder in (source / "seneca", flat):
        if not folder.is_dir():
            raise DataError(f"{folder}: no such folder, needed real photographs (see --help)")
    return {
        "seneca": seneca(source / "seneca", priors=priors),
        "planar_mosaic": planar(flat, "mosaic", HALVES),
        "planar_mosaic_one": planar(flat, "mosaic", WHOLE),
        "planar_floorplan": planar(flat, "floorplan", HALVES),
        "planar_floorplan_one": planar(flat, "floorplan", WHOLE),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--source",
        type=Path,
        default=Path("../shared/real"),
        help="folder that has seneca/ and planar_frames/ (default: %(default)s)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/real"),
        help="folder that gets one team folder each (default: %(default)s)",
    )
    parser.add_argument(
        "--priors", action="store_true", help="write GPS heights and motion into Seneca's lists"
    )
    options = parser.parse_args(arguments)
    try:
        for name, robots in teams(options.source, priors=options.priors).items():
            write_team(options.out / name, robots)
            found = ", ".join(f"{robot.name} with {len(robot.frames)}" for robot in robots)
            print(f"{options.out / name}: {found} pictures")
    except TeamError as error:
        print(f"prepare_real: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
