"""Images of stations, and their division into batches that fit into memory.

The intermediate results of one image take some megabytes, so images are processed in windows of
limited size. Images of several stations share a window if the same camera took them: processing six
images in one set of arrays takes a third of the time of processing them one by one.
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


class WindowSize(NamedTuple):
    """Largest window of images that are decoded and measured together."""

    # number of images; the profiles of so many take some 20 MB
    images: int = 32
    # size of their grey levels in bytes; a single image may be larger
    bytes: int = 96 * 2**20


WINDOW_SIZE = WindowSize()


@dataclass(frozen=True)
class StationImages:
    """Images of one station.

    station : its number in the session.
    configuration : (K,) rows of the session's joints.
    joints : (K, m) joint readings.
    images : K grey-level arrays (height, width), decoded or decoded on access.
    response : how grey levels encode light.
    binning : pixels across, and down, that are averaged to one before edges are measured
        (:meth:`binned`).
    largest : window of images that are decoded and measured together.
    """

    station: int
    camera: Camera
    configuration: Integers
    joints: Array
    images: Sequence[Integers]
    response: Response = "linear"
    binning: int = 1
    largest: WindowSize = WINDOW_SIZE

    def select(self, numbers: Integers) -> StationImages:
        """The images with these numbers."""
        return replace(
            self,
            configuration=self.configuration[numbers],
            joints=self.joints[numbers],
            images=Selected(self.images, numbers),
        )

    def spread(self, most: int) -> Integers:
        """Numbers of up to ``most`` images, spread evenly over all."""
        return evenly(len(self.images), most)

    @property
    def window(self) -> int:
        """Number of images in a window."""
        return min(max(fitting(self.camera.image_size, self.largest.bytes), 1), self.largest.images)

    def decoded(self) -> StationImages:
        """A copy with all images decoded; for at most one window of images."""
        return replace(self, images=list(self.images))

    def binned(self) -> StationImages:
        """A copy with all images decoded and binned; for at most one window of images.

        The grey levels are averaged instead of the light that they encode: over the pixels of a
        bin, in which a blurred edge rises by a third, the difference is half a level.
        """
        images = [binned(image, self.binning) for image in self.images]
        return replace(self, camera=self.camera.binned(self.binning), images=images, binning=1)

    def same_camera(self, other: StationImages) -> bool:
        """Whether the other station has the same camera parameters, image size, response and
        binning.
        """
        one, its = self.camera, other.camera
        return (
            type(one) is type(its)
            and (one.image_size, self.response, self.binning)
            == (its.image_size, other.response, other.binning)
            and np.array_equal(one.parameters, its.parameters)
        )


class Placed(NamedTuple):
    """Images of a station with the poses from which edges are predicted.

    T_camera_base : (4, 4).
    poses : T_base_platform (K, 4, 4), one for each image.
    """

    images: StationImages
    T_camera_base: Array
    poses: Array

    def select(self, numbers: Integers) -> Placed:
        """The images with these numbers."""
        return Placed(self.images.select(numbers), self.T_camera_base, self.poses[numbers])


def placed_at(images: Sequence[StationImages], T_camera_base: Array, poses: Array) -> list[Placed]:
    """Images of stations with their poses.

    T_camera_base : (S, 4, 4) of all stations of the session.
    poses : T_base_platform (N, 4, 4) of all its configurations.
    """
    return [Placed(p, T_camera_base[p.station], poses[p.configuration]) for p in images]


@dataclass(frozen=True)
class ImageWindow:
    """Images that are processed together, decoded and binned.

    camera, response : common to all images; the camera is that of the binned images.
    binning : pixels across that were averaged to one.
    station, configuration : (K,) of each image, ordered by station.
    joints : (K, m) joint readings.
    images : K arrays (height, width).
    T_camera_base, poses : (K, 4, 4) each; the latter are T_base_platform.
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
    def of(cls, placed: Sequence[Placed]) -> ImageWindow:
        """The window of stations with the same camera whose images fit into one window."""
        count = [len(one.images.images) for one in placed]
        in_view = [one.images.binned() for one in placed]
        return cls(
            camera=in_view[0].camera,
            response=in_view[0].response,
            binning=placed[0].images.binning,
            station=np.repeat([p.station for p in in_view], count),
            configuration=np.concatenate([p.configuration for p in in_view]),
            joints=np.concatenate([p.joints for p in in_view]),
            images=[image for p in in_view for image in p.images],
            T_camera_base=np.repeat([one.T_camera_base for one in placed], count, axis=0),
            poses=np.concatenate([one.poses for one in placed]),
        )


def windows(placed: Sequence[Placed]) -> Iterator[ImageWindow]:
    """Windows over the images of several stations, in order; the stations' numbers must differ.

    Consecutive stations with the same camera share a window as long as their images fit.
    """
    together: list[Placed] = []
    for one in placed:
        most, total = one.images.window, len(one.images.images)
        for first in range(0, total, most):
            part = one.select(np.arange(first, min(first + most, total)))
            count = sum(len(other.images.images) for other in (*together, part))
            if together and (count > most or not together[0].images.same_camera(part.images)):
                yield ImageWindow.of(together)
                together = []
            together.append(part)
    if together:
        yield ImageWindow.of(together)
