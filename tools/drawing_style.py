"""Colours and round numbers for drawings."""

import colorsys
import functools
import math

from groundfuse.tools.canvas import Colour

PAPER: Colour = (248, 250, 251)
INK: Colour = (46, 38, 33)
FAINT: Colour = (140, 130, 124)
GRID: Colour = (224, 226, 228)
WHITE: Colour = (255, 255, 255)
OVERLAP: Colour = (32, 214, 250)
"""Edges between robots: yellow, which no robot has."""
REJECTED: Colour = (250, 250, 250)
"""Edges that were tried in vain: there may be many, so they are no more than a hint."""

# Okabe and Ito's palette, which colour-blind people tell apart, without its yellow and black.
ROBOTS: tuple[Colour, ...] = (
    (178, 114, 0),
    (0, 94, 213),
    (115, 158, 0),
    (167, 90, 184),
    (233, 180, 86),
    (0, 159, 230),
)


def robot_colour(number: int) -> Colour:
    """Return the colour of the n-th robot; beyond the palette, hues a golden angle apart."""
    if number < len(ROBOTS):
        return ROBOTS[number]
    hue = (number * 0.61803398875) % 1.0
    red, green, blue = colorsys.hsv_to_rgb(hue, 0.75, 0.75)
    return round(255 * blue), round(255 * green), round(255 * red)


@functools.cache
def mixed(a: Colour, b: Colour, share_of_b: float) -> Colour:
    """Return a colour between two."""
    blue, green, red = (round(x + (y - x) * share_of_b) for x, y in zip(a, b, strict=True))
    return blue, green, red


def round_below(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a positive value."""
    power = 10.0 ** math.floor(math.log10(value))
    step = max((s for s in (1, 2, 5) if s * power <= value * (1 + 1e-9)), default=1)
    return float(f"{step * power:.6g}")


def length_text(length_m: float) -> str:
    """Return a length with a fitting unit."""
    if length_m >= 999.5:
        return f"{length_m:.0f} m"
    if length_m >= 0.9995:
        return f"{length_m:.3g} m"
    if length_m >= 0.00995:
        return f"{length_m * 100:.3g} cm"
    return f"{length_m * 1000:.2g} mm"


def tick_text(value_m: float, step_m: float) -> str:
    """Return a tick's number with as many decimals as its step needs."""
    decimals = max(0, -math.floor(math.log10(step_m) + 1e-9))
    text = f"{value_m:.{decimals}f}"
    return text.lstrip("-") if float(text) == 0.0 else text
