"""The hypothesis that diameters were written for radii.

Tubes modelled twice as thick are localized all the same: their edges match edges beside the right
ones, with the camera at another distance. The likelihood of the images does not decide between the
two, for the highlights of a tube, too, are edges at less than its width. The joint estimate does:
with the stated radii few edges are measured, which disagree with the machine, sometimes by no more
than is accepted of a result, or are chance matches; with half of the radii there are more edges,
and they agree.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pkmcal.calibration.camera_refinement import refinement_of
from pkmcal.calibration.case import Case
from pkmcal.calibration.handheld import localize_case
from pkmcal.calibration.refinement import refine_alternating
from pkmcal.errors import PkmcalError
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.verdict import TOO_NOISY
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.document import Leg
from pkmcal.mechanisms.machine import machine_from_document
from pkmcal.observe.hypotheses import diameters
from pkmcal.outcome.finding import Finding, note

SUSPECT_NOISE_SHARE = 0.5
"""Part of TOO_NOISY by which edges have to scatter for other radii to be tried, and below which
these explain the edges."""


def check_radii(
    case: Case, estimate: Estimate | None, by_chance: bool, refine_camera: bool, seed: int
) -> tuple[Finding, ...]:
    """Raise `InputError` where edges disagree with the machine and more of them agree with one of
    half the radii; a note where the machine of half the radii has no estimate.

    estimate : with the stated radii, None where there is none. by_chance : whether its edges may be
    chance matches, which agree with anything. refine_camera : whether the cameras were estimated.
    seed : for the localization of the stations.
    """
    agree = SUSPECT_NOISE_SHARE * TOO_NOISY
    bad = estimate is None or by_chance or estimate.statistics.noise_scale > agree
    if not bad or not case.images:
        return ()
    thinner = replace(case.session, machine=_of_half_the_radii(case.session.machine))
    try:
        rng = np.random.default_rng(seed)
        again = localize_case(thinner, case.images, case.boards, rng)
        cameras = refinement_of(again.session, refine_camera)
        turns = refine_alternating(again, cameras, lambda _text, _share: None, lambda _step: None)
    except PkmcalError as error:  # it is not found in these images, or they do not determine it
        mechanism = case.session.document["mechanism"]
        return (note("tube.diameter_untested", mechanism, why=str(error).rstrip(".")),)
    value = turns.estimate
    cured = value.statistics.noise_scale <= agree
    inliers = 0.0 if estimate is None else estimate.edge_weights.sum()
    if cured and value.edge_weights.sum() > inliers:
        raise diameters(case.session.document["mechanism"])
    return ()


def _of_half_the_radii(machine: Machine) -> Machine:
    legs: list[Leg] = []
    for leg in machine.document.legs:
        tubes = [tube.model_copy(update={"radius": tube.radius / 2}) for tube in leg.tubes]
        legs.append(leg.model_copy(update={"tubes": tuple(tubes)}))
    return machine_from_document(machine.document.model_copy(update={"legs": tuple(legs)}))
