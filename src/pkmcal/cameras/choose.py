"""Which model, and which terms of distortion: what predicts views that were not used.

A richer model always fits better the views that it was fitted to. So every candidate is judged
by each view's corners as a camera fitted to the other views predicts them, and the candidate with
the fewest parameters wins among those that cannot be told from the best.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras.fit import Fit, Views, fit_camera
from pkmcal.cameras.heldout import left_out_residuals
from pkmcal.cameras.starts import extended, first_fit

TERMS: dict[str, tuple[tuple[str, ...], ...]] = {
    "pinhole": (
        (), ("k1",), ("k1", "k2"), ("k1", "k2", "p1", "p2"), ("k1", "k2", "p1", "p2", "k3"),
    ),
    "fisheye": ((), ("k1",), ("k1", "k2"), ("k1", "k2", "k3"), ("k1", "k2", "k3", "k4")),
    "unified": ((), ("p1", "p2"), ("k1",), ("k1", "k2"), ("k1", "k2", "p1", "p2")),
}  # fmt: skip
"""Candidates, from few terms to many; the model with the fewest first among equals."""
LEAST_GAIN = 0.01
"""Share by which the error on left-out views must fall for a term to be worth having."""
MOST_CORNERS = 1500
"""Corners in all that the choice looks at; the final fit takes every one."""
LEAST_OF_VIEW = 12
"""Corners that every view keeps, where it has them."""
HOPELESS = 5.0
"""A model that fits so many times worse than another, with two radial terms, gets no more."""


@dataclass(frozen=True)
class Candidate:
    """One model with one set of terms.

    parameters : number of free intrinsics. rms : px, length of the residual, root mean square.
    left_out : the same on views left out of the fit, to first order. by_view : (V,) px^2.
    """

    model: str
    terms: tuple[str, ...]
    parameters: int
    rms: float
    left_out: float
    by_view: Array
    fit: Fit


def candidates(
    views: Views, image_size: tuple[int, int], models: tuple[str, ...]
) -> tuple[Candidate, ...]:
    """Every model with each of its sets of terms, fitted; models without a start are missing."""
    fits: list[tuple[str, tuple[str, ...], Fit]] = []
    # The unified camera fits almost anything: it tells which of the others are hopeless.
    for model in sorted(models, key=list(TERMS).index, reverse=True):
        start = first_fit(model, views, image_size)
        if start is None:
            continue
        for terms in TERMS[model]:
            fit = extended(start, views, terms)
            fits.append((model, terms, fit))
            if "k2" in terms and _level(fit) > HOPELESS * min(_level(f) for _, _, f in fits):
                break
            # A set that holds this one begins where it ended.
            start = fit if "k1" in terms else start
    if not fits:
        return ()
    judged = _judged_corners([fit for _, _, fit in fits], views)
    pool = [_candidate(model, terms, fit, views, judged) for model, terms, fit in fits]
    return tuple(sorted(pool, key=lambda c: list(TERMS).index(c.model)))


def best_of(pool: tuple[Candidate, ...]) -> Candidate:
    """The fewest parameters among candidates that cannot be told from the best."""
    best = min(pool, key=lambda c: c.left_out)
    return min((c for c in pool if not is_worse(c, best)), key=lambda c: c.parameters)


def is_worse(candidate: Candidate, best: Candidate) -> bool:
    """True where left-out views tell the two apart: by a hundredth of the error, and by more
    than the standard error of the difference over the views.
    """
    if candidate.left_out <= best.left_out * (1 + LEAST_GAIN):
        return False
    gain = candidate.by_view - best.by_view
    error = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else 0.0
    return bool(gain.mean() > error)


def fitted_to_all(chosen: Candidate, views: Views) -> Fit:
    """A candidate's fit continued with every corner."""
    fit = chosen.fit
    return fit_camera(fit.camera, fit.free, views, fit.T_camera_board)


def thinned(views: Views) -> Views:
    """The views with fewer corners each, where there are many: evenly over the board."""
    total = int(views.seen.sum())
    if total <= MOST_CORNERS:
        return views
    # One set of corners for all views, so that arrays stay small; no pattern of rows in it.
    order = np.random.default_rng(0).permutation(len(views.points))
    used = order[: max(len(order) * MOST_CORNERS // total, LEAST_OF_VIEW)]
    for seen in views.seen:
        mine = order[seen[order]]
        used = np.union1d(used, mine[:LEAST_OF_VIEW])
    return Views(views.points[used], views.pixels[:, used], views.sigma[:, used])


def _judged_corners(fits: list[Fit], views: Views) -> Booleans:
    """Corners by which all candidates are judged: those in use by the one that fits best."""
    return (min(fits, key=_level).weight > 0.5) & views.seen


def _level(fit: Fit) -> float:
    """Median length of a residual, px."""
    return float(np.nanmedian(np.linalg.norm(fit.residuals, axis=-1)))


def _candidate(
    model: str, terms: tuple[str, ...], fit: Fit, views: Views, judged: Booleans
) -> Candidate:
    def squares(off: Array) -> Array:
        return np.where(judged, np.sum(np.nan_to_num(off) ** 2, axis=-1), 0.0)

    left_out = squares(left_out_residuals(fit, views))
    counts = np.maximum(judged.sum(axis=1), 1)
    total = max(int(judged.sum()), 1)
    return Candidate(
        model=model,
        terms=terms,
        parameters=len(fit.free),
        rms=float(np.sqrt(squares(fit.residuals).sum() / total)),
        left_out=float(np.sqrt(left_out.sum() / total)),
        by_view=left_out.sum(axis=1) / counts,
        fit=fit,
    )
