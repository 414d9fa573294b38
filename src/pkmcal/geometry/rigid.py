"""Rigid motions, in batches.

A pose is a 4x4 matrix ``T_a_b`` that maps coordinates of frame ``b`` to frame ``a``:
``p_a = T_a_b p_b``, so inner names cancel in products.

Perturbation, defined here for the whole project: six numbers ``delta = (omega, tau)`` change
``T = (R, t)`` from the left to ``(Exp(omega) R, t + tau)``; ``omega`` is a rotation vector (rad),
``tau`` a translation (m), both in the outer frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError

_CROSSED = -np.array([[[0, 0, 0], [0, 0, 1], [0, -1, 0]],
                      [[0, 0, -1], [0, 0, 0], [1, 0, 0]],
                      [[0, 1, 0], [-1, 0, 0], [0, 0, 0]]], dtype=float).reshape(3, 9)  # fmt: skip
"""Cross-product matrices of the three axes, flattened: v @ _CROSSED is the cross-product matrix of
v."""
LEAST_ANGLE = 1e-150
"""Rotation angle (rad) below which the rotation is the identity."""
LEAST_VIEW_DISTANCE = 1e-6
"""Distance (m) from a camera to the point that it looks at, below which they are one point."""
LEAST_UP_ANGLE = float(np.deg2rad(1.0))
"""Angle (rad) between the line of sight and the direction up below which a direction of a few
digits does not determine the camera's turn about its axis."""
VectorLike = Array | Sequence[float]
"""(3,) numbers."""


def is_rigid(T: Array) -> bool:
    """Whether a matrix (4, 4) is a rotation, to 1e-6, and a translation."""
    rot = T[:3, :3]
    rotates = np.allclose(rot @ rot.T, np.eye(3), atol=1e-6) and np.linalg.det(rot) > 0
    return bool(rotates and np.array_equal(T[3], [0, 0, 0, 1]))


def skew(v: Array) -> Array:
    """Cross-product matrices, (..., 3) -> (..., 3, 3): ``skew(v) @ w == cross(v, w)``."""
    v = np.asarray(v)
    return (v @ _CROSSED).reshape(*v.shape, 3)


def cross(a: Array, b: Array) -> Array:
    """Cross product over the last axis; several times faster than ``np.cross``, with the same
    result.

    The result has the memory order of its factors. If the components are slowest in memory, NumPy
    iterates over many vectors at once.
    """
    shape = a.shape if a.shape == b.shape else np.broadcast_shapes(a.shape, b.shape)
    like = a if a.shape == shape else b
    out = np.empty_like(like, dtype=np.result_type(a, b), shape=shape)
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def dot(a: Array, b: Array) -> Array:
    """Inner product over a short last axis, (..., n) x (..., n) -> (...).

    The sum is written out because NumPy's reductions over a short last axis are several times
    slower.
    """
    out = a[..., 0] * b[..., 0]
    for k in range(1, a.shape[-1]):
        out += a[..., k] * b[..., k]
    return out


def of_components(*parts: Array) -> Array:
    """Array (..., k) from its k components (...), which broadcast.

    The components are slowest in memory, so that NumPy iterates over many vectors at once.
    """
    shape = parts[0].shape  # usually all alike; NumPy's check takes a third of the time
    if any(part.shape != shape for part in parts):
        shape = np.broadcast_shapes(*(part.shape for part in parts))
    out = np.empty((len(parts), *shape), dtype=np.result_type(*parts))
    for k, part in enumerate(parts):
        out[k] = part
    return out.transpose(*range(1, out.ndim), 0)


def rotation(omega: Array) -> Array:
    """Rotation matrices Exp(omega) of rotation vectors (rad), (..., 3) -> (..., 3, 3).

    Rodrigues' formula in the half angle; LEAST_ANGLE keeps the limit at zero exact.
    """
    omega = np.asarray(omega, dtype=float)
    angle = np.sqrt(dot(omega, omega))[..., None]
    half = skew(omega * (np.sin(angle / 2) / np.maximum(angle, LEAST_ANGLE)))
    return np.eye(3) + 2 * np.cos(angle / 2)[..., None] * half + 2 * half @ half


def axial(matrix: Array) -> Array:
    """Axial vectors (..., 3) of M - M^T for matrices (..., 3, 3); for a rotation, 2 sin(angle)
    times the axis.
    """
    out = np.empty(matrix.shape[:-1])
    for k, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        out[..., k] = matrix[..., i, j] - matrix[..., j, i]
    return out


def rotation_vector(rot: Array) -> Array:
    """Rotation vectors (rad, norm at most pi) of rotation matrices, (..., 3, 3) -> (..., 3).

    The axial vector, scaled by angle / sine with the angle from sine and cosine: as accurate as
    SciPy's function and forty times as fast. The axial vector vanishes at a half turn, near which
    SciPy's function is used.
    """
    rot = np.asarray(rot, dtype=float)
    v = axial(rot)
    sine, cosine = np.sqrt(dot(v, v)), np.trace(rot, axis1=-2, axis2=-1) - 1  # both doubled
    small = sine < 1e-7
    out = np.where(small, 0.5, np.arctan2(sine, cosine) / np.where(small, 1.0, sine))[..., None] * v
    half = cosine < -1.9
    if np.any(half):
        from scipy.spatial.transform import Rotation

        out[half] = Rotation.from_matrix(rot[half]).as_rotvec()
    return out


def quaternion(rot: Array) -> Array:
    """Unit quaternions (..., 4), scalar first and not negative, of rotations (..., 3, 3)."""
    omega = rotation_vector(rot)
    angle = np.sqrt(dot(omega, omega))[..., None]
    axis = omega / np.where(angle > 0, angle, 1.0)
    return np.concatenate([np.cos(angle / 2), np.sin(angle / 2) * axis], axis=-1)


def from_quaternion(q: Array) -> Array:
    """Rotations (..., 3, 3) of quaternions (..., 4), scalar first, of any length but zero."""
    q = q / np.sqrt(dot(q, q))[..., None]
    w, v = q[..., :1, None], q[..., 1:]
    k = skew(v)
    return np.eye(3) + 2 * (w * k + k @ k)


def roll_pitch_yaw(rot: Array) -> Array:
    """Angles (3,) in rad of a rotation (3, 3), with R = Rz(yaw) Ry(pitch) Rx(roll) as in URDF and
    SDF.

    |pitch| is at most 90 degrees; at 90 degrees the yaw is zero and the roll holds both.
    """
    across = float(np.hypot(rot[0, 0], rot[1, 0]))
    yaw = float(np.arctan2(rot[1, 0], rot[0, 0])) if across > 1e-12 else 0.0
    s, c = np.sin(yaw), np.cos(yaw)
    roll = np.arctan2(s * rot[0, 2] - c * rot[1, 2], c * rot[1, 1] - s * rot[0, 1])
    return np.array([roll, np.arctan2(-rot[2, 0], across), yaw])


def from_roll_pitch_yaw(angles: Array) -> Array:
    """Rotation (3, 3) of roll, pitch and yaw (3,), rad."""
    x, y, z = (rotation(angle * axis) for angle, axis in zip(angles, np.eye(3), strict=True))
    return z @ y @ x


def pose(rot: Array, t: Array) -> Array:
    """Poses (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    same = rot.shape[:-2] == t.shape[:-1]
    shape = t.shape[:-1] if same else np.broadcast_shapes(rot.shape[:-2], t.shape[:-1])
    out = np.zeros((*shape, 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = rot, t, 1.0
    return out


def inverse(transform: Array) -> Array:
    """Inverse poses, (..., 4, 4) -> (..., 4, 4)."""
    rot_t = transform[..., :3, :3].mT
    return pose(rot_t, -(rot_t @ transform[..., :3, 3:])[..., 0])


def apply(transform: Array, points: Array) -> Array:
    """Points (..., 3) transformed by poses (..., 4, 4); leading axes broadcast."""
    turned = (transform[..., :3, :3] @ points[..., None])[..., 0]
    return turned + transform[..., :3, 3]


def perturb(transform: Array, delta: Array) -> Array:
    """Poses (..., 4, 4) retracted along six numbers each (..., 6), as defined in the module's
    docstring.
    """
    rot = rotation(delta[..., :3]) @ transform[..., :3, :3]
    return pose(rot, transform[..., :3, 3] + delta[..., 3:])


def pose_difference(transform: Array, reference: Array) -> Array:
    """Six numbers (..., 6) with ``perturb(reference, delta) == transform``."""
    rot = transform[..., :3, :3] @ reference[..., :3, :3].mT
    return np.concatenate(
        [rotation_vector(rot), transform[..., :3, 3] - reference[..., :3, 3]], axis=-1
    )


def angle_between(one: Array, other: Array) -> Array:
    """Rotation angles (...) in rad between poses (..., 4, 4)."""
    turned = one[..., :3, :3] @ other[..., :3, :3].mT
    return np.arccos(np.clip((np.trace(turned, axis1=-2, axis2=-1) - 1) / 2, -1, 1))


def nearest_rotation(matrix: Array) -> Array:
    """Rotations R (..., 3, 3) that maximise tr(R^T M); reflections are excluded."""
    u, _, vt = np.linalg.svd(matrix)
    u = u.copy()
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


def register(source: Array, target: Array, weights: Array | None = None) -> Array:
    """Rigid motions (..., 4, 4) that register points: min sum w |T source - target|^2 (Kabsch).

    source, target : (..., n, 3), n >= 3, not on one line for a unique solution.
    weights : (..., n), equal by default.

    Reflections are excluded. [A] 9 and 16 in their corrected form, [B] eq. 15.
    """
    w = np.ones(source.shape[:-1]) if weights is None else weights
    w = w / w.sum(axis=-1, keepdims=True)
    mean_s = np.sum(w[..., None] * source, axis=-2)
    mean_t = np.sum(w[..., None] * target, axis=-2)
    ds, dt = source - mean_s[..., None, :], target - mean_t[..., None, :]
    rot = nearest_rotation(dt.mT @ (w[..., None] * ds))
    return pose(rot, mean_t - (rot @ mean_s[..., None])[..., 0])


def look_at(position: VectorLike, target: VectorLike, up: VectorLike) -> Array:
    """Pose T_camera_base (4, 4) of a camera at ``position`` with ``target`` in the image's middle.

    All in base coordinates, m. Camera axes as OpenCV: z forward, x right, y down; ``up`` points to
    the image's upper edge and need not be square to the view. Raises InputError where the three do
    not determine a pose.
    """
    eye, above = np.asarray(position, dtype=float), np.asarray(up, dtype=float)
    forward = np.asarray(target, dtype=float) - eye
    if np.linalg.norm(forward) < LEAST_VIEW_DISTANCE:
        raise InputError(
            "the camera looks at its own position",
            found=f"look_at {np.asarray(target).tolist()}",
            expected="a point in the middle of the image, away from position",
        )
    # lengths taken out first, so that the angle below is one between unit vectors
    forward = forward / np.linalg.norm(forward)
    above = above / max(float(np.abs(above).max()), np.finfo(float).tiny)
    right = np.cross(forward, above)
    angle = np.arctan2(np.linalg.norm(right), abs(float(forward @ above)))
    if angle < LEAST_UP_ANGLE:
        raise InputError(
            "up does not fix how the camera is turned about its view",
            found=f"up {np.asarray(up).tolist()}, {np.rad2deg(angle):.2g} degrees from the line of"
            " sight",
            expected="a direction across the view, towards the image's upper edge",
        )
    right = right / np.linalg.norm(right)
    R_camera_base = np.stack([right, np.cross(forward, right), forward])
    return pose(R_camera_base, -R_camera_base @ eye)
