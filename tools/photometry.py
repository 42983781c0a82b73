"""What the lens, the sensor and the camera's automatics do to a picture."""

from dataclasses import dataclass

import numpy as np

from groundfuse.frontend.arrays import Floats, Image, Picture32


@dataclass(frozen=True, slots=True, kw_only=True)
class Photometry:
    """How far pictures are from the plain colours of the floor.

    Attributes:
        exposure_sigma: deviation of the natural logarithm of each picture's exposure.
        white_balance_sigma: the same for each colour of each picture.
        vignetting: share of the light lost in the corners.
        noise: deviation of the sensor's noise at mid-grey, grey levels of 255; its variance grows
            with the light, half of it is there in the dark.
    """

    exposure_sigma: float = 0.10
    white_balance_sigma: float = 0.03
    vignetting: float = 0.25
    noise: float = 1.5

    def __post_init__(self) -> None:
        """Refuse negative deviations and a lens that takes all the light (ValueError)."""
        lowest = min(self.exposure_sigma, self.white_balance_sigma, self.vignetting, self.noise)
        if not lowest >= 0.0:
            raise ValueError(f"photometry must not be negative, got {lowest:g}")
        if self.vignetting >= 1.0:
            raise ValueError(f"vignetting must be below 1, got {self.vignetting:g}")


PLAIN = Photometry(exposure_sigma=0.0, white_balance_sigma=0.0, vignetting=0.0, noise=0.0)
MID_GREY = 128.0


def _falloff(rows: int, columns: int, loss: float) -> Floats:
    v, u = np.ogrid[0:rows, 0:columns]
    v, u = (v - (rows - 1) / 2.0), (u - (columns - 1) / 2.0)
    radius2 = (v * v + u * u) / ((rows * rows + columns * columns) / 4.0)
    factor: Floats = (1.0 - loss * radius2)[:, :, None]
    return factor


def photograph(light: Picture32, photometry: Photometry, rng: np.random.Generator) -> Image:
    """Turn light (rows, columns, 3), 0 to 255, into a picture of 8 bits."""
    exposure = np.exp(rng.normal(0.0, 1.0) * photometry.exposure_sigma)
    balance = np.exp(rng.normal(0.0, 1.0, 3) * photometry.white_balance_sigma)
    seen = (
        light
        * _falloff(light.shape[0], light.shape[1], photometry.vignetting)
        * (exposure * balance)
    )
    if photometry.noise > 0.0:
        spread = photometry.noise * np.sqrt(0.5 + 0.5 * seen / MID_GREY)
        seen = seen + spread * rng.standard_normal(light.shape, dtype=np.float32)
    picture: Image = np.clip(np.rint(seen), 0.0, 255.0).astype(np.uint8)
    return picture
