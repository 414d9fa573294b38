"""Camera known only by the focal length in the EXIF data of its images."""

from __future__ import annotations

from dataclasses import replace
from math import hypot
from pathlib import Path

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras import Camera, camera_models
from pkmcal.errors import InputError
from pkmcal.files import Exif, open_image, read_exif
from pkmcal.session.image_files import image_header
from pkmcal.wording import listed

EXIF_CAMERA_WORD = "exif"
"""Word in session.yaml in place of a camera's file."""
FILM_DIAGONAL = hypot(36.0, 24.0)
"""Diagonal (mm) of the 35 mm film to which the EXIF focal length refers."""
LEAST_SENSOR_MM, LARGEST_SENSOR_MM = 2.0, 80.0
"""Diagonals of sensors: from telephones' smallest to medium format."""
FOCAL_SIGMA = 0.03
"""Prior sigma of the EXIF focal length, relative. It is a whole number, 2 % of a telephone's 26 mm,
and some makers refer to the width of the film instead of its diagonal, a difference of 4 % for 4:3
images."""
ASPECT_SIGMA = 1e-3
"""Prior sigma of the ratio of the two focal lengths: pixels are square."""
CENTER_SIGMA = 0.01
"""Prior sigma of the centre, in image widths: the accuracy with which lenses are mounted."""
DISTORTION_SIGMA = {"k1": 0.1, "k2": 0.1, "p1": 1e-3, "p2": 1e-3, "k3": 0.1}
"""Prior sigmas of the distortion coefficients: a tenth is the distortion of a telephone's lens,
which most telephones have already removed."""


def camera_by_exif(images: list[tuple[Path, str]], where: str) -> Camera:
    """Pinhole camera from the EXIF data of images, with a covariance for everything that EXIF does
    not state.

    images : paths, and names in messages.
    Raises InputError if an image has no focal length, or if focal lengths or sizes differ.
    """
    labels: dict[tuple[float, tuple[int, int]], str] = {}
    sizes: list[tuple[int, int]] = []
    for path, label in images:
        width, height = image_header(path, label)
        with path.open("rb") as stream:
            exif = read_exif(open_image(stream, label))
        _check_uncropped(exif, (width, height), label)
        focal = _film_focal(exif, label, where)
        sizes.append((width, height))
        labels.setdefault((focal, (max(width, height), min(width, height))), label)
    if len(labels) > 1:
        (one, first), (other, second) = list(labels.items())[:2]
        raise InputError(
            "the images of one camera state different focal lengths or sizes",
            where=second,
            found=f"{_description(*other)}, where {first} has {_description(*one)}",
            expected="one lens, not zoomed, and uncropped images",
            next_step="Give images by another lens a station of their own",
        )
    size = max(sizes, key=sizes.count)  # the others are rotated by 90 degrees
    return _pinhole_camera(next(iter(labels))[0] / FILM_DIAGONAL * hypot(*size), size)


def _check_uncropped(exif: Exif, size: tuple[int, int], label: str) -> None:
    """Raise InputError for an image with other proportions than EXIF's size of the captured image;
    a resized image is no error.

    size : px.
    """
    if exif.recorded_size is None:
        return
    (short, long), (recorded_short, recorded_long) = sorted(size), sorted(exif.recorded_size)
    # resizing rounds each side by half a pixel
    if abs(short - recorded_short * long / recorded_long) > 1:
        raise InputError(
            "the image was cropped after it was taken, so that its EXIF no longer gives its focal"
            " length and centre",
            where=label,
            found=f"{size[0]}x{size[1]} pixels, of {'x'.join(map(str, exif.recorded_size))} by"
            " EXIF",
            expected="an image as the camera wrote it",
            next_step="Use the uncropped images, or calibrate the camera with pkmcal camera from"
            " images cropped in the same way, and name its file",
        )


def _film_focal(exif: Exif, label: str, where: str) -> float:
    """Focal length (mm) that gives the same field of view on 35 mm film; InputError if EXIF does
    not determine it.

    Without FocalLengthIn35mmFilm it follows from the lens's own focal length and the sensor's
    pixels per millimetre, as Canon writes them, and the size of the captured image.
    """
    if exif.focal_35mm is not None:
        return exif.focal_35mm
    needed = {
        "FocalLength": exif.focal_mm,
        "FocalPlaneXResolution": exif.pixels_per_mm,
        "PixelXDimension": exif.recorded_size,
    }
    if exif.focal_mm is None or exif.pixels_per_mm is None or exif.recorded_size is None:
        present = [name for name, value in needed.items() if value is not None]
        absent = ["FocalLengthIn35mmFilm", *(n for n, value in needed.items() if value is None)]
        raise InputError(
            "the image does not state the focal length it was taken with",
            where=label,
            found=f"no EXIF {listed(absent)}" + (f", only {listed(present)}" if present else ""),
            expected=f"a JPEG file as the camera wrote it, because {where} has camera: exif",
            next_step="Calibrate the camera with pkmcal camera, and name its file",
        )
    diagonal_mm = hypot(*exif.recorded_size) / exif.pixels_per_mm
    if not LEAST_SENSOR_MM < diagonal_mm < LARGEST_SENSOR_MM:
        raise InputError(
            "the EXIF data contradict each other: no sensor has this diagonal",
            where=label,
            found=f"{diagonal_mm:.3g} mm, by FocalPlaneXResolution and PixelXDimension",
            expected=f"{LEAST_SENSOR_MM:g} to {LARGEST_SENSOR_MM:g} mm",
            next_step="Calibrate the camera with pkmcal camera, and name its file",
        )
    return exif.focal_mm * FILM_DIAGONAL / diagonal_mm


def _description(focal: float, size: tuple[int, int]) -> str:
    """Focal length and image size for a message."""
    return f"{focal:g} mm at {size[0]}x{size[1]}"


def _pinhole_camera(focal: float, size: tuple[int, int]) -> Camera:
    """Pinhole camera without distortion, with its prior covariance. focal : px."""
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
