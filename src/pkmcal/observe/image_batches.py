"""The photographs of stations, and how they are passed through: so many at a time as fit.

What is worked out of one photograph takes some megabytes, so those that are looked at are held a
window at a time. Photographs of several stations are looked at together where one camera took them
alike: what is done to six in one set of arrays takes a third as long as to one after the other.
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
"""Photographs that are looked at together: their profiles take some 20 MB."""
WINDOW_BYTES = 96 * 2**20
"""Bytes that these take as grey levels at most; one may take more."""


@dataclass(frozen=True)
class Photographs:
    """One station's photographs.

    station : its number. configuration : (K,) rows of the session's joints. joints : (K, m).
    images : K grey-level arrays (height, width), decoded or when they are looked at. response : how
    their levels code light. binning : count of their pixels across, and down, that are one where
    edges are looked for (:meth:`binned`).
    """

    station: int
    camera: Camera
    configuration: Integers
    joints: Array
    images: Sequence[Integers]
    response: Response = "linear"
    binning: int = 1

    def select(self, numbers: Integers) -> Photographs:
        """Some of the photographs."""
        return replace(
            self,
            configuration=self.configuration[numbers],
            joints=self.joints[numbers],
            images=Selected(self.images, numbers),
        )

    def spread(self, most: int) -> Integers:
        """Numbers of up to ``most`` photographs, evenly over all."""
        return evenly(len(self.images), most)

    @property
    def window(self) -> int:
        """How many photographs are looked at together."""
        return min(max(fitting(self.camera.image_size, WINDOW_BYTES), 1), PHOTOGRAPHS_A_WINDOW)

    def decoded(self) -> Photographs:
        """The same with every photograph decoded; for no more than a window of them."""
        return replace(self, images=list(self.images))

    def binned(self) -> Photographs:
        """The same as edges are looked for in them, decoded; for no more than a window of them.

        Levels are averaged, not the light that they code: over the pixels of one bin, in which a
        blurred edge rises by a third, the code bends by half a level.
        """
        images = [binned(image, self.binning) for image in self.images]
        return replace(self, camera=self.camera.binned(self.binning), images=images, binning=1)

    def same_camera(self, other: Photographs) -> bool:
        """Whether others were taken, and are looked at, as these: by one camera."""
        one, its = self.camera, other.camera
        return (
            type(one) is type(its)
            and (one.image_size, self.response, self.binning)
            == (its.image_size, other.response, other.binning)
            and np.array_equal(one.parameters, its.parameters)
        )


class Placed(NamedTuple):
    """A station's photographs, where its camera stands, T_camera_base (4, 4), and where the
    platform is in each, T_base_platform (K, 4, 4).
    """

    photographs: Photographs
    T_camera_base: Array
    poses: Array

    def select(self, numbers: Integers) -> Placed:
        """Some of the photographs."""
        return Placed(self.photographs.select(numbers), self.T_camera_base, self.poses[numbers])


def placed_at(
    photographs: Sequence[Photographs], T_camera_base: Array, poses: Array
) -> list[Placed]:
    """Those of stations among all, (S, 4, 4), at poses of all configurations, (N, 4, 4)."""
    return [Placed(p, T_camera_base[p.station], poses[p.configuration]) for p in photographs]


@dataclass(frozen=True)
class PhotographWindow:
    """Photographs that are looked at together, as edges are looked for in them, decoded.

    camera, response : of all. binning : how many pixels became one. station, configuration : (K,)
    of each, station after station. joints : (K, m). images : K arrays (height, width).
    T_camera_base, poses : (K, 4, 4) where each was taken, and T_base_platform.
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
        """Of stations whose photographs are alike, no more than a window in all."""
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
    """All photographs of stations, whose numbers differ, in their order; such as follow one another
    and are alike share a window, as far as they fit.
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
