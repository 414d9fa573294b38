"""Camera files: ``model``, ``image_size`` and the model's own fields."""

from __future__ import annotations

from pathlib import Path

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
    camera = models[name]
    return camera.from_document(validate(document, camera.schema))


def save_camera(camera: Camera, path: Path | str) -> None:
    """Write a camera file that :func:`load_camera` reads back the same."""
    write_text(Path(path), yaml_text(camera.document()))
