"""The constants of an exported C source, read from its text, and the closure by them alone."""

from __future__ import annotations

import re

import numpy as np

from pkmcal.arrays import Array

_ARRAY = re.compile(
    r"static const (?:double|int|pkmcal_pose) (\w+)((?:\[\w+\])*) = \{(.*?)\n? *\};", re.S
)
_COMMENT = re.compile(r"/\*.*?\*/", re.S)
_NUMBER = re.compile(r"-?HUGE_VAL|[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def constants(text: str) -> dict[str, Array]:
    """Every constant array of a C source by its name, flat; comments are left out."""
    plain = _COMMENT.sub("", text)
    return {name: _numbers(body) for name, _, body in _ARRAY.findall(plain)}


def _numbers(body: str) -> Array:
    words = _NUMBER.findall(body)
    huge = {"HUGE_VAL": np.inf, "-HUGE_VAL": -np.inf}
    return np.array([huge[word] if word in huge else float(word) for word in words])


def closure(found: dict[str, Array], poses: Array, joints: Array, hinges: Array) -> Array:
    """The rods' and axes' equations (n, E), m, by what a source holds.

    poses (n, 4, 4), joints (n, m), hinges (n, h): as for the machine.
    """
    rot, t = poses[:, None, :3, :3], poses[:, None, :3, 3]
    joint = found["JOINT"].astype(int)
    read = np.where(joint >= 0, joints[:, np.maximum(joint, 0)], 0.0)
    a = found["BASE"].reshape(-1, 3) + _carried(found, read)
    own = found["PLATFORM"].reshape(-1, 3)
    if "HINGE" in found:
        hinge = found["HINGE"].astype(int)
        phi = np.where(hinge >= 0, hinges[:, np.maximum(hinge, 0)], 0.0)[..., None]
        parts = (found[name].reshape(-1, 3) for name in ("HINGE_COS", "HINGE_SIN"))
        swung_cos, swung_sin = parts
        own = own + np.cos(phi) * swung_cos + np.sin(phi) * swung_sin
    own = np.broadcast_to(own, (len(poses), *own.shape[-2:]))
    b = np.einsum("nrij,nrj->nri", np.broadcast_to(rot, (*own.shape, 3)), own) + t
    b = b + found.get("BAR", np.zeros(3)).reshape(-1, 3)
    reads = found.get("READS", np.full(len(joint), float("ALONG" not in found and _rods(found))))
    length = found["LENGTH"] + reads * read
    line = b - a
    rods = np.linalg.norm(line, axis=-1) - length
    return np.concatenate([rods, _axes(found, poses[:, :3, :3], line)], axis=1)


def _rods(found: dict[str, Array]) -> bool:
    """Without READS all rods read or none does: none where cranks or sliders carry them."""
    return "MIDDLE" not in found


def _carried(found: dict[str, Array], read: Array) -> Array:
    """How far sliders and cranks carry the rods' ends, (n, L, 3) m."""
    count = len(found["LENGTH"])
    kind = found.get("KIND")
    if kind is None:
        kind = np.full(count, 2 if "ARM" in found else 1 if "ALONG" in found else 0)
    kind = kind[:, None]
    out = np.zeros((*read.shape, 3))
    if "ALONG" in found:
        out = out + np.where(kind == 1, read[..., None] * found["ALONG"].reshape(-1, 3), 0.0)
    if "ARM" in found:
        turn = (read + found["ANGLE"])[..., None]
        outward, sideways = (found[k].reshape(-1, 3) for k in ("OUTWARD", "SIDEWAYS"))
        swung = np.cos(turn) * outward + np.sin(turn) * sideways
        out = out + np.where(kind == 2, found["ARM"][:, None] * swung, 0.0)
    return out


def _axes(found: dict[str, Array], rot: Array, line: Array) -> Array:
    """The equations of joints' axes, (n, E) m."""
    if "AXIS_ROD" not in found:
        return np.zeros((len(rot), 0))
    rod = found["AXIS_ROD"].astype(int)
    base, platform = found.get("BASE_AXIS"), found.get("PLATFORM_AXIS")
    kind = found.get("AXIS_KIND")
    if kind is None:
        kind = np.full(len(rod), 2 if base is not None and platform is not None else 0)
        kind = np.full(len(rod), 1) if base is None else kind
    zeros = np.zeros((len(rod), 3))
    v = zeros if base is None else base.reshape(-1, 3)
    own = zeros if platform is None else platform.reshape(-1, 3)
    turned = np.einsum("nij,ej->nei", rot, own)
    w = np.where(
        (kind == 0)[:, None], v, np.where((kind == 1)[:, None], turned, np.cross(v, turned))
    )
    return np.sum(line[:, rod] * w, axis=-1)
