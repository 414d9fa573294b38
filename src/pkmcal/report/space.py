"""Parts of the block ``space`` that the reports of all commands share."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pkmcal.arrays import Array, Integers, enlargement
from pkmcal.geometry.rigid import apply, inverse
from pkmcal.identify.centres import Centres
from pkmcal.mechanisms import Machine
from pkmcal.outcome.blocks.base import Key, Vector
from pkmcal.outcome.blocks.space import Ellipsoid, LegChange, SpacePoints, SpacePose
from pkmcal.web.motion import Postures
from pkmcal.web.stage import leg_lines, line, plain_configurations, point

ELLIPSOID_SIGMAS = 2.0
"""Standard deviations of ellipsoids."""
SMALL_DECIMALS = 8
"""Decimals of lengths in metres that a page enlarges."""
CHANGE_SHARE = 0.2
"""Length of large changes after enlargement, in radii of the machine."""
MOST_ENLARGED_CHANGE, MOST_ENLARGED_ELLIPSOID = 100.0, 1000.0
"""Largest enlargements, those of the stage's sliders."""
ELLIPSOID_SHARE = 0.07
"""Length of large ellipsoids' semi-axes after enlargement, in radii of the machine."""


def chosen(n: int, most: int) -> Integers:
    """Indices of at most ``most`` of n items, evenly chosen."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int))


def space_poses(
    machine: Machine, postures: Postures, labels: Sequence[str], key: Callable[[str], Key]
) -> tuple[SpacePose, ...]:
    """Configurations of the slider; key : of a configuration's label."""
    shapes = plain_configurations(postures, leg_lines(machine, postures))
    return tuple(
        SpacePose(key=key(label), label=label, configuration=shape)
        for label, shape in zip(labels, shapes, strict=True)
    )


def changes(
    before: Machine, after: Machine, postures: Postures, centres: tuple[Centres, ...]
) -> tuple[tuple[LegChange, ...], ...]:
    """Changes of the legs' lines at the postures of the machine ``after``; of the first alone if
    all are the same, none where the machine ``before`` does not close.

    centres : of base and platform, with the registration of the machine before.
    """
    base, platform = (side.T_calibrated_nominal for side in centres)
    poses = postures.T_base_platform
    old = leg_lines(before, Postures(postures.readings, inverse(base) @ poses @ platform))
    new = leg_lines(after, postures)
    turn = poses[:, None, :3, :3]
    legs: list[tuple[Array, Array]] = []
    for was, now in zip(old, new, strict=True):
        # on the platform in its own frame, in which most machines' changes are constant
        shifted = (now.platform - apply(base, was.platform))[:, :, None] @ turn
        legs.append((now.base - apply(base, was.base), shifted[:, :, 0]))
    if not all(np.isfinite(part).all() for leg in legs for part in leg):
        return ()
    constant = all(
        np.ptp(part, axis=0).max() < 10.0**-SMALL_DECIMALS for leg in legs for part in leg
    )
    return tuple(
        tuple(
            LegChange(base=line(a[n], SMALL_DECIMALS), platform=line(b[n], SMALL_DECIMALS))
            for a, b in legs
        )
        for n in range(1 if constant else len(poses))
    )


def ellipsoids(centres: tuple[Centres, ...]) -> tuple[Ellipsoid, ...]:
    """Ellipsoids of ``ELLIPSOID_SIGMAS`` of all joint centres."""
    out: list[Ellipsoid] = []
    for side in centres:
        values, vectors = np.linalg.eigh(side.blocks)
        half = (vectors * (ELLIPSOID_SIGMAS * np.sqrt(np.maximum(values, 0)))[:, None]).mT
        for j, (u, v, w) in enumerate(half):
            axes = small_vector(u), small_vector(v), small_vector(w)
            body = "base" if side.side == "base" else "platform"
            out.append(Ellipsoid(leg=j, side=body, axes=axes))
    return tuple(out)


def start_enlargements(
    extent: float, centres: tuple[Centres, ...], arrows: Array | None = None
) -> tuple[float, float]:
    """Round enlargements at which change and ellipsoids of the joint centres are visible.

    extent : of the machine, m.
    arrows : (n,) lengths, m, that are enlarged as the change is, and stay as small; None for none.
    """
    change = [np.concatenate([np.linalg.norm(c.change, axis=-1) for c in centres])]
    if arrows is not None and arrows.size:
        change.append(arrows)
    spread = ELLIPSOID_SIGMAS * np.concatenate([c.sigma for c in centres])
    wanted = CHANGE_SHARE * extent / 2
    return (
        min(*(enlargement(lengths, wanted) for lengths in change), MOST_ENLARGED_CHANGE),
        min(enlargement(spread, ELLIPSOID_SHARE * extent / 2), MOST_ENLARGED_ELLIPSOID),
    )


def small_vector(v: Array) -> Vector:
    """Vector (3,), m, that the page enlarges."""
    return point(v, SMALL_DECIMALS)


def space_points(
    name: str,
    colour: str,
    at: Array,
    keys: Sequence[Key],
    tips: Sequence[str],
    sizes: Sequence[float] = (),
) -> SpacePoints:
    """Points (n, 3), m, true to scale."""
    return SpacePoints(
        name=name,
        colour=colour,
        points=line(at, 4),
        keys=tuple(keys),
        tips=tuple(tips),
        sizes=tuple(sizes),
    )
