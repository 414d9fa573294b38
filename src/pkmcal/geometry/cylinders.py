"""Lines and cylinders in front of a central camera: the planes of a leg's two silhouette edges.

A line is a unit direction ``u`` and a moment ``m = p x u`` for any of its points p. A cylinder of
radius R about the line shows two edges to a camera at the origin. Each edge spans a plane with the
camera's centre. The plane's unit normal ``n`` points away from the axis: ``n . a = -R`` for every
point a of the axis ([B] 12-13). With the unit moment m and w = u x m, side 0 is
``n_0 = cos m - sin w`` and side 1 is ``n_1 = -cos m - sin w``, where sin = R / (distance of the
line) ([B] eq. 3 in its consistent form). Then u = n_1 x n_0, normalised.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import cross, dot

SIDE_SIGNS = np.array([1.0, -1.0])
"""Sign of the moment's term in the edge normal, by side."""


class EdgeNormals(NamedTuple):
    """Edge normals n (..., 3), with derivatives by the axis points a, b and the radius R.

    ``dn = by_a (n.da) + by_b (n.db) + (by_a + by_b) dR``, with by_a and by_b (..., 3). A point that
    moves within the edge plane does not change the plane, so each derivative has rank one.
    """

    n: Array
    by_a: Array
    by_b: Array

    @property
    def dn_da(self) -> Array:
        """Derivative (..., 3, 3) of n by a."""
        return self.by_a[..., :, None] * self.n[..., None, :]

    @property
    def dn_db(self) -> Array:
        """Derivative (..., 3, 3) of n by b."""
        return self.by_b[..., :, None] * self.n[..., None, :]


def line_through(a: Array, b: Array) -> tuple[Array, Array]:
    """Unit direction u from a to b and moment m = a x u, both (..., 3)."""
    d = b - a
    u = d / np.sqrt(dot(d, d))[..., None]
    return u, cross(a, u)


def has_silhouette(m: Array, radius: Array) -> Booleans:
    """Whether a cylinder has silhouette edges, that is, the camera's centre is outside it (by 2 %
    of its radius).

    m : (..., 3) moment of the axis, m.
    radius : (...) m.
    """
    return dot(m, m) > (1.02 * radius) ** 2


def edge_normal(u: Array, m: Array, radius: Array, sign: Array) -> Array:
    """Unit normals (..., 3) of the tangent planes of cylinders through the camera's centre, n = s
    cos m - sin u x m ([B] eq. 3).

    u, m : (..., 3) direction and moment of the axes in the camera frame, as :func:`line_through`
        returns them.
    radius : (...,) m.
    sign : (...,) of SIDE_SIGNS.
    Returns NaN where the centre of projection is inside the cylinder.
    """
    distance = np.sqrt(dot(m, m))
    sine, cosine = (x[..., None] for x in edge_planes(distance, radius, sign))
    m_unit = m / distance[..., None]
    return cosine * m_unit - sine * cross(u, m_unit)


class LineSilhouettes(NamedTuple):
    """Lines from a to b in front of a camera at the origin, prepared for the normals of the edges
    around them.

    u : (..., 3) unit direction from a to b.
    m : (..., 3) unit moment, along ``a x u``.
    w : (..., 3) ``u x m``, towards the line's nearest point.
    distance, length, before, behind : (...) m, with ``a = distance w + before u`` and
        ``b = distance w + behind u``.
    """

    u: Array
    m: Array
    w: Array
    distance: Array
    length: Array
    before: Array
    behind: Array

    @classmethod
    def between(cls, a: Array, b: Array) -> LineSilhouettes:
        """Lines between points a and b (..., 3), in the camera frame."""
        line = b - a
        length = np.sqrt(dot(line, line))
        u = line / length[..., None]
        moment = cross(a, u)
        distance = np.sqrt(dot(moment, moment))
        m = moment / distance[..., None]
        before = dot(a, u)
        return cls(u, m, cross(u, m), distance, length, before, before + length)

    def edges(self, radius: Array, side: Integers) -> EdgeNormals:
        """Edge normals with exact derivatives, radius (...) m and side (...) 0 or 1.

        The normal satisfies n.a = -R, n.b = -R, n.n = 1. Differentiation gives ``[a b n]^T dn =
        (-dR - n.da, -dR - n.db, 0)``. With ``v = w + (sine / cosine) m``, which is orthogonal to u
        and n and has v.a = v.b = distance, the solution is ``dn = u (n.da - n.db) / length + v
        ((before n.db - behind n.da) / length - dR) / distance``.
        """
        planes = edge_planes(self.distance, radius, SIDE_SIGNS[side])
        sine, cosine = (x[..., None] for x in planes)
        turn = (self.w + (sine / cosine) * self.m) / self.distance[..., None]
        shift = self.u / self.length[..., None]
        by_a = shift - (self.behind / self.length)[..., None] * turn
        by_b = (self.before / self.length)[..., None] * turn - shift
        return EdgeNormals(cosine * self.m - sine * self.w, by_a, by_b)


def edge_planes(distance: Array, radius: Array, sign: Array) -> tuple[Array, Array]:
    """Sine and signed cosine in an edge's normal ``n = cosine m - sine w`` ([B] eq. 3), for unit
    moment m and w = u x m.

    distance, radius : (...) m.
    sign : (...) of SIDE_SIGNS.
    Returns NaN cosines where the centre of projection is inside the cylinder.
    """
    sine = radius / distance
    return sine, sign * np.sqrt(np.where(np.abs(sine) < 1, 1 - sine**2, np.nan))


def edge_normal_jacobians(a: Array, b: Array, radius: Array, side: Integers) -> EdgeNormals:
    """Edge normals with exact derivatives, from two points of the axis.

    a, b : (..., 3) points of the axis in the camera frame, a towards the base, m.
    radius, side : (...,) m, and 0 or 1.
    Returns NaN where the centre of projection is inside the cylinder; the caller excludes these
    edges with :func:`has_silhouette`.
    """
    return LineSilhouettes.between(a, b).edges(radius, side)


def contour_point(a: Array, u: Array, n: Array, radius: Array, along: Array) -> Array:
    """Points (..., 3) of a cylinder where the viewing ray is tangent to it: a + s u + R n."""
    return a + along[..., None] * u + np.asarray(radius)[..., None] * n


def tangent_basis(n: Array, along: Array) -> Array:
    """Orthonormal bases (..., 3, 2) of the planes orthogonal to unit vectors n (..., 3).

    The first column is the part of ``along`` (the ray to the middle of the edge) orthogonal to n: a
    rotation of n towards it shifts the edge sideways. The second is n x first: a rotation of n
    towards it tilts the edge about its middle.
    """
    first = along - dot(along, n)[..., None] * n
    first = first / np.sqrt(dot(first, first))[..., None]
    return np.stack([first, cross(n, first)], axis=-1)


def segment_distance(p0: Array, p1: Array, q0: Array, q1: Array) -> Array:
    """Smallest distance (...), m, between the segments p0 p1 and q0 q1 (..., 3) of positive length.

    The distance of points p0 + s (p1 - p0) and q0 + t (q1 - q0) is convex in s and t: the best s on
    the lines is clipped to the segment, then the best t for it, then s once more [Ericson 2005,
    5.1.9].
    """
    u, v, w = p1 - p0, q1 - q0, p0 - q0
    uu, vv, uv, uw, vw = dot(u, u), dot(v, v), dot(u, v), dot(u, w), dot(v, w)
    det = uu * vv - uv * uv
    # of parallel segments, any s is a start
    lines = np.divide(uv * vw - uw * vv, det, out=np.zeros_like(det), where=det > 1e-12 * uu * vv)
    t = np.clip((uv * np.clip(lines, 0, 1) + vw) / vv, 0, 1)
    s = np.clip((uv * t - uw) / uu, 0, 1)
    t = np.clip((uv * s + vw) / vv, 0, 1)
    return np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
