"""Hypotheses about a session whose images disagree with it.

The hypotheses are all mistakes in the readings (:mod:`pkmcal.mechanisms.reading_hypotheses`),
exchanged stations, images under other names, mirrored images, and diameters in place of radii.
Their log-likelihoods are compared with that of the session as stated at several levels of evidence:
a short search in few images, the same search in all images, and a full search for the likeliest
hypotheses, after which all are compared from the same poses. Hypotheses are compared for localized
machines as well: with two columns exchanged, four legs of six still fit.

A search gives a lower bound of the likelihood, because it may end at a local maximum. Before the
full search, hypotheses are therefore discarded by their rank, not by their likelihood.
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
from pkmcal.levels import NEARLY_ALL
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
    HYPOTHESIS_THRESHOLDS,
    EvidenceLevel,
    Hypothesis,
    decide,
    likely,
    posterior,
)
from pkmcal.wording import how_often, listed

SEARCH_OPTIONS = replace(HYPOTHESIS_THRESHOLDS, beam=math.inf, most=3)
"""Thresholds of all decisions, with another selection of the hypotheses for the next level: the
likeliest three, because a search finds a lower bound of a hypothesis's likelihood only."""
OTHER_EXPLANATIONS = 4
"""Number of explanations of images other than mistakes in the readings: shifted, under other names,
mirrored, diameters for radii."""
NEAR_SEARCH_TURN = LOCALIZATION_OPTIONS.far.turn
"""Rotation (rad) between localized and rough pose above which hypotheses are searched about the
rough pose too: the standard deviation of rough poses."""
OTHER_POSE_TURN = np.radians(60.0) - NEAR_SEARCH_TURN
"""Rotation (rad) between localized and rough pose above which the two contradict each other: a
machine of six equal parts looks the same from 60 degrees aside, and rough poses are off by their
standard deviation."""
NAMING_ROUNDS = 3
"""Alternations of the names of images, or the constant of a motor, and the camera's pose."""
CONSTANTS_COMPARED = 17
"""Number of constants of a reversed motor that are compared, at a quarter of the spacing of the
hypotheses."""
FEW_CONFIGURATIONS = 4
"""Number of images in which all hypotheses about the readings are compared first."""
ENOUGH_IMAGES_ALONE = 4
"""Number of images below which a message gives their number as the reason, because they cannot be
divided into halves for search and test."""
USUAL_IMAGES, ENOUGH_IMAGES_OF_CALIBRATED = 15, 5
"""Usual number of images of a station for a calibration; and of a calibrated machine."""
NUMBERING = "readings.numbering_"
"""Prefix of the codes of hypotheses about the numbering of the legs."""
STATION_PAIRS_SEARCHED = 15
"""Largest number of pairs of stations that are searched for exchanged poses: those of six
stations."""


@dataclass(frozen=True)
class ImageEvidenceOptions:
    """Prior evidence on images, and margins of the likelihood, that no false-alarm level
    determines.
    """

    # log-likelihood ratio (nats) of a rough pose against readings that place the camera on another
    # side of the machine: more than that of any images, because a person does not mistake the
    # side, and a machine of equal parts looks the same from each. Ten thousand images of a hundred
    # edges, each with two measurements of less than five nats, have 1e7. The refusal names the pose
    # as a rival
    pose_by_hand: float = 1e9
    # margin, as a share of the mean log-likelihood ratio of a station's images, by which a mistake
    # has to be likelier: another name of an image, another numbering of the legs, or any mistake
    # where the machine was not localized as stated. Between nearly equal configurations, equal
    # parts of a machine, or a machine and its mirror image from the opposite side, errors of the
    # nominal model decide. The likelihood contains their scatter, but not their correlation over
    # the images of a station. Their effect is proportional to the evidence, hence a share: what is
    # stated stays if it explains nearly all of the evidence. On simulated machines wrong names had
    # ratios of 0.2 to 2, right names up to 0.03
    right_name_share: float = 1 - NEARLY_ALL


IMAGE_EVIDENCE = ImageEvidenceOptions()


class SuspectStation(NamedTuple):
    """Station whose images are compared with hypotheses.

    name, files : of the station and of its images.
    configurations : names of the images' configurations.
    table, columns : file of the readings, and its columns.
    view : images and machine as stated.
    by_hand : rough pose T_camera_base (4, 4), None without one.
    localization : result for the session as stated.
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
        """Whether the machine was localized far from the rough pose, or not at all."""
        return not self.localization.good or self.turned > OTHER_POSE_TURN

    @property
    def turned(self) -> float:
        """Rotation (rad) between the localized and the rough pose; 0 without a rough pose."""
        if self.by_hand is None:
            return 0.0
        return float(angle_between(self.localization.T_camera_base, self.by_hand))


StationPair = tuple[SuspectStation, SuspectStation]


@dataclass(frozen=True)
class ImageHypothesis(Hypothesis[StationView]):
    """Hypothesis about the images of a station; its data are the station's view.

    error : error that names the mistake.
    readings : (K, m) of the images, for a hypothesis that changes nothing else.
    """

    error: InputError = field(default_factory=lambda: InputError(""))
    readings: Array | None = None


def image_mistake(
    stations: list[SuspectStation],
    rng: np.random.Generator,
    options: ImageEvidenceOptions = IMAGE_EVIDENCE,
) -> InputError | None:
    """Error about stations whose images disagree with the session, None if all agree."""
    # exchanged stations
    error = _exchanged_stations([s for s in stations if s.elsewhere], rng)
    if error is not None or not stations:
        return error
    bad = [station for station in stations if not station.localization.good]
    # the station with the least evidence decides about the readings
    worst = max(
        stations, key=lambda s: (not s.localization.good, s.elsewhere, s.localization.p_value)
    )
    # a station that is localized near its pose by hand shows that the readings are in order
    in_order = any(s.by_hand is not None and not s.elsewhere for s in stations)
    error = _likeliest_mistake(worst, in_order, rng, options)
    if error is not None:
        return error
    if not bad:  # readings are wrong for all stations, but names for one alone
        rest = (station for station in stations if station is not worst)
        errors = (_likelier(s, list(_other_images(s, options)), True, rng, options) for s in rest)
        return next((error for error in errors if error is not None), None)
    # no hypothesis explains the images
    others = [station.name for station in bad if station is not worst]
    at = ", nor in those of " + listed(others) if others else ""
    count = len(worst.view.configuration)
    calibrated = worst.view.earlier_joints is not None
    enough = ENOUGH_IMAGES_OF_CALIBRATED if calibrated else USUAL_IMAGES
    more = ""
    if count < ENOUGH_IMAGES_ALONE:
        more = (
            f"Take more images from there, {enough} are usual: with so few no exchange of images"
            " or readings can be detected. If there are more, check"
        )
    elif count < USUAL_IMAGES and worst.localization.p_value >= worst.localization.limit:
        more = (
            "Take images of more configurations, in which the legs stand more differently. If they"
            " do, check"
        )
    return InputError(
        f"the machine was not localized in the images of {worst.name}{at}",
        where=f"session.yaml, stations.{worst.name}",
        found=_little(worst),
        expected="one place where its legs lie on image edges far more often than by chance",
        next_step=(more or "Check")
        + " that these images show this machine's legs, that each bears the name"
        " of its configuration, and that the nominal model is this machine's"
        + ("" if worst.by_hand is not None else "; a pose by hand, right to 20 cm, may help"),
        code="station.not_recognised",
    )


def _little(station: SuspectStation) -> str:
    """Reason why the evidence for the machine is too weak, in words."""
    localization = station.localization
    if localization.p_value < localization.limit:
        return "legs that fit nearly as well at another place"
    count = len(station.view.configuration)
    if count < 2:
        return "one image alone, and none to confirm what it seems to show"
    few = f"{count} images alone, and " if count < ENOUGH_IMAGES_ALONE else ""
    often = how_often(localization.p_value)
    return f"{few}legs that readings of other configurations fit as well {often}"


def _exchanged_stations(
    stations: list[SuspectStation], rng: np.random.Generator
) -> InputError | None:
    """Error about two stations whose images are exchanged.

    Mirrored images are the rival hypothesis, because the mirror image of a symmetric machine
    resembles the machine from the other side.

    stations : localized far from their rough poses, or not at all.
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
                    # without exchanged stations there is no need to exclude mirrored images
                    out[k:] = -np.inf
                    return out
                out[k] += at.log_likelihood_ratio / at.correlation_length
        return out

    for one, other in islice(combinations(placed, 2), STATION_PAIRS_SEARCHED):
        subject = f"{one.name} and {other.name}"
        hypotheses = [
            Hypothesis("station.exchanged", subject, exchanged),
            Hypothesis("image.mirrored", subject, mirrored),
        ]
        # both machines have to be localized near the exchanged poses
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


def _likeliest_mistake(
    station: SuspectStation,
    in_order: bool,
    rng: np.random.Generator,
    options: ImageEvidenceOptions,
) -> InputError | None:
    """Error of the hypothesis that explains a station's images better than the session, if any.

    in_order : whether another station confirms the readings.
    """
    view, localization = station.view, station.localization
    # poses from which the hypotheses are searched: the localized one, and the rough one
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
            # at a confirmed pose, only explanations that are better at this level are retained
            return values if station.elsewhere else np.where(values > 0, values, -np.inf)

        return EvidenceLevel(
            f"{len(images)} images", ratios, decides=False, most=SEARCH_OPTIONS.most
        )

    # few images, then all images
    levels = [searched(view.few(FEW_CONFIGURATIONS))]
    if not station.elsewhere:
        # in a few images another explanation may fit better by chance
        levels.append(searched(view.few(len(view.configuration))))
    hypotheses, others = list(_hypotheses(station)), list(_other_images(station, options))
    # full search for the likeliest
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
    """Error of the likeliest hypothesis that explains a station better than the session, by a full
    search.

    The error names the rival hypotheses that the images do not exclude. None if no hypothesis is
    better.

    count : number of explanations from which ``hypotheses`` were selected, by default their own
        number. Any of them may be confirmed by chance, so p-values are multiplied by it
        (Bonferroni). All constants of a reversed motor are one explanation, as in the prior odds,
        because neighbouring ones predict nearly the same legs.
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
        # a machine that was not localized may have been missed, rather than described wrongly, and
        # its mirror image fits from the opposite side as well as errors of the nominal model allow
        missed = not localization.good
        margin = options.right_name_share * own.log_likelihood_ratio if missed else 0.0
        out = np.full(len(hypotheses), -np.inf)
        for k, (h, other, at) in enumerate(zip(hypotheses, views, searched, strict=True)):
            if not at.good or station._replace(localization=at).elsewhere:
                continue
            gain = likelihood_from(other, poses) - stated - margin
            ratio = gain / localization.correlation_length
            # the stated readings contradict the rough pose, and no other station confirms them
            if station.elsewhere and localization.good and not in_order and h.readings is not None:
                out[k] = ratio + options.pose_by_hand
            elif at.p_value * count < at.limit:
                out[k] = ratio
        return out

    level = EvidenceLevel("full search", by_full_search)
    # hypotheses that are likelier than the session
    found = likely(posterior(hypotheses, [level], SEARCH_OPTIONS))
    if not found:
        return None
    if _any_numbering(station):
        # Without a rough pose another numbering is as likely as the stated one, so it is no mistake
        # by itself, but it may be a rival of the mistake that was detected.
        numberings = list(_numberings(station, options))
        count += len(numberings)
        equal = posterior(numberings, [_searched_anywhere(station, rng)], SEARCH_OPTIONS)
        some = [one.hypothesis for one in (*found, *equal)]
        found = likely(posterior(some, [level], SEARCH_OPTIONS)) or found
    # error of the likeliest, with its rivals
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
    """Error about a reversed motor, with the constant at which the robust fit of the edges is best.

    Constants near that of the hypothesis are compared; the camera's pose is estimated for each.
    """
    view, constant = station.view, hypothesis.facts["constant"]
    (motor,) = hypothesis.facts["motors"]
    low, high = view.machine.joint_ranges[motor]
    spacing = (high - low) / READING_HYPOTHESIS_OPTIONS.constants_in_a_stroke
    every = view.few(len(view.configuration))
    # The likelihood has local maxima 20 mm of the constant apart, of which the hypothesis is the
    # highest. The truncated distances of the last descent have a single minimum around it.
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
    """Level of evidence for other readings: a short search in few images, without a prior of the
    pose.
    """
    view = station.view
    few, anywhere = view.few(FEW_CONFIGURATIONS), np.zeros((0, 4, 4))

    def ratios(hypotheses: Sequence[ImageHypothesis]) -> Array:
        readings = np.stack([view.joints, *(h.apply(view).joints for h in hypotheses)])
        own, *values = likelihood_nearby(view, readings, anywhere, True, few, rng).tolist()
        return (np.array(values) - own) / station.localization.correlation_length

    name = f"{len(few)} images, anywhere"
    return EvidenceLevel(name, ratios, decides=False, most=SEARCH_OPTIONS.most)


def log_prior_of_each(machine: Machine, joints: Array) -> float:
    """Log prior odds of each explanation of images, equal for all. joints : readings (K, m)."""
    readings = reading_hypotheses(joints, machine.joint_ranges)
    return -math.log(len({h.meaning for h in readings}) + OTHER_EXPLANATIONS)


def _hypotheses(station: SuspectStation) -> Iterator[ImageHypothesis]:
    """Hypotheses about the readings, and about images under their neighbours' names; for a station
    that was not localized, also diameters in place of radii.
    """
    view, prior = station.view, log_prior_of_each(station.view.machine, station.view.all_joints)
    # shifted names are tried below, by the station's own images, which may be of some
    # configurations only
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
                error=_shifted_images(step),
                readings=view.all_joints[shifted],
            )
    # Legs of a few pixels' width fit almost as well with half the radius, and two images may prefer
    # it by chance: tried only if the machine was not localized.
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
    """Whether the numbering of the legs is undetermined: a machine of equal thirds, without a rough
    pose, is localized with any of its equivalent numberings.
    """
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
    """Hypotheses about images under other names; where the machine was not localized near its rough
    pose, also about mirrored images.
    """
    view, T_camera_base = station.view, station.localization.T_camera_base
    names, prior = view.configuration, log_prior_of_each(view.machine, view.all_joints)
    if station.elsewhere:
        yield ImageHypothesis(
            "image.mirrored",
            station.name,
            lambda view: replace(view, tables=view.tables.mirrored()),
            prior,
            error=_mirrored_images(station),
        )
    if not 2 < len(names) == len(np.unique(names)):
        return
    columns = np.arange(len(names))
    # prior of the stated names: each image could have any name, and at least two have to be wrong;
    # without it, images of equal configurations would exchange their names
    choices, own = math.log(len(names)), station.localization
    keep_evidence = (
        own.log_likelihood_ratio / (own.correlation_length * len(names)) if own.good else 0.0
    )
    keeps = np.eye(len(names)) * own.correlation_length * (HYPOTHESIS_THRESHOLDS.act / 2 + choices)
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
            error=_exchanged_images(station, shifted, names[columns[shifted]]),
        )


def _best_names(score: Array) -> Integers:
    """Assignment (n,) of names to images, each used once, with the largest sum of scores (n, n)."""
    others = np.where(np.eye(len(score), dtype=bool), -np.inf, score).max(axis=1)
    gain = np.sort(others - np.diag(score))
    # usually even the best two changes of names lower the sum: the stated names are then best, and
    # SciPy's assignment, which is slow to import, is not needed
    if gain[-2:].sum() < 0:
        return np.arange(len(score))
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment(-score)[1]


def _shifted_images(step: int) -> InputError:
    return InputError(
        "the images are shifted against the readings",
        where="joints.csv",
        found="each image fits the readings of the configuration"
        f" {'before' if step > 0 else 'after'} its own",
        next_step="Look for a row or an image that is missing or was taken twice, and name the"
        " images by the readings at which they were taken",
        code="image.shifted",
    )


def _exchanged_images(station: SuspectStation, images: Integers, fitting: Integers) -> InputError:
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


def _mirrored_images(station: SuspectStation) -> InputError:
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
