"""What the front-end takes from one picture, and the work order for it."""

from dataclasses import dataclass, replace
from pathlib import Path

from groundfuse.backend.measurement import IDENTITY
from groundfuse.frontend import paper_matcher
from groundfuse.frontend.arrays import Image
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.features import Features, detect
from groundfuse.frontend.photometric import GreyView, grey_view
from groundfuse.tools.code_version import code_of
from groundfuse.tools.errors import DataError
from groundfuse.tools.front_end_options import FrontEndOptions, Matcher
from groundfuse.tools.image_file import read_bytes
from groundfuse.tools.packing import digest_of, key_of, packed
from groundfuse.tools.robot import Frame, Robot
from groundfuse.tools.team_folder import image_of


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """All that matching needs of one picture.

    Attributes:
        features: for retrieval and the default matcher.
        paper: for the paper's matcher, where that is asked for.
        grey: for the photometric stage, where that is asked for.
    """

    features: Features
    paper: paper_matcher.PaperFeatures | None
    grey: GreyView | None


@dataclass(frozen=True, slots=True)
class LookJob:
    """One picture to look at.

    Attributes:
        frame: what is known beforehand.
        camera: as far as looking depends on it.
        picture: digest of the file.
        key: digest of all that the result depends on.
    """

    frame: Frame
    camera: Camera
    picture: bytes
    key: bytes


def look_job(robot: Robot, frame: Frame, options: FrontEndOptions) -> LookJob:
    """Read a picture's file and return what is to be done with it.

    Raises:
        DataError: it can't be read.
    """
    camera = _seeing(robot.camera)
    picture = digest_of(read_bytes(frame.path))
    code = code_of("groundfuse.frontend.features", "groundfuse.tools.image_file")
    parts: list[object] = [picture, camera, frame.attitude, frame.sigma, options.features]
    if options.matcher is Matcher.PAPER:
        parts += [code_of("groundfuse.frontend.paper_matcher"), options.paper]
    if options.photometric:
        parts += [code_of("groundfuse.frontend.photometric"), options.motion.photometric]
    return LookJob(frame, camera, picture, key_of("look", code, *parts))


def _seeing(camera: Camera) -> Camera:
    """Leave out what looking does not depend on: the place on the robot, the name."""
    mount = replace(camera.mount, base_from_foot=IDENTITY)
    return replace(camera, mount=mount, name="camera")


def looked(image: Image, camera: Camera, frame: Frame, options: FrontEndOptions) -> Looked:
    """Look at a picture."""
    features = detect(image, camera, frame.attitude, frame.sigma, options.features)
    paper = None
    if options.matcher is Matcher.PAPER:
        paper = paper_matcher.detect(image, camera, frame.attitude, options.paper)
    grey = None
    if options.photometric:
        grey = grey_view(image, camera, options.motion.photometric)
    return Looked(features, paper, grey)


def look_done(data: bytes, job: LookJob, options: FrontEndOptions) -> bytes:
    """Look at the picture in a file's bytes and return what was found, packed.

    Raises:
        DataError: no whole picture, or not of the camera's size.
    """
    return packed(looked(image_of(data, job.frame, job.camera), job.camera, job.frame, options))


def picture_of(job: LookJob) -> bytes:
    """Return the file's bytes once more.

    Raises:
        DataError: it can't be read, or isn't what it was when the run began.
    """
    path: Path = job.frame.path
    data = read_bytes(path)
    if digest_of(data) != job.picture:
        raise DataError(f"{path}: has changed since the run began")
    return data
