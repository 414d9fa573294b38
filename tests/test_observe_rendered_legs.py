"""Images of legs for the tests of observation, rendered without pkmcal's geometry or simulation.

Every pixel's ray is intersected with every tube (a quadratic equation); pixels at borders are
sampled at 36 points. Lens blur, noise and 8 bits follow. The tests below are of the rendering
itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pkmcal.cameras import camera_models
from pkmcal.geometry.cylinders import edge_normal_jacobians
from pkmcal.geometry.rigid import look_at, perturb
from pkmcal.mechanisms import load_mechanism

BLUR = 0.6
"""Lens blur, px; with the pixel's own 0.29 and the interpolation, images have about 0.7."""
LAMP = np.array([-0.5, -0.7, 0.5]) / np.linalg.norm([-0.5, -0.7, 0.5])
"""Towards the light, base frame: from the camera's left, and above."""
FRONT = look_at(np.array([0.1, -0.85, 0.32]), np.array([0.0, 0.0, 0.18]), np.array([0.0, 0.0, 1.0]))


@cache
def camera_of(distorted=True):
    distortion = [-0.2, 0.08, 1e-3, -2e-3, 0.0] if distorted else [0.0] * 5
    parameters = np.array([600.0, 603.0, 321.3, 238.2, *distortion])
    return camera_models()["pinhole"]((640, 480), parameters)


@dataclass(frozen=True)
class Tube:
    """A cylinder without ends: its axis from ``start`` along unit ``axis``, base frame."""

    leg: int
    start: np.ndarray
    axis: np.ndarray
    length: float
    radius: float


def tubes_at(machine, T_base_platform):
    """The machine's tubes at a pose, from its file's fields."""
    tubes = []
    for number, leg in enumerate(machine.to_document()["legs"]):
        a = np.array(leg["base"]["center"])
        b = T_base_platform[:3, :3] @ leg["platform"]["center"] + T_base_platform[:3, 3]
        whole = np.linalg.norm(b - a)
        u = (b - a) / whole
        for tube in leg["tubes"]:
            stop = min(tube["to"], whole)
            tubes.append(Tube(number, a + tube["from"] * u, u, stop - tube["from"], tube["radius"]))
    return tubes


def meet(tube, T_camera_base, rays):
    """Distance along rays (..., 3) to a tube, inf beside it, and the surface's normal there."""
    a = T_camera_base[:3, :3] @ tube.start + T_camera_base[:3, 3]
    u = T_camera_base[:3, :3] @ tube.axis
    d_along, a_along = rays @ u, a @ u
    dd = np.sum(rays**2, axis=-1) - d_along**2
    da = rays @ a - d_along * a_along
    rest = da**2 - dd * (a @ a - a_along**2 - tube.radius**2)
    with np.errstate(invalid="ignore"):
        far = (da - np.sqrt(rest)) / dd
    place = far * d_along - a_along
    hit = (rest > 0) & (far > 0) & (place >= 0) & (place <= tube.length)
    normal = (far[..., None] * rays - a - place[..., None] * u) / tube.radius
    return np.where(hit, far, np.inf), normal


def light_on(tubes, T_camera_base, rays, background):
    """Light (...) along rays (N, 3) and the leg that it comes from, -1 for none."""
    level, leg = np.array(background, dtype=float), np.full(len(rays), -1)
    nearest = np.full(len(rays), np.inf)
    lamp = T_camera_base[:3, :3] @ LAMP
    for tube in tubes:
        maybe = np.flatnonzero(near(tube, T_camera_base, rays))
        distance, normal = meet(tube, T_camera_base, rays[maybe])
        first = distance < nearest[maybe]
        at = maybe[first]
        nearest[at], leg[at] = distance[first], tube.leg
        level[at] = 190 * (0.3 + 0.7 * np.maximum(normal[first] @ lamp, 0))
    return level, leg


def near(tube, T_camera_base, rays):
    """Rays (N, 3) of z = 1 that may meet a tube: in the box around its ends."""
    R, t = T_camera_base[:3, :3], T_camera_base[:3, 3]
    ends = [R @ (tube.start + s * tube.axis) + t for s in (0.0, tube.length)]
    low = np.min([(e[:2] - 1.5 * tube.radius) / e[2] for e in ends], axis=0)
    high = np.max([(e[:2] + 1.5 * tube.radius) / e[2] for e in ends], axis=0)
    x, y = rays[:, 0], rays[:, 1]
    return (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])


@cache
def pixel_rays(distorted):
    """Rays of z = 1 through all pixels (H W, 3), and their change by a pixel in x and in y."""
    camera = camera_of(distorted)
    width, height = camera.image_size
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    pixel = np.stack([x, y], axis=-1).reshape(-1, 2).astype(float)
    corners = [camera.ray(pixel + d) for d in ([0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5])]
    middle, right, remainder, down, up = (ray / ray[:, 2:] for ray in corners)
    return middle, right - remainder, down - up


def drawn_image(tubes):
    """Which leg each pixel's centre shows from FRONT, (480, 640); -1 for none."""
    return light_on(tubes, FRONT, pixel_rays(True)[0], np.zeros(480 * 640))[1].reshape(480, 640)


def draw(tubes, T_camera_base=FRONT, *, distorted=True, background=200.0, noise=1.0, seed=0):
    """An image (480, 640) uint8 and the leg at each pixel's centre."""
    middle, by_x, by_y = pixel_rays(distorted)
    flat = np.broadcast_to(background, (480, 640)).reshape(-1)
    level, leg = light_on(tubes, T_camera_base, middle, flat)
    grid = leg.reshape(480, 640)
    border = np.zeros(grid.shape, dtype=bool)
    for axis in (0, 1):
        step = np.diff(grid, axis=axis) != 0
        border |= np.insert(step, 0, False, axis) | np.insert(step, step.shape[axis], False, axis)
    # tubes of one leg differ in radius: their common end is a border too, but is not tested
    again = np.flatnonzero(border)
    place = (np.arange(6) + 0.5) / 6 - 0.5
    dx, dy = (v.ravel()[:, None, None] for v in np.meshgrid(place, place))
    inner = middle[again] + dx * by_x[again] + dy * by_y[again]
    shades = light_on(tubes, T_camera_base, inner.reshape(-1, 3), np.tile(flat[again], 36))[0]
    level[again] = shades.reshape(36, -1).mean(axis=0)
    soft = gaussian_filter(level.reshape(480, 640), BLUR, mode="nearest")
    read = soft + noise * np.random.default_rng(seed).normal(size=soft.shape)
    return np.clip(np.round(read), 0, 255).astype(np.uint8), grid


@cache
def machine():
    return load_mechanism("gough-stewart")


@cache
def poses(count=6):
    """Platform poses over the workspace, the same in all tests."""
    rng = np.random.default_rng(7)
    steps = rng.uniform(-1, 1, (count, 6)) * np.repeat([0.2, 0.03], 3)
    return perturb(machine().home(), steps)


@cache
def rendered_images(distorted=True):
    """Images of the machine with nominal geometry, from FRONT, and the legs at their pixels."""
    made = [
        draw(tubes_at(machine(), T), distorted=distorted, seed=k) for k, T in enumerate(poses())
    ]
    return [image for image, _ in made], [legs for _, legs in made]


def redrawn(seed, spread):
    """The machine with every joint centre drawn wrongly, by ``spread`` m along each axis."""
    table = machine().parameters
    centres, own = table.of_kind("center"), np.ones(len(table), dtype=bool)
    own[table.of_kind("scale")] = False
    error = np.zeros(len(own))
    error[own] = spread * np.random.default_rng(seed).normal(size=own.sum())
    values = machine().values.copy()
    values[centres] += error[centres]
    return machine().with_values(values)


def true_normals(legs, tubes, sides, configurations):
    """Edge planes (N, 3) in FRONT's frame, from the file's fields and [B] eq. 3."""
    normals = []
    for leg, tube, side, k in zip(legs, tubes, sides, configurations, strict=True):
        shape = [t for t in tubes_at(machine(), poses()[k]) if t.leg == leg][tube]
        a, u = FRONT[:3, :3] @ shape.start + FRONT[:3, 3], FRONT[:3, :3] @ shape.axis
        normals.append(edge_normal_jacobians(a, a + u, np.array(shape.radius), side).n)
    return np.array(normals)


def outward_to(normal, pixel, outward, camera):
    """Distance along ``outward`` (px) from a pixel to the plane n . x = 0, by secants.

    normal : (..., 3) against pixel and outward (..., n, 2).
    """

    def off(s):
        return np.sum(camera.ray(pixel + s[..., None] * outward) * normal[..., None, :], axis=-1)

    before, now = np.zeros(pixel.shape[:-1]), np.ones(pixel.shape[:-1])
    at_before, at_now = off(before), off(now)
    for _ in range(8):
        slope = (at_now - at_before) / np.where(now == before, np.inf, now - before)
        step = np.where(slope == 0, 0.0, -at_now / np.where(slope == 0, 1.0, slope))
        before, at_before = now, at_now
        now = now + step
        at_now = off(now)
    return now


# the rendering itself


@pytest.mark.parametrize("distorted", [False, True])
def test_the_nominal_model_shows_a_tube_where_it_is(distorted):
    """A ball of pixels beside the projected axis is lit; the tube's area is its length by width."""
    machine_tubes = tubes_at(machine(), poses()[0])
    tube = machine_tubes[0]
    _, legs = draw([tube], distorted=distorted, noise=0.0)
    points = tube.start + np.linspace(0.02, tube.length - 0.02, 9)[:, None] * tube.axis
    pixels = camera_of(distorted).project(points @ FRONT[:3, :3].T + FRONT[:3, 3])
    x, y = np.rint(pixels).astype(int).T
    assert np.all(legs[y, x] == tube.leg)
    depth = (points @ FRONT[:3, :3].T + FRONT[:3, 3])[:, 2].mean()
    length = np.linalg.norm(pixels[-1] - pixels[0]) / (tube.length - 0.04) * tube.length
    # mean depth and the mean of both focal lengths: a few per cent
    assert (legs == tube.leg).sum() == pytest.approx(
        length * 2 * tube.radius * 600 / depth, rel=0.06
    )


def test_borders_are_smooth_and_noise_is_as_asked():
    """Grey levels along a slanted edge take all values between tube and background."""
    clean, legs = draw(tubes_at(machine(), poses()[0]), noise=0.0)
    assert len(np.unique(clean[200:300])) > 100
    noisy, _ = draw(tubes_at(machine(), poses()[0]), noise=2.0)
    away = gaussian_filter((legs >= 0).astype(float), 3) < 1e-6
    assert np.std(noisy[away]) == pytest.approx(2.0, rel=0.05)
