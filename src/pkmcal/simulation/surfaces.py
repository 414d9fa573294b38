"""Appearance of surfaces: patterns, materials, and their radiance towards the camera."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.ranges import Style
from pkmcal.simulation.shapes import Cylinder, Shape, inner

NOISE_SIZE = 256
BRUSH_ACROSS, BRUSH_ALONG = 0.13, 0.75
"""Roughness of turned steel across and along the axis, in Ward's model."""


@dataclass(frozen=True)
class SmoothNoise:
    """Smooth noise with period ``NOISE_SIZE`` cells; table (size, size), standard deviation 1."""

    table: Array

    @classmethod
    def from_rng(cls, rng: np.random.Generator) -> SmoothNoise:
        """White noise filtered so that its amplitude falls with frequency, as in clouds
        and stains.
        """
        k = np.fft.fftfreq(NOISE_SIZE) * NOISE_SIZE
        scale = np.hypot(k[:, None], k[None, :]) / (NOISE_SIZE / 4)
        # no power remains at the cell's size, where bilinear interpolation would be visible
        gain = np.exp(-2 * scale**2) / (0.02 + scale) ** 1.2
        white = np.fft.fft2(rng.normal(size=(NOISE_SIZE, NOISE_SIZE)))
        table = np.fft.ifft2(white * gain).real
        table -= table.mean()
        return cls((table / table.std()).astype(np.float32))

    def at(self, u: Array, v: Array) -> Array:
        """Bilinear interpolation (n,) at positions (n,), in cells."""
        from scipy.ndimage import map_coordinates

        return map_coordinates(self.table, (u, v), output=float, order=1, mode="grid-wrap")


class Pattern(ABC):
    """Factor on the albedo as a function of the point in the shape's own frame."""

    @abstractmethod
    def factor(self, q: Array) -> Array:
        """(n,) factors, about 1, at local points (3, n)."""


@final
@dataclass(frozen=True)
class Clouds(Pattern):
    """Stains: smooth noise with a cell size (m) and a contrast."""

    noise: SmoothNoise
    cell: float
    contrast: float

    def factor(self, q: Array) -> Array:
        """Noise at slanted coordinates, so that it varies on every face of a box."""
        value = self.noise.at(
            (q[0] + 0.6 * q[2]) / self.cell + 31.7, (q[1] - 0.45 * q[2]) / self.cell + 8.3
        )
        return np.clip(1 + self.contrast * value, 0.15, 2.5)


@final
@dataclass(frozen=True)
class WavyStripes(Pattern):
    """Stripes of a period (m) with soft irregular borders, as light through blinds or wood."""

    noise: SmoothNoise
    period: float
    contrast: float

    def factor(self, q: Array) -> Array:
        """Square wave with soft borders, its phase shifted by noise."""
        wander = self.noise.at(q[0] / self.period * 5 + 3.1, q[1] / self.period * 5 + 7.9)
        wave = np.sin(2 * np.pi * (0.9 * q[0] + 0.43 * q[1]) / self.period + 1.4 * wander)
        return 1 + self.contrast * np.tanh(1.8 * wave)


@final
@dataclass(frozen=True)
class Checks(Pattern):
    """Checks of a size (m), dark ones with the factor ``dark``; borders are soft over a tenth."""

    size: float
    dark: float

    def factor(self, q: Array) -> Array:
        """Product of square waves, shifted so that a face on a border is not all border."""
        wave = np.ones(q.shape[1])
        for axis in range(3):
            wave = wave * np.tanh(12 * np.cos(np.pi * (q[axis] / self.size + 0.21)))
        return self.dark + (1 - self.dark) * (0.5 + 0.5 * wave)


@final
@dataclass(frozen=True)
class Slats(Pattern):
    """Boards with narrow dark joints, as panels or tiles: widths (m) in both directions."""

    width: float
    height: float
    dark: float

    def factor(self, q: Array) -> Array:
        """Factor of joints a twelfth of the width, with soft borders: thinner joints
        would alias.
        """
        seam = np.zeros(q.shape[1])
        for axis, size in ((0, self.width), (1, self.height)):
            if np.isfinite(size):
                gap = np.abs((q[axis] / size) % 1.0 - 0.5)
                seam = np.maximum(seam, np.clip((gap - 0.45) * 35, 0, 1))
        return 1 - (1 - self.dark) * seam


@dataclass(frozen=True)
class Material:
    """Surface properties.

    albedo : diffuse reflectance.
    pattern : factor on the albedo.
    gloss, sharpness : strength and exponent of a Blinn-Phong highlight.
    brushed : the highlight is elongated along a cylinder's axis and narrow across (turned steel;
        Ward's model).
    mirror : share of the blurred surroundings that a rough surface reflects.
    polish : share of a sharp reflection; at its limb a polished shape reflects the background, and
        the contrast of its edge vanishes.
    emission : light of its own.
    """

    albedo: float = 0.5
    pattern: Pattern | None = None
    gloss: float = 0.0
    sharpness: float = 30.0
    brushed: bool = False
    mirror: float = 0.0
    polish: float = 0.0
    emission: float = 0.0


@dataclass(frozen=True)
class Finish:
    """Materials of the machine's parts; telescopic tubes from the base end to the platform end.

    forearm : rods moved by a motor on the base, dull as drawn aluminium or glass fibre.
    """

    paint: Material
    steel: Material
    forearm: Material
    joint: Material
    base: Material
    platform: Material

    @classmethod
    def from_noise(cls, noise: SmoothNoise, flat: bool = False, style: Style = "mixed") -> Finish:
        """Tubes, rods and forearms of a style, blackened joints, a stained base, a milled platform.

        flat : the legs lie open to the lamps above, where white paint would be overexposed. style :
        ``mixed`` is white paint and turned steel, ``matte`` and ``dark`` are paint throughout,
        ``metal`` is polished aluminium and chrome.
        """
        coarse, fine = Clouds(noise, 0.012, 0.03), Clouds(noise, 0.004, 0.05)
        dull = Material(0.5, Clouds(noise, 0.008, 0.04), gloss=0.08, sharpness=15.0)
        white = 0.42 if flat else 0.8
        styles: dict[Style, tuple[Material, Material, Material]] = {
            "mixed": (
                Material(white, coarse, gloss=0.3, sharpness=40.0),
                Material(0.38, fine, gloss=0.45, brushed=True, mirror=0.3),
                dull,
            ),
            "matte": (Material(white, coarse, gloss=0.03, sharpness=8.0), dull, dull),
            "dark": (
                Material(0.05, coarse, gloss=0.12, sharpness=25.0),
                Material(0.08, fine, gloss=0.15, sharpness=40.0),
                Material(0.06, coarse, gloss=0.08, sharpness=15.0),
            ),
            "metal": (
                Material(0.08, coarse, polish=0.6),
                Material(0.02, fine, polish=0.75),
                Material(0.08, coarse, polish=0.6),
            ),
        }
        paint, steel, forearm = styles[style]
        return cls(
            paint=paint,
            steel=steel,
            forearm=forearm,
            joint=Material(0.035, gloss=0.45, sharpness=60.0, mirror=0.06),
            base=Material(0.16, Clouds(noise, 0.015, 0.25), gloss=0.05, sharpness=12.0),
            platform=Material(0.27, Clouds(noise, 0.02, 0.08), gloss=0.12, sharpness=10.0),
        )


@dataclass(frozen=True)
class Lamp:
    """Round lamp: place (3,) and radius, in m; power, the radiance of a white surface that faces
    the lamp at distance ``reach`` (m); and whether it casts shadows.
    """

    place: Array
    radius: float
    power: float
    reach: float
    shadows: bool = False


@dataclass(frozen=True)
class Lighting:
    """Lamps and ambient light: from above (+z) and from below."""

    lamps: tuple[Lamp, ...]
    sky: float
    ground: float


def radiance(
    shape: Shape, material: Material, points: Array, to_camera: Array, lit: Array, light: Lighting
) -> Array:
    """Light (n,) from one shape's points (3, n) towards the camera; 1 is white in full light.

    to_camera : unit (3, n). lit : (n,) visible share of the lamp that casts shadows.
    """
    n = shape.normal(points)
    albedo = np.full(points.shape[1], material.albedo)
    if material.pattern is not None:
        albedo = albedo * material.pattern.factor(shape.local(points))
    up = 0.5 + 0.5 * n[2]
    diffuse = light.ground + (light.sky - light.ground) * up
    shine = np.zeros(points.shape[1])
    axis = shape.axis if material.brushed and isinstance(shape, Cylinder) else None
    for lamp in light.lamps:
        to_lamp = lamp.place[:, None] - points
        dist2 = np.einsum("in,in->n", to_lamp, to_lamp)
        to_lamp /= np.sqrt(dist2)
        power = lamp.power * lamp.reach**2 / dist2 * (lit if lamp.shadows else 1.0)
        facing = np.maximum(np.einsum("in,in->n", n, to_lamp), 0.0)
        diffuse = diffuse + power * facing
        if material.gloss > 0:
            shine = shine + power * _highlight(material, axis, n, to_lamp, to_camera) * (facing > 0)
    out = material.emission + albedo * diffuse + material.gloss * shine
    if material.mirror > 0:
        out = out + material.mirror * _surroundings(n, to_camera, light)
    return out


def _highlight(
    material: Material, axis: Array | None, n: Array, to_lamp: Array, to_camera: Array
) -> Array:
    """Blinn-Phong's lobe (n,), or Ward's lobe without its constant factor for a brushed
    cylinder.
    """
    h = to_lamp + to_camera
    h /= np.sqrt(np.maximum(np.einsum("in,in->n", h, h), 1e-12))
    hn = np.maximum(np.einsum("in,in->n", h, n), 1e-3)
    if axis is None:
        return hn**material.sharpness
    along = inner(h, axis)
    across2 = np.maximum(1 - along**2 - hn**2, 0.0)
    return np.exp(-(across2 / BRUSH_ACROSS**2 + along**2 / BRUSH_ALONG**2) / hn**2)


def _surroundings(n: Array, to_camera: Array, light: Lighting) -> Array:
    """Blurred reflection (n,) of a room: a dark floor, a bright ceiling, two windows."""
    cosine = np.einsum("in,in->n", n, to_camera)
    x, y, z = 2 * cosine * n - to_camera
    up = 1 / (1 + np.exp(-6 * z))
    band = np.exp(-(((x * 0.8 - y * 0.6) - 0.35) ** 2) / 0.02) * (z > -0.3)
    band = band + 0.7 * np.exp(-(((x * 0.5 + y * 0.87) + 0.5) ** 2) / 0.03) * (z > -0.3)
    return light.ground + (light.sky - light.ground) * up + 0.5 * light.sky * band
