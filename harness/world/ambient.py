"""Light and weather, and how they limit a camera. Other sensors are as by day.

Contrast falls with distance as exp(-d / `fades_m`) (Koschmieder 1924). Meteorological visibility,
the distance at which 5 % of the contrast are left, is three times `fades_m`. The figures are
declared for this harness.
"""

from dataclasses import dataclass
from math import radians

from harness.core import noise

Colour = tuple[int, int, int]


@dataclass(frozen=True)
class Ambient:
    """Describe one kind of light and weather by its effect on cameras and rendered pictures.

    A colour is its red, green and blue, from 0 to 255.
    """

    camera_m: float  # distance up to which a camera tells class, indicator and brake lamps, m
    fades_m: float  # distance over which contrast falls to 1/e, m
    light: float = 1.0  # brightness of what the sky lights, 1 by day; lamps keep their brightness
    haze: Colour = (205, 217, 228)  # colour to which everything fades: red, green and blue
    sky: Colour = (134, 178, 222)  # colour overhead: red, green and blue
    # angle around a low sun within which a camera tells nothing, radians; 0 without a low sun
    glare_rad: float = 0.0


DAY = "day"
AMBIENTS = {
    DAY: Ambient(60.0, 260.0),
    # in its own headlamps
    "night": Ambient(40.0, 35.0, light=0.45, haze=(16, 18, 26), sky=(6, 8, 18)),
    "rain": Ambient(45.0, 90.0, light=0.75, haze=(150, 156, 162), sky=(128, 134, 142)),
    "fog": Ambient(30.0, 25.0, light=0.9, haze=(196, 200, 204), sky=(186, 190, 194)),
    "glare": Ambient(60.0, 260.0, glare_rad=radians(15.0)),
}


def sun_rad(episode_seed: int) -> float:
    """Return the bearing of a low sun, rad from +x (east) towards +y (south).

    It is drawn by `episode_seed`, the layout seed: it fixes who stands where at an episode's start.
    """
    return float(noise.uniforms((1,), "sun", episode_seed)[0]) * radians(360.0)
