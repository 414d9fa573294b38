"""Camera files of pkmcal, OpenCV, ROS, Kalibr, mrcal, COLMAP and ViSP."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras.colmap import is_colmap, read_colmap
from pkmcal.cameras.contract import Camera, camera_models
from pkmcal.cameras.foreign import Intrinsics, named_entry
from pkmcal.cameras.mrcal import is_mrcal, read_mrcal
from pkmcal.cameras.pinhole import PINHOLE_TERMS
from pkmcal.cameras.visp import is_visp, read_visp
from pkmcal.errors import InputError
from pkmcal.files import (
    LARGEST_WRITTEN_FILE,
    Document,
    closest,
    given_path,
    parse_yaml,
    quoted,
    read_text,
    validated_document,
    yaml_text,
)
from pkmcal.wording import count as count_of
from pkmcal.wording import listed


def load_camera(path: Path | str, label: str | None = None) -> Camera:
    """Read a camera file of pkmcal, OpenCV, ROS, Kalibr, mrcal, COLMAP or ViSP; the format is
    detected from the content.

    Parameters
    ----------
    path :
        The file. For a file of Kalibr, COLMAP or ViSP with several cameras, the camera's name
        follows a #, ``camchain.yaml#cam1``.
    label :
        The file's name in messages.

    Raises
    ------
    pkmcal.errors.InputError
        Any fault of the file, with its line.

    """
    path, camera = camera_path(given_path(path, "a camera's file"))
    label = label.removesuffix(f"#{camera}") if label else path.name
    text = _text_of(path, label)
    if is_visp(text):
        return _from_intrinsics(read_visp(text, label, camera))
    if is_mrcal(text) and camera is not None:
        raise _without_names(label, camera)
    if is_mrcal(text):
        return _from_intrinsics(read_mrcal(text, label))
    if is_colmap(text):
        return _from_intrinsics(read_colmap(text, label, camera))
    if _is_opencv(text):
        return _from_opencv(text, label)
    document = parse_yaml(text, path, label)
    if cameras := _kalibr_names(document.data):
        return _from_kalibr(document, cameras, camera)
    _check_kind(document)
    if camera is not None:
        raise _without_names(label, camera)
    if "camera_matrix" in document.data:
        return _from_ros(document)
    if _is_ros_message(document.data):
        return _from_ros(_camera_info_file(document))
    return camera_from_document(document)


def is_camera_file(path: Path | str) -> bool:
    """Whether a path, with or without a # and a name, leads to a camera's file."""
    path, _ = camera_path(path)
    if not path.is_file():
        return False
    text = _text_of(path, path.name)
    if any(one(text) for one in (is_visp, is_mrcal, is_colmap)) or _is_opencv(text):
        return True
    if path.suffix not in (".yaml", ".yml"):
        return False
    data = parse_yaml(text, path, path.name).data
    own = data.get("model") in camera_models()
    ros = "camera_matrix" in data or _is_ros_message(data)
    return own or ros or bool(_kalibr_names(data))


def _text_of(path: Path, label: str) -> str:
    """Text of a camera file; of several ROS messages the first. OpenCV's first line, no YAML, is a
    comment in files of Kalibr, to which OpenVINS adds it.
    """
    text = read_text(path, label, LARGEST_WRITTEN_FILE)
    if text.startswith("%YAML:1.0") and "opencv-matrix" not in text and "camera_model:" in text:
        return text.replace("%", "#", 1)
    if "distortion_model:" in text and re.search(r"^[kK]:", text, re.MULTILINE):
        parts = re.split(r"^---\s*$", text, flags=re.MULTILINE)
        return next(part for part in parts if "distortion_model:" in part)
    return text


def _is_opencv(text: str) -> bool:
    """Whether a text is a file of OpenCV's FileStorage."""
    return "opencv-matrix" in text or text.startswith(("%YAML:1.0", "<?xml", "<opencv"))


def _kalibr_names(data: Mapping[str, Any]) -> list[str]:
    """Names of the cameras in Kalibr's format."""
    return [
        key
        for key, one in data.items()
        if isinstance(one, dict)
        and ("camera_model" in one or {"intrinsics", "resolution"} <= one.keys())
    ]


def _without_names(label: str, camera: str) -> InputError:
    """Error about a name behind a # where the file's format has one camera without a name."""
    return InputError(
        "the file holds no cameras with names", where=label, found=camera, code="camera.unnamed"
    )


def written_camera(file: str) -> str:
    """Name of the output file for a camera that was refined with the machine, or rotated by 180
    degrees as its images were.

    file : the camera's file as the session names it. cameras/front.yaml becomes camera-front.yaml;
        other folders, and a #, become hyphens.
    """
    parts = re.split(r"[/\\#]", re.sub(r"\.(ya?ml|xml|json)(?=#|$)", "", file))
    return f"camera-{'-'.join(p for p in parts if p not in ('', '.', '..', 'cameras'))}.yaml"


def camera_path(path: Path | str) -> tuple[Path, str | None]:
    """Path of a camera's file, and the camera's name within the file if one follows a #."""
    path = Path(path)
    file, sign, camera = path.name.rpartition("#")
    return (path.with_name(file), camera) if file and sign and not path.exists() else (path, None)


def camera_from_document(document: Document) -> Camera:
    """Camera from a document in pkmcal's format, validated; raises InputError."""
    models = camera_models()
    name = document.data.get("model")
    if not isinstance(name, str) or name not in models:
        guess = closest(str(name), models)
        raise InputError(
            what="no such camera model" if name is not None else "the camera's model is missing",
            where=document.where("model"),
            found=name,
            expected=f"{guess}" if guess else " or ".join(sorted(models)),
            next_step=None
            if name is not None
            else "OpenCV's files have camera_matrix, image_width and image_height; ROS's"
            " camera_matrix; Kalibr's camera_model under cam0",
        )
    fields = validated_document(document, models[name].schema)
    camera = models[name].from_document(fields)
    width, height = camera.image_size
    if not np.isfinite(camera.ray(np.array([[(width - 1) / 2, (height - 1) / 2]]))).all():
        raise InputError(
            "the camera has no ray in the middle of its image",
            where=document.label,
            found=f"image_size {quoted(list(camera.image_size))}, and lens numbers by which no ray"
            " of light ends there",
            expected="focal, center and distortion of images of this size",
        )
    if fields.covariance is None:
        return camera
    where = document.where("covariance")
    return replace(camera, covariance=_checked_covariance(fields.covariance, camera, where))


def _check_kind(document: Document) -> None:
    """Raise `InputError` for files of Kalibr that describe something other than a camera."""
    parts = [document.data, *(one for one in document.data.values() if isinstance(one, dict))]
    if any("gyroscope_noise_density" in part for part in parts):
        kind, key = "an inertial sensor", "gyroscope_noise_density"
    elif "target_type" in document.data:
        kind, key = "a calibration board", "target_type"
    else:
        return
    raise InputError(
        f"the file describes {kind}, not a camera",
        where=document.label,
        found=key,
        expected="cam0 with camera_model, intrinsics and resolution",
        next_step="Name the file that Kalibr wrote of its cameras, camchain.yaml or"
        " camchain-imucam.yaml",
        code="camera.other_file",
    )


def _checked_covariance(rows: tuple[tuple[float, ...], ...], camera: Camera, where: str) -> Array:
    """Covariance (n, n) of the camera's parameters, checked for size, symmetry and negative
    variances.
    """
    n = len(camera.parameter_names)
    if len(rows) != n or any(len(row) != n for row in rows):
        raise InputError(
            "the covariance has another size than the parameters",
            where=where,
            found=f"{len(rows)} rows of {len(rows[0]) if rows else 0}",
            expected=f"{n} rows of {n}, for {', '.join(camera.parameter_names)}",
        )
    matrix = np.array(rows)
    eigenvalues = np.linalg.eigvalsh((matrix + matrix.T) / 2)
    if not np.allclose(matrix, matrix.T, rtol=1e-6) or eigenvalues[0] < -1e-9 * abs(
        eigenvalues[-1]
    ):
        raise InputError("the covariance is not symmetric, or has negative variances", where=where)
    return matrix


def camera_text(camera: Camera) -> str:
    """Text of a camera file; :func:`load_camera` reads back the same camera."""
    document = camera.document()
    if camera.covariance is not None:
        document["covariance"] = camera.covariance.tolist()
    return yaml_text(document)


CAMERA_FILE_FORMATS = ("opencv", "ros", "kalibr")
CAMERA_NUMBER_ROUNDING = 1e-12
"""Relative difference allowed between a number before writing and after reading; decimal text with
sixteen digits stays below."""
_ROS = {
    "plumb_bob": "pinhole", "rational_polynomial": "rational", "equidistant": "fisheye",
    "fisheye": "fisheye",
}  # fmt: skip
"""Camera models by ROS's distortion model."""
_ROS_ZERO = ("", "none", "brown_conrady", "inverse_brown_conrady", "modified_brown_conrady")
"""Distortion models that drivers write for images without distortion; supported where all
coefficients are zero."""
_KALIBR = {
    ("pinhole", "radtan"): "pinhole",
    ("pinhole", "none"): "pinhole",
    ("pinhole", "equidistant"): "fisheye",
    ("omni", "radtan"): "unified",
    ("omni", "none"): "unified",
    ("ds", "none"): "double_sphere",
    ("eucm", "none"): "extended_unified",
}
"""Camera models by Kalibr's camera and distortion model."""
_KALIBR_NAMES = {
    "pinhole": ("pinhole", "radtan"),
    "fisheye": ("pinhole", "equidistant"),
    "unified": ("omni", "radtan"),
    "double_sphere": ("ds", "none"),
    "extended_unified": ("eucm", "none"),
}
"""Kalibr's camera and distortion model by camera model."""
OPENCV_COEFFICIENTS = (0, 4, 5, 8, 12, 14)
"""Numbers of distortion coefficients that OpenCV's lens models have."""
ROS_MATRIX_ROUNDING = 1e-3
"""Relative difference between the camera matrix and the projection matrix of one lens."""
OPENCV_MODELS = ("pinhole", "rational", "fisheye", "unified")
"""Camera models that OpenCV has."""
_ROS_TERMS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
"""Number of coefficients by ROS's distortion model."""
_OPENCV_NAMES: dict[str, tuple[str, ...]] = {
    "matrix": ("camera_matrix", "cameraMatrix", "K", "Camera_Matrix"),
    "distortion": ("distortion_coefficients", "distCoeffs", "D", "Distortion_Coefficients"),
    "width": ("image_width", "image_Width", "width"),
    "height": ("image_height", "image_Height", "height"),
    "xi": ("xi", "Xi"),
}
"""Names under which OpenCV's programs write each quantity."""


def foreign_text(camera: Camera, path: Path | str, form: str) -> str:
    """Text of another program's camera file, verified by reading it back.

    form : opencv (XML if the path has this suffix, else YAML), ros or kalibr.
    Raises InputError if the format is unknown or cannot represent the camera.
    """
    path = Path(path)
    if form not in CAMERA_FILE_FORMATS:
        raise InputError(
            "no such format of camera files",
            found=form,
            expected=closest(form, CAMERA_FILE_FORMATS) or listed(CAMERA_FILE_FORMATS),
        )
    if form == "opencv":
        text = _opencv_text(camera, xml=path.suffix.lower() == ".xml")
        again = _from_opencv(text, path.name)
    elif form == "ros":
        text = yaml_text(_ros_data(camera, path.stem))
        again = _from_ros(parse_yaml(text, path))
    else:
        text = yaml_text({"cam0": _kalibr_data(camera)})
        again = _from_kalibr(parse_yaml(text, path), ["cam0"], None)
    same = type(again) is type(camera) and tuple(again.image_size) == tuple(camera.image_size)
    if not same or not np.allclose(
        again.parameters, camera.parameters, rtol=CAMERA_NUMBER_ROUNDING, atol=1e-300
    ):
        raise InputError(
            f"the format {form} does not keep this camera", where=path.name, found=again.model
        )
    return text


def _from_opencv(text: str, label: str) -> Camera:
    """Camera of an OpenCV file, YAML or XML."""
    import cv2

    try:
        storage = cv2.FileStorage(text, cv2.FileStorage_READ | cv2.FileStorage_MEMORY)
        numbers: dict[str, Any] = {
            key: _opencv_node(storage, names, label) for key, names in _OPENCV_NAMES.items()
        }
        keys = storage.root().keys()
        flag, model_name = (storage.getNode(n) for n in ("fisheye_model", "distortion_model"))
        fisheye = (not flag.empty() and flag.real() != 0) or (
            not model_name.empty() and model_name.isString() and "fisheye" in model_name.string()
        )
        storage.release()
    except (cv2.error, SystemError) as error:  # SystemError: its constructor met invalid YAML
        fault = re.search(r"\((\d+)\): ([^'\n]+)", str(error.__cause__ or error))
        raise InputError(
            "not valid as OpenCV writes it",
            where=f"{label}, line {fault[1]}" if fault else label,
            found=fault[2] if fault else None,
            expected="a file of cv2.FileStorage",
            next_step="Write it again with cv2.FileStorage",
        ) from None
    for key in ("matrix", "width", "height", "distortion"):
        if numbers[key] is None:
            raise InputError(
                f"the camera's {key} is missing",
                where=label,
                found=listed(keys),
                expected=_OPENCV_NAMES[key][0],
                next_step="Add it; a lens without distortion has five zeros"
                if key == "distortion"
                else "Add it, or calibrate again from images of a board: pkmcal camera",
            )
    k, xi = numbers["distortion"], numbers["xi"]
    counts = {"matrix": 9, "distortion": len(k), "width": 1, "height": 1, "xi": 1}
    for key, count in counts.items():
        values = numbers[key]
        if values is not None and (len(values) != count or not np.all(np.isfinite(values))):
            raise InputError(
                f"the camera's {key} is not what it should be",
                where=f"{label}, {_OPENCV_NAMES[key][0]}",
                found=quoted(values.tolist()),
                expected=count_of(count, "finite number"),
            )
    size = float(numbers["width"][0]), float(numbers["height"][0])
    model = "unified" if xi is not None else "fisheye" if fisheye else _opencv_model(k)
    own = {} if xi is None else {"xi": float(xi[0])}
    _check_coefficients(k, f"{label}, {_OPENCV_NAMES['distortion'][0]}")
    where = f"{label}, {_OPENCV_NAMES['matrix'][0]}"
    return _camera_from_numbers(model, size, numbers["matrix"], k, own, where)


def _opencv_node(storage: Any, names: tuple[str, ...], label: str) -> Array | None:
    """Numbers (n,) under the first of several names that an OpenCV file has, or None; raises
    InputError for a matrix without them.
    """
    import cv2

    for name in names:
        node = storage.getNode(name)
        if node.empty():
            continue
        if node.isInt() or node.isReal():
            return np.array([node.real()])
        try:
            matrix = node.mat()
        except cv2.error:
            raise InputError(
                "this is no matrix as OpenCV writes it",
                where=f"{label}, {name}",
                expected="rows, cols, dt, and as many numbers as rows times cols",
                next_step="Correct it, or calibrate again from images of a board: pkmcal camera",
            ) from None
        if matrix is not None:
            return np.asarray(matrix, dtype=float).reshape(-1)
    return None


def _opencv_text(camera: Camera, xml: bool) -> str:
    """Text of an OpenCV file."""
    import cv2

    form = cv2.FileStorage_FORMAT_XML if xml else cv2.FileStorage_FORMAT_YAML
    if camera.model not in OPENCV_MODELS:
        raise InputError(
            f"OpenCV has no {camera.model} camera",
            expected=listed(OPENCV_MODELS),
            next_step="Write it for Kalibr, or calibrate with another model",
        )
    storage = cv2.FileStorage("", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY | form)
    parameters = _parameters_by_name(camera)
    storage.write("image_width", int(camera.image_size[0]))
    storage.write("image_height", int(camera.image_size[1]))
    storage.write("camera_matrix", _matrix(parameters))
    storage.write("distortion_coefficients", np.array(camera.document()["distortion"])[:, None])
    if camera.model == "fisheye":
        storage.write("fisheye_model", 1)
    if camera.model == "unified":
        storage.write("xi", np.array([[parameters["xi"]]]))
    return storage.releaseAndGetString()


def _is_ros_message(data: Mapping[str, Any]) -> bool:
    """Whether a document is a message of ROS's topic camera_info, printed by ``topic echo``."""
    return {"width", "height", "distortion_model"} <= data.keys() and ("k" in data or "K" in data)


def _camera_info_file(document: Document) -> Document:
    """A printed camera_info message as the file that ROS's drivers write.

    Raises InputError for a message about a part of the image or about binned pixels, whose numbers
    are those of the whole image.
    """
    data = {key.lower() if len(key) == 1 else key: one for key, one in document.data.items()}
    roi = data.get("roi")
    part = roi if isinstance(roi, dict) else {}
    shift = [part.get(key, 0) for key in ("x_offset", "y_offset")]
    # 0 for the whole image
    size = [part.get(key, 0) or data[key] for key in ("width", "height")]
    is_part = any(shift) or size != [data["width"], data["height"]]
    binning = [data.get(key, 0) for key in ("binning_x", "binning_y")]
    if is_part or any(n not in (0, 1) for n in binning):
        raise InputError(
            "the images are a part of the sensor, or binned, and the camera's numbers are those of"
            " the whole",
            where=document.where("roi" if is_part else "binning_x"),
            found=f"a shift of {quoted(shift)}, a size of {quoted(size)} and binning"
            f" {quoted(binning)}",
            expected="no shift, the whole size and no binning",
            next_step="Take whole images, or calibrate again from images of a board: pkmcal camera",
            code="camera.region",
        )
    names = {
        "k": "camera_matrix", "d": "distortion_coefficients", "r": "rectification_matrix",
        "p": "projection_matrix", "width": "image_width", "height": "image_height",
        "distortion_model": "distortion_model",
    }  # fmt: skip
    file = {
        name: {"data": data[key]} if len(key) == 1 else data[key]
        for key, name in names.items()
        if key in data
    }
    lines: dict[tuple[str | int, ...], int] = {
        (names[key],): document.lines[original,]
        for original in document.data
        if (key := original.lower() if len(original) == 1 else original) in names
    }
    return replace(document, data=file, lines=lines)


def _from_ros(document: Document) -> Camera:
    """Camera of a ROS camera_info file."""
    word = document.data.get("distortion_model", "plumb_bob")
    word = "" if word is None else word
    if not isinstance(word, str) or word not in (*_ROS, *_ROS_ZERO):
        value = word if isinstance(word, str) else quoted(word)
        raise _unsupported(document.where("distortion_model"), value, _ROS)
    size = _size_at(document, ("image_width",), ("image_height",))
    matrix = _numbers_at(document, ("camera_matrix", "data"), (9,))
    k = np.zeros(0)
    if word not in _ROS_ZERO or "distortion_coefficients" in document.data:
        k = _numbers_at(document, ("distortion_coefficients", "data"), range(15))
        _check_coefficients(k, document.where("distortion_coefficients"))
    if word in _ROS_ZERO and k.any():
        raise InputError(
            "this distortion model is supported without distortion only",
            where=document.where("distortion_model"),
            found=f"{quoted(word)} with coefficients that are not zero",
            expected=listed(list(_ROS)),
            next_step="Calibrate again from images of a board: pkmcal camera",
        )
    if not k.any():
        _check_projection(document, matrix)
    model = _ROS.get(word, "pinhole")
    if model == "rational":
        model = _opencv_model(k)
    return _camera_from_numbers(model, size, matrix, k, {}, document.where("camera_matrix"))


def _check_coefficients(k: Array, where: str) -> None:
    """Raise `InputError` unless OpenCV's model has a version with this number of coefficients."""
    if len(k) not in OPENCV_COEFFICIENTS:
        raise InputError(
            "OpenCV has no lens model with this number of distortion coefficients",
            where=where,
            found=f"{len(k)} terms",
            expected=listed([str(n) for n in OPENCV_COEFFICIENTS]),
        )


def _check_projection(document: Document, matrix: Array) -> None:
    """Raise `InputError` if the projection matrix of a ROS file without distortion and
    rectification contradicts its camera matrix, (9,).
    """
    if not {"projection_matrix", "rectification_matrix"} <= document.data.keys():
        return
    projection = _numbers_at(document, ("projection_matrix", "data"), (12,)).reshape(3, 4)[:, :3]
    rectification = _numbers_at(document, ("rectification_matrix", "data"), (9,))
    rectified = not np.allclose(rectification, np.eye(3).ravel(), atol=1e-6)
    if rectified or not projection.any():  # drivers write zeros where nothing was calibrated
        return
    if not np.allclose(projection.ravel(), matrix, rtol=ROS_MATRIX_ROUNDING, atol=0.01):
        raise InputError(
            "camera_matrix and projection_matrix contradict each other",
            where=document.where("projection_matrix"),
            found=quoted(projection.ravel().tolist()),
            expected=f"{quoted(matrix.tolist())}, for images without distortion",
            next_step="Calibrate again from images of a board: pkmcal camera",
        )


def _opencv_model(k: Array) -> str:
    """The simpler of pinhole and rational that has all non-zero coefficients of OpenCV's model."""
    return "rational" if np.any(k[PINHOLE_TERMS:]) else "pinhole"


def _from_intrinsics(given: Intrinsics) -> Camera:
    """Camera of intrinsics read from another program's file, validated."""
    k = np.array(given.distortion)
    model = _opencv_model(k) if given.model in ("pinhole", "rational") else given.model
    (fx, fy), (cx, cy) = given.focal, given.center
    matrix = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1])
    return _camera_from_numbers(model, given.image_size, matrix, k, {}, given.where)


def ros_distortion(camera: Camera) -> tuple[str, list[float]]:
    """ROS's distortion model of a camera and its coefficients; raises InputError if ROS has
    none.
    """
    words = {"pinhole": "plumb_bob", "rational": "rational_polynomial", "fisheye": "equidistant"}
    k = camera.document()["distortion"]
    word = words.get(camera.model)
    if word is None or any(k[_ROS_TERMS[word] :]):
        name = "rational camera with a thin prism or a tilted sensor" if word else camera.model
        raise InputError(
            f"ROS camera_info has no distortion model for a {name}" + ("" if word else " camera"),
            expected="pinhole, rational of eight coefficients, or fisheye",
            next_step="Write it for OpenCV or Kalibr, or calibrate with the model fisheye",
            code="camera.not_in_format",
        )
    return word, k[: _ROS_TERMS[word]]


def _ros_data(camera: Camera, name: str) -> dict[str, Any]:
    """Content of a ROS camera_info file; raises InputError for models that the format does not
    have.
    """
    word, k = ros_distortion(camera)
    matrix = _matrix(_parameters_by_name(camera))
    projection = np.concatenate([matrix, np.zeros((3, 1))], axis=1)

    def table(values: Array) -> dict[str, Any]:
        rows, columns = values.shape
        return {"rows": rows, "cols": columns, "data": values.reshape(-1).tolist()}

    return {
        "image_width": int(camera.image_size[0]),
        "image_height": int(camera.image_size[1]),
        "camera_name": name,
        "camera_matrix": table(matrix),
        "distortion_model": word,
        "distortion_coefficients": table(np.array([k])),
        "rectification_matrix": table(np.eye(3)),
        "projection_matrix": table(projection),
    }


def _from_kalibr(document: Document, cameras: list[str], wanted: str | None) -> Camera:
    """Camera of a Kalibr camchain file; ``wanted`` selects among several."""
    key = named_entry({name: name for name in cameras}, wanted, document.label)
    data = document.data[key]
    word = _value_at(document, (key, "camera_model"), "pinhole, omni, ds or eucm")
    pair = (str(word), str(data.get("distortion_model", "none")))
    if pair not in _KALIBR:
        models = ["-".join(names) for names in _KALIBR]
        field = "distortion_model" if any(pair[0] == one for one, _ in _KALIBR) else "camera_model"
        raise _unsupported(document.where(key, field), "-".join(pair), models)
    model = _KALIBR[pair]
    names = camera_models()[model].own
    intrinsics = _numbers_at(document, (key, "intrinsics"), (len(names) + 4,))
    size = _size_at(document, (key, "resolution", 0), (key, "resolution", 1))
    k = np.zeros(0)
    if pair[1] != "none":
        k = _numbers_at(document, (key, "distortion_coeffs"), (4,))
    fu, fv, pu, pv = intrinsics[-4:].tolist()
    matrix = np.array([fu, 0, pu, 0, fv, pv, 0, 0, 1])
    own = dict(zip(names, intrinsics.tolist(), strict=False))
    return _camera_from_numbers(model, size, matrix, k, own, document.where(key, "intrinsics"))


def _kalibr_data(camera: Camera) -> dict[str, Any]:
    """Content of one camera's entry in a Kalibr file; raises InputError for a non-zero k3."""
    parameters, k = _parameters_by_name(camera), camera.document()["distortion"]
    if camera.model not in _KALIBR_NAMES:
        raise InputError(
            f"Kalibr has no {camera.model} camera",
            expected=listed(list(_KALIBR_NAMES)),
            next_step="Write it for OpenCV, or calibrate with another model",
            code="camera.not_in_format",
        )
    if any(k[4:]):
        raise InputError(
            "Kalibr's radtan distortion has no third radial term",
            found=f"k3 = {k[4]:g}",
            next_step="Calibrate without k3, or write the camera for OpenCV or ROS",
            code="camera.not_in_format",
        )
    four = [parameters[name] for name in ("focal.x", "focal.y", "center.x", "center.y")]
    model, distortion = _KALIBR_NAMES[camera.model]
    return {
        "camera_model": model,
        "intrinsics": [*(parameters[name] for name in camera.own), *four],
        "distortion_model": distortion,
        "distortion_coeffs": list(k[:4]),
        "resolution": [int(n) for n in camera.image_size],
    }


def _camera_from_numbers(
    model: str, size: tuple[float, float], matrix: Any, k: Array, own: dict[str, float], where: str
) -> Camera:
    """Camera from another program's numbers, validated like pkmcal's own files.

    matrix : (9,) or (3, 3) camera matrix.
    k : distortion coefficients in the model's order; those beyond the model's number must be zero.
    own : the model's own fields, such as xi.
    Raises InputError.
    """
    kind = camera_models()[model]
    most = len(kind.parameter_names) - 4 - len(kind.own)
    m = np.asarray(matrix, dtype=float).reshape(3, 3)
    rest = [m[1, 0], *m[2]]
    faults = (
        (not m.any(), "a matrix of zeros, so it was never calibrated", quoted(m.ravel().tolist())),
        (not np.all(np.isfinite(m)), "a matrix that is not finite", quoted(m.ravel().tolist())),
        (not np.all(np.isfinite(k)), "distortion that is not finite", quoted(k.tolist())),
        (m[0, 1] != 0, "skew, which no model here has", f"{m[0, 1]:g}"),
        (
            not np.allclose(rest, [0, 0, 0, 1]),
            "a matrix that is not [fx, 0, cx, 0, fy, cy, 0, 0, 1], row by row",
            quoted(m.ravel().tolist()),
        ),
        (np.any(k[most:] != 0), f"distortion beyond the model's {most} terms", f"{len(k)} terms"),
        (
            any(n != round(n) for n in size),
            "an image size that is no whole number of pixels",
            quoted(list(size)),
        ),
    )
    for wrong, what, item in faults:
        if wrong:
            raise InputError(
                f"the camera has {what}",
                where=where,
                found=item,
                next_step="Correct the file, or calibrate from images of a board: pkmcal camera",
            )
    fields: dict[str, Any] = {
        "model": model,
        "image_size": [round(n) for n in size],
        "focal": [float(m[0, 0]), float(m[1, 1])],
        "center": [float(m[0, 2]), float(m[1, 2])],
        "distortion": k[:most].tolist(),
        **own,
    }
    return camera_from_document(Document(Path(where), where, fields, {}))


def _parameters_by_name(camera: Camera) -> dict[str, float]:
    """Parameters of a camera by name."""
    return dict(zip(camera.parameter_names, camera.parameters.tolist(), strict=True))


def _matrix(parameters: dict[str, float]) -> Array:
    """Camera matrix (3, 3)."""
    return np.array(
        [
            [parameters["focal.x"], 0, parameters["center.x"]],
            [0, parameters["focal.y"], parameters["center.y"]],
            [0, 0, 1.0],
        ]
    )


def _value_at(document: Document, keys: tuple[str | int, ...], expected: str) -> Any:
    """Value under a path of keys; raises InputError if absent."""
    value: Any = document.data
    for key in keys:
        try:
            value = value[key]
        except (KeyError, IndexError, TypeError):
            raise InputError(
                "this is missing", where=document.where(*keys), expected=expected
            ) from None
    return value


def _numbers_at(document: Document, keys: tuple[str, ...], counts: Sequence[int]) -> Array:
    """List of numbers under a path of keys, as an array (n,) with n among ``counts``."""
    wanted = f"{counts[0]}" if len(counts) == 1 else f"up to {max(counts)}"
    values = _value_at(document, keys, f"{wanted} numbers")
    numeric = isinstance(values, list) and all(
        isinstance(v, int | float) and not isinstance(v, bool) for v in values
    )
    if numeric and len(values) in counts:
        return np.array(values, dtype=float)
    raise InputError(
        "this is not the expected list of numbers",
        where=document.where(*keys),
        found=quoted(values),
        expected=f"{wanted} numbers",
    )


def _size_at(
    document: Document, width: tuple[str | int, ...], height: tuple[str | int, ...]
) -> tuple[int, int]:
    """Image size (width, height) from two paths of keys, px."""
    out: list[int] = []
    for keys in (width, height):
        value = _value_at(document, keys, "a whole number of pixels")
        if not isinstance(value, int) or isinstance(value, bool) or value <= 0:
            raise InputError(
                "this is no size in pixels",
                where=document.where(*keys),
                found=quoted(value),
                expected="a whole number above 0",
            )
        out.append(value)
    return out[0], out[1]


def _unsupported(where: str, text: str, models: Any) -> InputError:
    """Error about a camera or lens model that pkmcal does not support."""
    return InputError(
        "this camera or lens model is not supported",
        where=where,
        found=text,
        expected=listed(list(models)),
        next_step="Calibrate again from images of a board: pkmcal camera",
    )
