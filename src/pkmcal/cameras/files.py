"""Camera files: ``model``, ``image_size`` and the model's own fields."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras.contract import Camera, camera_models
from pkmcal.errors import InputError
from pkmcal.files import closest, read_yaml, validate, write_text, yaml_text


def load_camera(path: Path | str, label: str | None = None) -> Camera:
    """Read a camera file; every fault is an InputError with its line."""
    document = read_yaml(path, label)
    models = camera_models()
    name = document.data.get("model")
    if not isinstance(name, str) or name not in models:
        guess = closest(str(name), models)
        raise InputError(
            what="no such camera model" if name else "the camera's model is missing",
            where=document.where("model"),
            found=name,
            expected=f"{guess}" if guess else " or ".join(sorted(models)),
        )
    fields = validate(document, models[name].schema)
    camera = models[name].from_document(fields)
    if fields.covariance is None:
        return camera
    where = document.where("covariance")
    return replace(camera, covariance=_checked(fields.covariance, camera, where))


def _checked(rows: tuple[tuple[float, ...], ...], camera: Camera, where: str) -> Array:
    """A covariance of the camera's parameters, or the reason why it is none."""
    n = len(camera.parameter_names)
    if len(rows) != n or any(len(row) != n for row in rows):
        raise InputError(
            "the covariance has another size than the parameters",
            where=where,
            found=f"{len(rows)} rows of {len(rows[0]) if rows else 0}",
            expected=f"{n} rows of {n}, for {', '.join(camera.parameter_names)}",
        )
    matrix = np.array(rows)
    values = np.linalg.eigvalsh((matrix + matrix.T) / 2)
    if not np.allclose(matrix, matrix.T, rtol=1e-6) or values[0] < -1e-9 * abs(values[-1]):
        raise InputError("the covariance is not symmetric, or has negative variances", where=where)
    return matrix


def save_camera(camera: Camera, path: Path | str) -> None:
    """Write a camera file that :func:`load_camera` reads back the same."""
    write_text(Path(path), camera_text(camera))


def camera_text(camera: Camera) -> str:
    """The text of a camera file, with the covariance where it is known."""
    document = camera.document()
    if camera.covariance is not None:
        document["covariance"] = camera.covariance.tolist()
    return yaml_text(document)
