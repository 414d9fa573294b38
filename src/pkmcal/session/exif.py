"""A camera of which no more is known than the focal length that its photographs' EXIF tells."""

from __future__ import annotations

from dataclasses import replace
from math import hypot
from pathlib import Path

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras import Camera, camera_models
from pkmcal.errors import InputError
from pkmcal.files import open_image, read_exif
from pkmcal.session.image_files import photograph_header

EXIF_CAMERA_WORD = "exif"
"""The word in place of a camera's file."""
FILM_DIAGONAL = hypot(36.0, 24.0)
"""Diagonal (mm) of the film that the focal length is told for."""
FOCAL_SIGMA = 0.03
"""Standard deviation of that focal length, relative: it is a whole number, 2 % of a telephone's 26
mm, and some makers go by the width of the film in place of its diagonal, 4 % for 4:3 pictures."""
ASPECT_SIGMA = 1e-3
"""The same of one focal length against the other: pixels are square."""
CENTER_SIGMA = 0.01
"""Standard deviation of the centre, in image widths: how far lenses are glued off the middle."""
DISTORTION_SIGMA = {"k1": 0.1, "k2": 0.1, "p1": 1e-3, "p2": 1e-3, "k3": 0.1}
"""Standard deviations of the distortion: a tenth is what a telephone's lens has, and most programs
in a telephone have taken it out."""


def camera_by_exif(photographs: list[tuple[Path, str]], where: str) -> Camera:
    """The pinhole camera that took some photographs, with the covariance of what EXIF leaves open.

    photographs : paths, and names for messages. Raises `InputError` where one does not tell its
    focal length, or they do not tell the same.
    """
    entries: dict[tuple[float, tuple[int, int]], str] = {}
    sizes: list[tuple[int, int]] = []
    for path, label in photographs:
        width, height = photograph_header(path, label)
        with path.open("rb") as stream:
            focal = read_exif(open_image(stream, label)).focal_35mm
        if focal is None:
            raise InputError(
                "the photograph does not tell the focal length it was taken with",
                where=label,
                found="no EXIF FocalLengthIn35mmFilm",
                expected=f"a JPEG file as the camera wrote it, for {where} says camera: exif",
                next_step="Calibrate the camera with pkmcal camera, and name its file",
            )
        sizes.append((width, height))
        entries.setdefault((focal, (max(width, height), min(width, height))), label)
    if len(entries) > 1:
        (one, first), (other, second) = list(entries.items())[:2]
        raise InputError(
            "the photographs of one camera tell different focal lengths or sizes",
            where=second,
            found=f"{_described(*other)}, where {first} has {_described(*one)}",
            expected="one lens, not zoomed, and uncropped photographs",
            next_step="Give photographs by another lens a station of their own",
        )
    size = max(sizes, key=sizes.count)  # others were turned by a quarter
    return _camera(next(iter(entries))[0] / FILM_DIAGONAL * hypot(*size), size)


def _described(focal: float, size: tuple[int, int]) -> str:
    return f"{focal:g} mm at {size[0]}x{size[1]}"


def _camera(focal: float, size: tuple[int, int]) -> Camera:
    """With its focal length in px."""
    kind = camera_models()["pinhole"]
    middle = [(size[0] - 1) / 2, (size[1] - 1) / 2]
    camera = kind(size, np.array([focal, focal, *middle, 0.0, 0.0, 0.0, 0.0, 0.0]))
    covariance: Array = np.zeros((len(camera.parameters),) * 2)
    covariance[:2, :2] = (FOCAL_SIGMA * focal) ** 2
    covariance[0, 0] += (ASPECT_SIGMA * focal) ** 2
    covariance[2, 2] = covariance[3, 3] = (CENTER_SIGMA * size[0]) ** 2
    for name, sigma in DISTORTION_SIGMA.items():
        k = kind.parameter_names.index(name)
        covariance[k, k] = sigma**2
    return replace(camera, covariance=covariance)
