"""What the planar bundle is asked and what it answers: frozen values, numpy only."""

from dataclasses import dataclass
from enum import StrEnum

from groundfuse.backend.measurement import Attitude, FrameId, Rejected, Se2, TeamEstimate
from groundfuse.backend.option_checks import check_numbers

FocalGains = tuple[tuple[float, float], ...]


class Refine(StrEnum):
    """Whether a number of the camera file is estimated."""

    NEVER = "never"
    IF_SEEN = "if-seen"
    ALWAYS = "always"


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleOptions:
    """How the bundle weighs and guards; every length is relative to the camera height."""

    mount_tilt_sigma_deg: float = 2.0
    """How far a mount's true tilt may lie from its file, one sigma, degrees."""
    mount_roll_sigma_deg: float = 1.0
    """How far a mount's true roll may lie from its file, one sigma, degrees."""
    mount_height_sigma: float = 0.01
    """How far a mount's true height may lie from its file, one sigma, fraction of the height."""
    focal: Refine = Refine.IF_SEEN
    """Whether to estimate each robot's focal length."""
    focal_sigma: float = 0.003
    """How far a focal length may lie from its file, one sigma, fraction."""
    distortion: Refine = Refine.NEVER
    """Whether to estimate each robot's first radial distortion term."""
    distortion_sigma: float = 0.02
    """How far that term may lie from its file, one sigma."""
    file_gate_sigma: float = 3.0
    """Mounts and lenses are as filed unless the pictures contradict a file by so many sigmas."""
    relief: Refine = Refine.IF_SEEN
    """Whether floor points may lie above or below the plane."""
    relief_levels: tuple[float, ...] = (0.02, 0.2)
    """How far, one sigma, fraction of the camera height: the first that explains the residuals.
    They are wide because a real floor waves, so that the points of a view share most of it."""
    tracks: bool = True
    """Join correspondences that share a keypoint into one floor point; else each is its own."""
    most_sightings: int = 100_000
    """Sightings that take part, as whole floor points; a frame keeps 250 at least."""
    trial_sightings: int = 30_000
    """Sightings in the trial whether the floor is flat; a frame keeps 60 at least."""
    start_sightings: int = 250
    """Correspondences per frame in the first stage, which is robust against single wrong ones."""
    robust_sigma: float = 1.5
    """Width of the Cauchy kernel on a whitened ray residual, sigmas."""
    link_gate_sigma: float = 4.0
    """A correspondence whose two floor points lie further apart than this is wrong, sigmas."""
    min_links: int = 8
    """A pair left with fewer correspondences counts as its relative pose instead."""
    min_link_share: float = 0.3
    """A pair that loses more than the rest of its correspondences is turned down."""
    iterations: int = 15
    """Most Gauss-Newton steps per stage."""
    observed_share: float = 0.5
    """A calibration number is stated where its sigma is below this share of the prior's."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        shares = ("min_link_share", "observed_share")
        check_numbers(self, may_be_zero=shares, shares=shares)
        if not self.relief_levels or not all(0.0 < level < 1.0 for level in self.relief_levels):
            found = ", ".join(f"{level:g}" for level in self.relief_levels) or "none"
            raise ValueError(f"relief_levels must lie between 0 and 1, got {found}")


@dataclass(frozen=True, slots=True)
class BundleCamera:
    """What the bundle needs to know of a robot's camera.

    Attributes:
        base_from_foot: planar offset and yaw of the camera on the robot.
        focal_px: focal length, by which residuals are stated in pixels.
        focal_gains: by what multiple of its length an undistorted ray grows with the fraction by
            which the focal length does, at ascending lengths of the ray: 1 without distortion,
            which nothing stands for too; (1 + r^2) atan(r) / r for a fisheye.
    """

    base_from_foot: Se2
    focal_px: float
    focal_gains: FocalGains = ()


@dataclass(frozen=True, slots=True)
class Estimated:
    """A calibration number relative to the file, or the statement that the pictures do not tell.

    Attributes:
        value: correction to add to the file's number; None where it is not observable.
        sigma: standard deviation of the value; where there is none, of what is left of the prior.
        prior_sigma: standard deviation before the pictures.
        used: whether poses rest on the value; else on the file's, which it does not contradict.
    """

    value: float | None
    sigma: float
    prior_sigma: float
    used: bool


@dataclass(frozen=True, slots=True)
class MountEstimate:
    """A robot's camera against its file.

    Attributes:
        robot: name.
        tilt_rad: correction of the tilt.
        roll_rad: correction of the roll.
        height: correction of the height as a fraction, relative to the team's mean scale.
        focal: correction of the focal length as a fraction; None where not asked for.
        distortion: correction of the first radial term, likewise.
    """

    robot: str
    tilt_rad: Estimated
    roll_rad: Estimated
    height: Estimated
    focal: Estimated | None
    distortion: Estimated | None


class FindingKind(StrEnum):
    """What a finding is about."""

    SCALE = "scale"
    UNOBSERVABLE = "unobservable"
    APART = "apart"
    CALIBRATION = "calibration"
    RELIEF = "relief"
    WOBBLE = "wobble"
    NOISE = "noise"


@dataclass(frozen=True, slots=True)
class Finding:
    """One statement about what the pictures tell and what not, with its number.

    Attributes:
        kind: what it is about.
        robots: the robots it concerns.
        value: the number found.
        text: one line for people.
    """

    kind: FindingKind
    robots: tuple[str, ...]
    value: float
    text: str


class Illposed(StrEnum):
    """Why a team has no bundle."""

    NO_POINTS = "no_points"
    FALLS_APART = "falls_apart"
    SINGULAR = "singular"
    NOT_CONVERGED = "not_converged"


@dataclass(frozen=True, slots=True)
class BundleRefusal:
    """A team that the bundle cannot solve: the reason, the number found and the one needed."""

    reason: Illposed
    value: float
    limit: float
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class BundleEstimate:
    """The team after bundling.

    Attributes:
        team: poses, covariances (relative to each component's reference frame, at the scale of the
            files' mean height) and anchors; chi2 and degrees of freedom are the bundle's.
        attitude: tilt, roll and height of every frame.
        attitude_sigma: their standard deviations.
        mounts: one per robot, in the order of their names.
        scale_sigma: standard deviation of the map's scale, fraction; only heights tell it.
        residual_px: root mean square of the reprojection residuals of a floor point's coordinates.
        noise_factor: residuals over what the correspondences' sigmas promise, robust.
        num_points: floor points used.
        num_observations: their sightings.
        num_links: correspondences kept.
        num_links_cut: correspondences found wrong.
        rejected: accepted pairs that the bundle turned down.
        findings: what is observable and what is not.
        relief: standard deviation of the floor points' heights that was allowed for, fraction of
            the camera height; 0 where the floor is flat.
        settled_frames: how many frames there were when floor and files were judged.
    """

    team: TeamEstimate
    attitude: dict[FrameId, Attitude]
    attitude_sigma: dict[FrameId, Attitude]
    mounts: tuple[MountEstimate, ...]
    scale_sigma: float
    residual_px: float
    noise_factor: float
    num_points: int
    num_observations: int
    num_links: int
    num_links_cut: int
    rejected: tuple[Rejected, ...]
    findings: tuple[Finding, ...]
    relief: float = 0.0
    settled_frames: int = 0
