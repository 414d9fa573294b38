"""Hypotheses about a session whose images disagree with it.

The hypotheses are all mistakes in the readings (:mod:`pkmcal.mechanisms.reading_hypotheses`),
exchanged stations, images under other names, mirrored images, and diameters in place of radii.
Levels of evidence compare their log-likelihoods with that of the session as stated: a short search
in few images, the same search in all images, and a full search for the likeliest hypotheses, from
whose poses all are compared. Hypotheses are compared for localized machines as well: with two
columns exchanged, four legs of six still fit.

A search gives a lower bound of the likelihood, because it may end beside the best pose. Before the
full search, hypotheses are therefore dropped by their order alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations, islice
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import angle_between
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.reading_hypotheses import (
    READING_HYPOTHESIS_OPTIONS,
    ReadingHypothesis,
    reading_error,
    reading_hypotheses,
    reversed_motor,
)
from pkmcal.observe.pose_likelihood import (
    StationView,
    likelihood_from,
    log_likelihood_by_name,
    refine_lm,
    score,
    settled,
)
from pkmcal.observe.station_localization import (
    LOCALIZATION_OPTIONS,
    LocalizedPose,
    find_station,
    likelihood_nearby,
)
from pkmcal.outcome.hypotheses import (
    OPTIONS,
    EvidenceLevel,
    Hypothesis,
    HypothesisOptions,
    decide,
    likely,
    posterior,
)
from pkmcal.wording import how_often, listed

SEARCH_OPTIONS = HypothesisOptions(beam=math.inf, most=3)
"""Of hypotheses whose likelihood a search bounds from below: the likeliest three go on."""
OTHER_EXPLANATIONS = 4
"""Explanations of images beside those of the readings: shifted, under other names, mirrored,
diameters for radii."""
NEAR_SEARCH_TURN = np.radians(15.0)
"""Turn from the pose by hand beyond which hypotheses are searched about that pose, too."""
OTHER_POSE_TURN = np.radians(45.0)
"""Turn from the pose by hand beyond which the localized pose contradicts it: a machine of three or
six equal parts looks the same from there."""
NAMING_ROUNDS = 3
"""Rounds of names for images, and of the pose by these names."""
CONSTANTS_COMPARED = 17
"""Constants of a motor found to be reversed, at a quarter of the spacing of those searched."""
FEW_CONFIGURATIONS = 4
"""Images in which all hypotheses about the readings are compared first."""
ENOUGH_IMAGES_ALONE = 4
"""Images below which a message names their number as the reason, because they have no two halves,
for search and confirmation."""
USUAL_IMAGES, ENOUGH_IMAGES_OF_CALIBRATED = 15, 5
"""Images of a station for a calibration; and of a machine that is calibrated already."""
NUMBERING = "readings.numbering_"
"""Prefix of the codes of legs that are numbered from another leg, or backwards."""
STATION_PAIRS_SEARCHED = 15
"""Pairs of stations at most that are searched for each other's pose: all pairs of six stations."""


@dataclass(frozen=True)
class ImageEvidenceOptions:
    """Evidence that the likelihood of images lacks, which no level of false alarms determines."""

    # log-likelihood ratio (nats) of a pose by hand against readings that place the camera on
    # another side of the machine: more than that of any images, for a person knows the side, and a
    # machine of equal parts looks the same from each. The refusal names the pose as a rival
    pose_by_hand: float = 1000.0
    # share of the mean log-likelihood ratio of a localized machine's images by which another name
    # has to be likelier, another numbering of its legs, or any mistake if a second search localizes
    # the machine as stated: between two nearly equal configurations,
    # and between equal parts of a machine, errors of the nominal model decide, of which the
    # likelihood contains the scatter but not that all images of a station share them. Their effect
    # grows with the evidence, so it is a share and no number of nats. On simulated machines,
    # exchanged names had 0.2 to 2 times as much, right names up to 0.03
    right_name_share: float = 0.1


IMAGE_EVIDENCE = ImageEvidenceOptions()


class SuspectStation(NamedTuple):
    """Station whose images are compared with hypotheses.

    name, files : of the station and its images. configurations : names in the session. table,
    columns : file of the readings and its columns. by_hand : T_camera_base (4, 4), None without a
    pose by hand.
    """

    name: str
    files: list[str]
    configurations: tuple[str, ...]
    table: str
    columns: Sequence[str]
    view: StationView
    by_hand: Array | None
    localization: LocalizedPose

    @property
    def elsewhere(self) -> bool:
        """Whether the machine was localized far from the pose by hand, or not at all."""
        return not self.localization.good or self.turned > OTHER_POSE_TURN

    @property
    def turned(self) -> float:
        """Turn (rad) of the localized pose from the one by hand; 0 without one."""
        if self.by_hand is None:
            return 0.0
        return float(angle_between(self.localization.T_camera_base, self.by_hand))


StationPair = tuple[SuspectStation, SuspectStation]


@dataclass(frozen=True)
class ImageHypothesis(Hypothesis[StationView]):
    """Hypothesis about the images of a station; its data are the station's view.

    error : names the mistake. readings : (K, m) of the images, where nothing else differs.
    """

    error: InputError = field(default_factory=lambda: InputError(""))
    readings: Array | None = None


def mistake(
    stations: list[SuspectStation],
    rng: np.random.Generator,
    options: ImageEvidenceOptions = IMAGE_EVIDENCE,
) -> InputError | None:
    """Error about stations whose images disagree with the session, None if all agree."""
    error = _swapped_stations([s for s in stations if s.elsewhere], rng)
    if error is not None or not stations:
        return error
    bad = [station for station in stations if not station.localization.good]
    worst = max(
        stations, key=lambda s: (not s.localization.good, s.elsewhere, s.localization.p_value)
    )
    # a station that is localized near its pose by hand shows that the readings are in order
    in_order = any(s.by_hand is not None and not s.elsewhere for s in stations)
    error = _mixed_up(worst, in_order, rng, options)
    if error is not None:
        return error
    if not bad:  # readings are wrong for all stations, but names for one alone
        rest = (station for station in stations if station is not worst)
        errors = (_likelier(s, list(_other_images(s, options)), True, rng, options) for s in rest)
        return next((error for error in errors if error is not None), None)
    others = [station.name for station in bad if station is not worst]
    at = ", nor in those of " + listed(others) if others else ""
    few = len(worst.view.configuration) < ENOUGH_IMAGES_ALONE
    calibrated = worst.view.earlier_joints is not None
    enough = ENOUGH_IMAGES_OF_CALIBRATED if calibrated else USUAL_IMAGES
    return InputError(
        f"the machine was not localized in the images of {worst.name}{at}",
        where=f"session.yaml, stations.{worst.name}",
        found=_little(worst),
        expected="one place where its legs lie on image edges far more often than by chance",
        next_step=(
            f"Take more images from there, {enough} are usual: with so few"
            " no exchange of images or readings can be detected. If there are more, check"
            if few
            else "Check"
        )
        + " that these images show this machine's legs, that each bears the name"
        " of its configuration, and that the nominal model is this machine's"
        + ("" if worst.by_hand is not None else "; a pose by hand, right to 20 cm, may help"),
        code="station.not_recognised",
    )


def _little(station: SuspectStation) -> str:
    """Description of the evidence, which is too weak."""
    localization = station.localization
    if localization.p_value < localization.limit:
        return "legs that fit nearly as well at another place"
    count = len(station.view.configuration)
    if count < 2:
        return "one image alone, and none to confirm what it seems to show"
    few = f"{count} images alone, and " if count < ENOUGH_IMAGES_ALONE else ""
    often = how_often(localization.p_value)
    return f"{few}legs that readings of other configurations fit as well {often}"


def _swapped_stations(
    stations: list[SuspectStation], rng: np.random.Generator
) -> InputError | None:
    """Error about two stations whose images are exchanged, rather than mirrored: the mirror image
    of a symmetric machine resembles the machine from the other side.

    stations : localized far from their poses by hand, or not at all.
    """
    placed = [station for station in stations if station.by_hand is not None]

    def exchanged(pair: StationPair) -> StationPair:
        one, other = pair
        return one._replace(by_hand=other.by_hand), other._replace(by_hand=one.by_hand)

    def mirrored(pair: StationPair) -> StationPair:
        views = (replace(s.view, tables=s.view.tables.mirrored()) for s in pair)
        one, other = (s._replace(view=view) for s, view in zip(pair, views, strict=True))
        return one, other

    def by_near_search(pair: StationPair, hypotheses: Sequence[Hypothesis[StationPair]]) -> Array:
        out = np.zeros(len(hypotheses))
        for k, hypothesis in enumerate(hypotheses):
            for s in hypothesis.apply(pair):
                at = find_station(s.view, s.by_hand, rng, near_prior=True)
                if s._replace(localization=at).elsewhere:
                    out[k:] = -np.inf  # mirrored images matter beside exchanged ones alone
                    return out
                out[k] += at.log_likelihood_ratio / at.correlation_length
        return out

    for one, other in islice(combinations(placed, 2), STATION_PAIRS_SEARCHED):
        subject = f"{one.name} and {other.name}"
        hypotheses = [
            Hypothesis("station.exchanged", subject, exchanged),
            Hypothesis("image.mirrored", subject, mirrored),
        ]
        level = EvidenceLevel("near search", partial(by_near_search, (one, other)))
        best = decide(posterior(hypotheses, [level], SEARCH_OPTIONS))
        if best is not None and best.hypothesis.code == "station.exchanged":
            return InputError(
                f"stations {subject} are mixed up",
                where="session.yaml, stations",
                found="the images of each fit the pose of the other",
                next_step=f"Exchange the poses of {subject} in session.yaml, or their image"
                " folders",
                code="station.exchanged",
            )
    return None


def _mixed_up(
    station: SuspectStation,
    in_order: bool,
    rng: np.random.Generator,
    options: ImageEvidenceOptions,
) -> InputError | None:
    """Error of the hypothesis that explains a station's images better than the session, if any.

    in_order : whether another station shows that the readings are in order.
    """
    view, localization = station.view, station.localization
    starts = (
        [localization.T_camera_base] if localization.good or station.by_hand is not None else []
    )
    wide = station.elsewhere or station.turned > NEAR_SEARCH_TURN
    if wide and station.by_hand is not None:
        starts.append(station.by_hand)
    begin = np.array(starts).reshape(-1, 4, 4)

    def searched(images: Integers) -> EvidenceLevel[ImageHypothesis]:
        def ratios(hypotheses: Sequence[ImageHypothesis]) -> Array:
            readings = [view.joints, *(h.readings for h in hypotheses if h.readings is not None)]
            own, *together = likelihood_nearby(
                view, np.stack(readings), begin, wide, images, rng
            ).tolist()
            values = np.empty(len(hypotheses))
            for k, h in enumerate(hypotheses):
                if h.readings is not None:
                    values[k] = together.pop(0)
                    continue
                other = h.apply(view)  # other legs, with the same readings
                joints = other.joints[None]
                values[k] = likelihood_nearby(other, joints, begin, wide, images, rng)[0]
            values = (values - own) / localization.correlation_length
            # at a confirmed pose another explanation has to be better at once
            return values if station.elsewhere else np.where(values > 0, values, -np.inf)

        return EvidenceLevel(
            f"{len(images)} images", ratios, decides=False, most=SEARCH_OPTIONS.most
        )

    levels = [searched(view.few(FEW_CONFIGURATIONS))]
    if not station.elsewhere:
        # of few images any other explanation may fit better by chance
        levels.append(searched(view.few(len(view.configuration))))
    hypotheses, others = list(_hypotheses(station)), list(_other_images(station, options))
    some = [one.hypothesis for one in posterior(hypotheses, levels, SEARCH_OPTIONS)]
    count = len({one.meaning for one in (*hypotheses, *others)})
    return _likelier(station, [*others, *some], in_order, rng, options, count)


def _likelier(
    station: SuspectStation,
    hypotheses: list[ImageHypothesis],
    in_order: bool,
    rng: np.random.Generator,
    options: ImageEvidenceOptions,
    count: int | None = None,
) -> InputError | None:
    """Error of the likeliest hypothesis, by a full search, that explains a station better than the
    session, if any, with the rivals that it does not exclude.

    count : number of explanations of which these are the likeliest; of these, if None. Chance may
    confirm any of them, so the p-value of each is multiplied by their number (Bonferroni). The
    constants of a reversed motor are one explanation, as in the prior odds: those near each other
    show nearly the same legs.
    """
    if not hypotheses:
        return None
    view, localization = station.view, station.localization
    count = count or len(hypotheses)

    def by_full_search(hypotheses: Sequence[ImageHypothesis]) -> Array:
        views = [h.apply(view) for h in hypotheses]
        own, *searched = (
            find_station(each, station.by_hand, rng, near_prior=True) for each in (view, *views)
        )
        poses = np.stack([f.T_camera_base for f in (localization, own, *searched)])
        stated = likelihood_from(view, poses)
        # a machine that only this search localizes was missed, rather than described wrongly
        missed = own.good and not localization.good
        margin = options.right_name_share * own.log_likelihood_ratio if missed else 0.0
        out = np.full(len(hypotheses), -np.inf)
        for k, (h, other, at) in enumerate(zip(hypotheses, views, searched, strict=True)):
            if not at.good or station._replace(localization=at).elsewhere:
                continue
            gain = likelihood_from(other, poses) - stated - margin
            ratio = gain / localization.correlation_length
            # the stated readings contradict the pose by hand, and no other station shows that they
            # are in order
            if station.elsewhere and localization.good and not in_order and h.readings is not None:
                out[k] = ratio + options.pose_by_hand
            elif at.p_value * count < at.limit:
                out[k] = ratio
        return out

    level = EvidenceLevel("full search", by_full_search)
    found = likely(posterior(hypotheses, [level], SEARCH_OPTIONS))
    if not found:
        return None
    if _any_numbering(station):
        # another numbering alone explains the images no better, since the camera may stand
        # anywhere, but it may explain as well what seems to be another mistake
        numberings = list(_numberings(station, options))
        count += len(numberings)
        equal = posterior(numberings, [_searched_anywhere(station, rng)], SEARCH_OPTIONS)
        some = [one.hypothesis for one in (*found, *equal)]
        found = likely(posterior(some, [level], SEARCH_OPTIONS)) or found
    errors = [one.hypothesis.error for one in found]
    if errors[0].code == "readings.reversed":
        errors[0] = _with_likeliest_constant(station, found[0].hypothesis, rng)
    error, also = errors[0], [one.what for one in errors[1:]]
    if station.elsewhere and localization.good:
        also.append("the pose by hand is of another side of the machine")
    distinct = [what for what in dict.fromkeys(also) if what != error.what]  # several numberings
    if not distinct:
        return error
    rivals = f"fit as well if {' or '.join(distinct)}"
    return error.with_fields(
        found=f"{error.found}; they {rivals}" if error.found else f"images that {rivals}",
        rivals=tuple(dict.fromkeys(one.code for one in errors if one.code != error.code)),
    )


def _with_likeliest_constant(
    station: SuspectStation, hypothesis: ImageHypothesis, rng: np.random.Generator
) -> InputError:
    """Error about a reversed motor, with the constant near the hypothesis's own at which the robust
    fit of the edges is best; the camera's pose is estimated for each.
    """
    view, constant = station.view, hypothesis.facts["constant"]
    (motor,) = hypothesis.facts["motors"]
    low, high = view.machine.joint_ranges[motor]
    spacing = (high - low) / READING_HYPOTHESIS_OPTIONS.constants_in_a_stroke
    every = view.few(len(view.configuration))
    # the likelihood has local maxima 20 mm of a constant apart, and has chosen among them; the
    # truncated distances of the last descent have one minimum for each start
    reaches = LOCALIZATION_OPTIONS.reaches + LOCALIZATION_OPTIONS.final_reaches
    for _ in range(NAMING_ROUNDS):  # the constant determines the pose, and the pose the constant
        turned = reversed_motor(motor, constant).apply(view.all_joints)
        at = find_station(view.with_joints(turned), station.by_hand, rng, near_prior=True)
        constants = constant + np.linspace(-2 * spacing, 2 * spacing, CONSTANTS_COMPARED)
        joints = np.stack([reversed_motor(motor, c).apply(view.joints) for c in constants])
        fk = view.machine.forward_result(joints.reshape(-1, joints.shape[-1])).T_base_platform
        legs = view.legs_at(fk.reshape(*joints.shape[:2], 4, 4), joints)
        each = replace(view, guessed=legs)
        start = np.repeat(at.T_camera_base[None], len(constants), axis=0)
        misfits = score(each, refine_lm(each, start, every, 8, reaches), every, reaches[-2], 8)
        constant = float(constants[np.argmin(misfits)])
    return _reading_error(station, reversed_motor(motor, constant))


def _reading_error(station: SuspectStation, hypothesis: ReadingHypothesis) -> InputError:
    units = station.view.machine.joint_units
    return reading_error(hypothesis, station.table, station.columns, units, "the images fit")


def _searched_anywhere(
    station: SuspectStation, rng: np.random.Generator
) -> EvidenceLevel[ImageHypothesis]:
    """Evidence for other readings by a short search in few images, wherever the camera stands."""
    view = station.view
    few, anywhere = view.few(FEW_CONFIGURATIONS), np.zeros((0, 4, 4))

    def ratios(hypotheses: Sequence[ImageHypothesis]) -> Array:
        readings = np.stack([view.joints, *(h.apply(view).joints for h in hypotheses)])
        own, *values = likelihood_nearby(view, readings, anywhere, True, few, rng).tolist()
        return (np.array(values) - own) / station.localization.correlation_length

    name = f"{len(few)} images, anywhere"
    return EvidenceLevel(name, ratios, decides=False, most=SEARCH_OPTIONS.most)


def log_prior_of_each(machine: Machine, joints: Array) -> float:
    """Prior log-odds of each explanation of images, all alike. joints : readings (K, m)."""
    readings = reading_hypotheses(joints, machine.joint_ranges)
    return -math.log(len({h.meaning for h in readings}) + OTHER_EXPLANATIONS)


def _hypotheses(station: SuspectStation) -> Iterator[ImageHypothesis]:
    """Hypotheses about the readings and about images under their neighbours' names; of a station
    that was not localized, also diameters in place of radii.
    """
    view, prior = station.view, log_prior_of_each(station.view.machine, station.view.all_joints)
    # images may be of some configurations: their names shift, below
    yield from (
        one
        for one in _of_readings(station)
        if one.code != "readings.shifted"
        and not (_any_numbering(station) and one.code.startswith(NUMBERING))
    )
    names = view.configuration
    if 2 < len(names) == len(np.unique(names)):
        for step in (1, -1):
            shifted = np.roll(names, step)
            yield ImageHypothesis(
                "image.shifted",
                f"{step:+d}",
                lambda view, shifted=shifted: replace(view, configuration=shifted),
                prior,
                error=_shifted(step),
                readings=view.all_joints[shifted],
            )
    # thin legs of few pixels are as likely to be thinner still, and two images of right ones can
    # fit so by chance: only where nothing else explains
    if not station.localization.good and len(names) > 2:
        yield ImageHypothesis(
            "tube.diameter", "tubes", _with_half_radii, prior, error=diameters("mechanism.yaml")
        )


def _of_readings(station: SuspectStation) -> Iterator[ImageHypothesis]:
    """Hypotheses about the readings."""
    view, prior = station.view, log_prior_of_each(station.view.machine, station.view.all_joints)
    for h in reading_hypotheses(view.all_joints, view.machine.joint_ranges):
        joints = h.apply(view.all_joints)
        yield ImageHypothesis(
            h.code,
            h.subject,
            lambda view, joints=joints: view.with_joints(joints),
            prior,
            facts=h.facts,
            error=_reading_error(station, h),
            readings=joints[view.configuration],
        )


def _any_numbering(station: SuspectStation) -> bool:
    """Whether a machine of equal thirds would be localized by any of its equal numberings."""
    return station.localization.good and station.by_hand is None


def _numberings(
    station: SuspectStation, options: ImageEvidenceOptions
) -> Iterator[ImageHypothesis]:
    """Hypotheses about the numbering of the legs of a localized machine."""
    own = station.localization
    equal = options.right_name_share * own.log_likelihood_ratio / own.correlation_length
    for one in _of_readings(station):
        if one.code.startswith(NUMBERING):
            yield replace(one, log_prior=one.log_prior - equal)


def _with_half_radii(view: StationView) -> StationView:
    values = view.machine.values.copy()
    values[np.unique(view.tubes.radius)] /= 2
    return replace(view, machine=view.machine.with_values(values))


def _other_images(
    station: SuspectStation, options: ImageEvidenceOptions
) -> Iterator[ImageHypothesis]:
    """Images under the names that fit each of them best; mirrored images where the machine was not
    localized near its pose by hand.
    """
    view, T_camera_base = station.view, station.localization.T_camera_base
    names, prior = view.configuration, log_prior_of_each(view.machine, view.all_joints)
    if station.elsewhere:
        yield ImageHypothesis(
            "image.mirrored",
            station.name,
            lambda view: replace(view, tables=view.tables.mirrored()),
            prior,
            error=_mirrored(station),
        )
    if not 2 < len(names) == len(np.unique(names)):
        return
    columns = np.arange(len(names))
    # each image could have any name, and at least two images have wrong names; without this prior,
    # images of equal configurations would exchange their names
    choices, own = math.log(len(names)), station.localization
    keep_evidence = (
        own.log_likelihood_ratio / (own.correlation_length * len(names)) if own.good else 0.0
    )
    keeps = np.eye(len(names)) * own.correlation_length * (OPTIONS.act / 2 + choices)
    for _ in range(NAMING_ROUNDS):  # names determine the pose, and the pose the names
        fits = log_likelihood_by_name(
            replace(view, configuration=names[columns]), T_camera_base, names
        )
        before, columns = columns, _best_names(fits + keeps)
        if np.array_equal(before, columns):
            break
        T_camera_base = settled(replace(view, configuration=names[columns]), T_camera_base)
    shifted = np.flatnonzero(columns != np.arange(len(names)))
    if 0 < len(shifted) <= len(names) // 2:
        right = names[columns]
        yield ImageHypothesis(
            "image.exchanged",
            station.name,
            lambda view: replace(view, configuration=right),
            prior - len(shifted) * (choices + options.right_name_share * keep_evidence),
            error=_misnamed(station, shifted, names[columns[shifted]]),
        )


def _best_names(score: Array) -> Integers:
    """Assignment (n,) of names to images, each used once, with the largest sum of scores (n, n)."""
    others = np.where(np.eye(len(score), dtype=bool), -np.inf, score).max(axis=1)
    gain = np.sort(others - np.diag(score))
    # at least two images have to change their names; where that loses, as it usually does, SciPy's
    # assignment, which is slow to import, is not needed
    if gain[-2:].sum() < 0:
        return np.arange(len(score))
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment(-score)[1]


def _shifted(step: int) -> InputError:
    return InputError(
        "the images are shifted against the readings",
        where="joints.csv",
        found="each image fits the readings of the configuration"
        f" {'before' if step > 0 else 'after'} its own",
        next_step="Look for a row or an image that is missing or was taken twice, and name the"
        " images by the readings at which they were taken",
        code="image.shifted",
    )


def _misnamed(station: SuspectStation, images: Integers, fitting: Integers) -> InputError:
    """Error about images, by index, that fit other rows of the readings."""
    files = [station.files[k] for k in images]
    fit = [station.configurations[k] for k in fitting]
    return InputError(
        f"images of {station.name} bear each other's names",
        where=files[0],
        found="; ".join(f"{f} fits configuration {c}" for f, c in zip(files, fit, strict=True)),
        next_step="Give these images, or the rows of joints.csv, the right names",
        code="image.exchanged",
    )


def _mirrored(station: SuspectStation) -> InputError:
    if len(station.files) == 1:
        return InputError(
            f"this image of {station.name} is mirrored",
            where=station.files[0],
            found="the machine is localized with left and right exchanged",
            next_step="Flip this image, or take it again without mirroring",
            code="image.mirrored",
        )
    return InputError(
        f"the images of {station.name} are mirrored",
        where=f"session.yaml, stations.{station.name}",
        found="the machine is localized with left and right exchanged",
        next_step="Switch mirroring off in the camera or in the program that saved them, or flip"
        " the images and the camera's calibration alike",
        code="image.mirrored",
    )


def diameters(mechanism: str) -> InputError:
    """Error about radii that are twice too large; mechanism : the nominal model's file."""
    return InputError(
        "the tubes' radii look like diameters",
        where=f"{mechanism}, tubes",
        found="the images fit with radii half as large",
        next_step="Divide the radii by 2",
        code="tube.diameter",
    )
