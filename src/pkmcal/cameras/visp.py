"""XML camera files of ViSP (vpXmlParserCamera).

With perspectiveProjWithDistortion a pixel is u = u0 + px x (1 + kud r^2), which is OpenCV's k1;
kdu belongs to the inverse, which ViSP estimates on its own and pkmcal does not need.
"""

from __future__ import annotations

from math import isfinite
from xml.etree.ElementTree import Element, ParseError, fromstring

from pkmcal.cameras.foreign import Intrinsics, named_entry
from pkmcal.errors import InputError
from pkmcal.files import quoted
from pkmcal.wording import listed

_WITH, _WITHOUT = "perspectiveProjWithDistortion", "perspectiveProjWithoutDistortion"


def is_visp(text: str) -> bool:
    """Whether a text is a camera file of ViSP."""
    return all(tag in text for tag in ("<camera>", "<model>", "<px>"))


def read_visp(text: str, label: str, name: str | None) -> Intrinsics:
    """Intrinsics of a ViSP camera: the model with distortion if the file has several.

    name : the camera's <name>; may be None if the file has one camera. Raises InputError.
    """
    try:
        if text.count("<!") > text.count("<!--"):
            raise ParseError  # a document type, whose entities have no place in a camera file
        root = fromstring(text)
    except (ParseError, ValueError):
        raise InputError("not valid as ViSP writes it", where=label) from None
    cameras = {(one.findtext("name") or "").strip(): one for one in root.iter("camera")}
    camera = named_entry(cameras, name, label)
    models = {(one.findtext("type") or "").strip(): one for one in camera.iter("model")}
    word = next((w for w in (_WITH, _WITHOUT) if w in models), None)
    if word is None:
        raise InputError(
            "this camera or lens model is not supported",
            where=f"{label}, model, type",
            found=listed(list(models)) or "none",
            expected=listed([_WITH, _WITHOUT]),
            next_step="Calibrate again from images of a board: pkmcal camera",
        )
    model = models[word]
    width, height = (_number(camera, key, label) for key in ("image_width", "image_height"))
    px, py, u0, v0 = (_number(model, key, label) for key in ("px", "py", "u0", "v0"))
    return Intrinsics(
        model="pinhole",
        image_size=(width, height),
        focal=(px, py),
        center=(u0, v0),
        distortion=(_number(model, "kud", label),) if word == _WITH else (),
        where=label,
    )


def _number(parent: Element, key: str, label: str) -> float:
    """Finite number of a child element; raises InputError."""
    text = parent.findtext(key)
    if text is None:
        raise InputError("this is missing", where=f"{label}, {key}", expected="a number")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        raise InputError(
            "this is no number", where=f"{label}, {key}", found=quoted(text), expected="a number"
        )
    return value
