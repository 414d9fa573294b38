"""Image batches: the images of stations, processed in windows of bounded memory.

Intermediate arrays of one image take some megabytes, so images are processed a window at a time.
Images of several stations share a window where they have the same camera: six in one set of arrays
take a third of the time of six one after the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers, evenly
from pkmcal.cameras import Camera
from pkmcal.cameras.response import Response
from pkmcal.observe.images import Selected, binned, fitting

PHOTOGRAPHS_A_WINDOW = 32
"""Images in a window: their profiles take some 20 MB."""
WINDOW_BYTES = 96 * 2**20
"""Most bytes of a window's grey levels; a single image may take more."""


@dataclass(frozen=True)
class Photographs:
    """The images of one station.

    station : its number. configuration : (K,) rows of the session's joints. joints : (K, m).
    images : K grey-level arrays (height, width), decoded now or on access. response : curve from
    light to grey levels. binning : factor by which pixels are binned, across and down, before edges
    are measured (:meth:`binned`).
    """

    station: int
    camera: Camera
    configuration: Integers
    joints: Array
    images: Sequence[Integers]
    response: Response = "linear"
    binning: int = 1

    def select(self, numbers: Integers) -> Photographs:
        """Some of the images."""
        return replace(
            self,
            configuration=self.configuration[numbers],
            joints=self.joints[numbers],
            images=Selected(self.images, numbers),
        )

    def spread(self, most: int) -> Integers:
        """Indices of up to ``most`` images, evenly over all."""
        return evenly(len(self.images), most)

    @property
    def window(self) -> int:
        """Number of images in a window."""
        return min(max(fitting(self.camera.image_size, WINDOW_BYTES), 1), PHOTOGRAPHS_A_WINDOW)

    def decoded(self) -> Photographs:
        """The batch with every image decoded; for a window at most."""
        return replace(self, images=list(self.images))

    def binned(self) -> Photographs:
        """The batch binned as for the measurement of edges, and decoded; for a window at most.

        Grey levels are averaged, not light: over the pixels of one bin, in which a blurred edge
        rises by a third, the response is linear to half a level.
        """
        images = [binned(image, self.binning) for image in self.images]
        return replace(self, camera=self.camera.binned(self.binning), images=images, binning=1)

    def same_camera(self, other: Photographs) -> bool:
        """Whether another batch has the same camera, response and binning."""
        one, its = self.camera, other.camera
        return (
            type(one) is type(its)
            and (one.image_size, self.response, self.binning)
            == (its.image_size, other.response, other.binning)
            and np.array_equal(one.parameters, its.parameters)
        )


class Placed(NamedTuple):
    """The images of a station with the camera's pose T_camera_base (4, 4) and the platform's pose
    in each image, T_base_platform (K, 4, 4).
    """

    photographs: Photographs
    T_camera_base: Array
    poses: Array

    def select(self, numbers: Integers) -> Placed:
        """Some of the images."""
        return Placed(self.photographs.select(numbers), self.T_camera_base, self.poses[numbers])


def placed_at(
    photographs: Sequence[Photographs], T_camera_base: Array, poses: Array
) -> list[Placed]:
    """Batches with stations' poses out of (S, 4, 4) and platform poses out of (N, 4, 4)."""
    return [Placed(p, T_camera_base[p.station], poses[p.configuration]) for p in photographs]


@dataclass(frozen=True)
class PhotographWindow:
    """Images of a window, binned and decoded for the measurement of edges.

    camera, response : of all. binning : factor of their binning. station, configuration : (K,), in
    the order of stations. joints : (K, m). images : K arrays (height, width). T_camera_base, poses
    : (K, 4, 4) poses of camera and platform (T_base_platform).
    """

    camera: Camera
    response: Response
    binning: int
    station: Integers
    configuration: Integers
    joints: Array
    images: list[Integers]
    T_camera_base: Array
    poses: Array

    @classmethod
    def of(cls, placed: Sequence[Placed]) -> PhotographWindow:
        """The window of stations with the same camera, whose images fit into one."""
        count = [len(one.photographs.images) for one in placed]
        in_view = [one.photographs.binned() for one in placed]
        return cls(
            camera=in_view[0].camera,
            response=in_view[0].response,
            binning=placed[0].photographs.binning,
            station=np.repeat([p.station for p in in_view], count),
            configuration=np.concatenate([p.configuration for p in in_view]),
            joints=np.concatenate([p.joints for p in in_view]),
            images=[image for p in in_view for image in p.images],
            T_camera_base=np.repeat([one.T_camera_base for one in placed], count, axis=0),
            poses=np.concatenate([one.poses for one in placed]),
        )


def windows(placed: Sequence[Placed]) -> Iterator[PhotographWindow]:
    """Windows over all images of stations, in order. Consecutive stations with the same camera
    share windows as far as they fit.
    """
    together: list[Placed] = []
    for one in placed:
        most, total = one.photographs.window, len(one.photographs.images)
        for first in range(0, total, most):
            part = one.select(np.arange(first, min(first + most, total)))
            count = sum(len(other.photographs.images) for other in (*together, part))
            if together and (
                count > most or not together[0].photographs.same_camera(part.photographs)
            ):
                yield PhotographWindow.of(together)
                together = []
            together.append(part)
    if together:
        yield PhotographWindow.of(together)
