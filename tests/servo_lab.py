"""Machine in a plain room in front of one camera, with images at any pose, for closed loops."""

from __future__ import annotations

import numpy as np

from pkmcal.cameras import Camera, camera_models
from pkmcal.geometry.rigid import apply, look_at
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.simulation.render import PixelRays, Scene, ScenePart, Sensor, render_light, sensor_image
from pkmcal.simulation.scene import Finish, discs_of, machine_parts
from pkmcal.simulation.shapes import Wall
from pkmcal.simulation.surfaces import Clouds, Lamp, Lighting, Material, SmoothNoise

PERSPECTIVE = camera_of_size((640, 480))
MIRROR = camera_models()["unified"](
    (640, 480), np.array([165.0, 165.0, 319.5, 239.5, 1.0, 0, 0, 0, 0])
)
UP = np.array([0.0, 0.0, 1.0])
BESIDE = look_at(np.array([-0.54, 0.83, 0.33]), np.array([0.04, 0.01, 0.18]), UP)
WITHIN = look_at(np.array([0.02, 0.0, 0.054]), np.array([0.02, 0.0, 0.41]), np.array([0.0, 1, 0]))


class Lab:
    """Images of a machine at any pose, each with noise of its own."""

    def __init__(self, machine: Machine, camera: Camera, T_camera_base) -> None:
        self.machine, self.camera, self.T_camera_base = machine, camera, T_camera_base
        noise = SmoothNoise.from_rng(np.random.default_rng(2))
        self.rng = np.random.default_rng(5)
        self.discs, self.finish = discs_of(machine), Finish.from_noise(noise)
        floor = Wall(self.discs.base - 0.6 * UP, UP)
        place = np.array([0.8, -1.0, 2.5])
        self.room = Scene(
            (ScenePart(floor, Material(0.2, Clouds(noise, 0.05, 0.3)), False),),
            Lighting((Lamp(place, 0.1, 1.6, 2.5, shadows=False),), sky=0.5, ground=0.35),
        )
        self.view = PixelRays.of(camera)

    def image(self, T_base_platform, readings):
        parts = machine_parts(self.machine, self.discs, self.finish, T_base_platform, readings)
        light = render_light(self.room.having(parts), self.view, self.T_camera_base, self.rng)
        return sensor_image(light, Sensor(), self.rng)

    def painted(self, image, T_base_platform, readings, legs):
        """An image with some legs painted over."""
        import cv2

        ends = limb_ends(self.machine.layout, self.machine.values, readings, T_base_platform)
        out = image.copy()
        for j in legs:
            a, b = (self.camera.project(apply(self.T_camera_base, p[j])) for p in (ends.a, ends.b))
            cv2.line(out, a.astype(int).tolist(), b.astype(int).tolist(), 60, 40)
        return out
