"""Lines and cylinders before a central camera: the planes of a leg's two silhouette edges.

A line is a unit direction ``u`` and a moment ``m = p x u`` for any of its points p. A
cylinder of radius R around it shows two edges to a camera at the origin; each edge and the
camera's centre span a plane, whose unit normal ``n`` points away from the axis: for every
point a of the axis ``n . a = -R`` ([B] 12-13). Side 0 is ``n = cos m - sin a_perp``, side 1
``n = -cos m - sin a_perp`` ([B] eq. 3 in its consistent form), so with the direction u away
from the viewer's feet, u = n_1 x n_0 normalised.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import cross, dot

SIDE_SIGNS = np.array([1.0, -1.0])
"""Sign of the moment's part of the normal, by side."""


class EdgeNormals(NamedTuple):
    """Normals n (..., 3) of edges, and how they move with the axis's points a, b and with R.

    ``dn = by_a (n.da) + by_b (n.db) + (by_a + by_b) dR``, by_a and by_b (..., 3): an edge's plane
    does not mind what a point does within it, so each derivative is of rank one.
    """

    n: Array
    by_a: Array
    by_b: Array

    @property
    def dn_da(self) -> Array:
        """(..., 3, 3)."""
        return self.by_a[..., :, None] * self.n[..., None, :]

    @property
    def dn_db(self) -> Array:
        """(..., 3, 3)."""
        return self.by_b[..., :, None] * self.n[..., None, :]


def line_through(a: Array, b: Array) -> tuple[Array, Array]:
    """Unit direction u from a to b and moment m = a x u, both (..., 3)."""
    d = b - a
    u = d / np.sqrt(dot(d, d))[..., None]
    return u, cross(a, u)


def has_silhouette(m: Array, radius: Array) -> Booleans:
    """False where the camera's centre lies in the cylinder: it has no silhouette there.

    m : (..., 3) moment of its axis.
    """
    return dot(m, m) > (1.02 * radius) ** 2


def edge_normal(u: Array, m: Array, radius: Array, sign: Array) -> Array:
    """Tangent planes of cylinders through the camera's centre, n = s cos m - sin u x m, [B] eq. 3.

    u, m : (..., 3) the axes' Pluecker coordinates, camera frame, as of :func:`line_through`.
    radius : (...,) m. sign : (...,) of SIDE_SIGNS.
    Returns unit n (..., 3), NaN where the centre of projection lies inside the cylinder.
    """
    distance = np.sqrt(dot(m, m))
    sine, cosine = (x[..., None] for x in edge_planes(distance, radius, sign))
    m_unit = m / distance[..., None]
    return cosine * m_unit - sine * cross(u, m_unit)


class LineSilhouettes(NamedTuple):
    """Lines from a to b before a camera at the origin, and how the edges around them move.

    u : (..., 3) direction from a to b. m : unit moment, along ``a x u``. w : ``u x m``, towards the
    line's nearest point. distance, length, before, behind : (...) m, with
    ``a = distance w + before u`` and ``b = distance w + behind u``.
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
        """Those of points (..., 3)."""
        line = b - a
        length = np.sqrt(dot(line, line))
        u = line / length[..., None]
        moment = cross(a, u)
        distance = np.sqrt(dot(moment, moment))
        m = moment / distance[..., None]
        before = dot(a, u)
        return cls(u, m, cross(u, m), distance, length, before, before + length)

    def edges(self, radius: Array, side: Integers) -> EdgeNormals:
        """Their edges' normals with exact derivatives.

        The normal obeys n.a = -R, n.b = -R, n.n = 1. Differentiating these three,
        ``[a b n]^T dn = (-dR - n.da, -dR - n.db, 0)``. With ``v = w + (sine / cosine) m``, which is
        square to u and n and has v.a = v.b = distance, the solution is ``dn = u (n.da - n.db) /
        length + v ((before n.db - behind n.da) / length - dR) / distance``.
        """
        value = edge_planes(self.distance, radius, SIDE_SIGNS[side])
        sine, cosine = (x[..., None] for x in value)
        turn = (self.w + (sine / cosine) * self.m) / self.distance[..., None]
        shift = self.u / self.length[..., None]
        by_a = shift - (self.behind / self.length)[..., None] * turn
        by_b = (self.before / self.length)[..., None] * turn - shift
        return EdgeNormals(cosine * self.m - sine * self.w, by_a, by_b)


def edge_planes(distance: Array, radius: Array, sign: Array) -> tuple[Array, Array]:
    """Sine and signed cosine of the angle between an edge's plane and its axis's, so that the
    normal is ``n = cosine m - sine w``, [B] eq. 3; NaN where the centre of projection lies inside
    the cylinder. distance, radius : (...) m. sign : (...) of SIDE_SIGNS.
    """
    sine = radius / distance
    return sine, sign * np.sqrt(np.where(np.abs(sine) < 1, 1 - sine**2, np.nan))


def edge_normal_jacobians(a: Array, b: Array, radius: Array, side: Integers) -> EdgeNormals:
    """One edge's normal and its exact derivatives, from two points of the axis.

    a, b : (..., 3) points of the axis in the camera frame, a towards the base (m).
    radius, side : (...,) m, and 0 or 1. Where the centre of projection is inside the cylinder the
    values are NaN: the caller leaves such edges out with :func:`has_silhouette`.
    """
    return LineSilhouettes.between(a, b).edges(radius, side)


def contour_point(a: Array, u: Array, n: Array, radius: Array, along: Array) -> Array:
    """Points of a cylinder where the view ray grazes it: a + s u + R n, (..., 3)."""
    return a + along[..., None] * u + np.asarray(radius)[..., None] * n


def tangent_basis(n: Array, along: Array) -> Array:
    """Orthonormal bases (..., 3, 2) of the planes orthogonal to unit vectors n.

    The first column is the part of ``along`` orthogonal to n (the ray to the middle of the
    edge), so a turn of n towards it shifts the whole edge sideways; the second is
    n x first, and a turn towards it tilts the edge about its middle.
    """
    first = along - dot(along, n)[..., None] * n
    first = first / np.sqrt(dot(first, first))[..., None]
    return np.stack([first, cross(n, first)], axis=-1)
