"""Unidentifiable directions in words: the right sentence for what a session lacks."""

from __future__ import annotations

import re
from dataclasses import replace
from string import Formatter

import numpy as np
import pytest
import yaml
from scipy.optimize import least_squares

from pkmcal.geometry.rigid import perturb
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.covariance import Information, identifiability
from pkmcal.identify.gauge import default_gauge, freedoms, generators
from pkmcal.identify.motions import (
    NamedChanges,
    Situation,
    candidates,
    hanging_together,
    movable_leg_groups,
)
from pkmcal.identify.sentences import MOST_SENTENCES
from pkmcal.identify.tool import _around, platform_by_parameters, pose_by_parameters
from pkmcal.identify.unidentified import (
    describe,
    direction_vectors,
    observed_by_boards,
    observed_legs,
)
from pkmcal.mechanisms import kinematics, load_mechanism
from pkmcal.mechanisms.carriers.contract import NamedMotion, base_carriers, platform_carriers
from pkmcal.mechanisms.carriers.slider import Slider
from pkmcal.mechanisms.closure import limb_ends
from test_identify_scene import Scene, _edges, _index, exact, stations


def moved(machine, rng, n, turn=0.2, shift=0.04):
    """Poses about home along the machine's motion."""
    step = np.concatenate(
        [turn * rng.uniform(-1, 1, (n, 3)), shift * rng.uniform(-1, 1, (n, 3))], -1
    )
    return perturb(machine.home(), step @ machine.layout.motion @ machine.layout.motion.T)


def heaved(machine, n=8):
    poses = np.tile(machine.home(), (n, 1, 1))
    poses[:, 2, 3] += np.linspace(-0.04, 0.04, n)
    return poses


def make(name, *, poses=None, n=12, n_stations=3, errors=1.0, seed=3, machine=None) -> Scene:
    """A machine with errors, with exact readings by default, and cameras around it that see all
    legs.
    """
    rng = np.random.default_rng(seed)
    machine = machine or exact(name)
    table = machine.parameters
    draw = table.tolerances_free() * rng.normal(size=table.free_matrix().shape[1])
    theta = table.nominal + errors * table.free_matrix() @ draw
    poses = moved(machine, rng, n) if poses is None else poses
    value = kinematics.on_manifold(machine.layout, theta, poses)
    poses = value.T_base_platform[value.converged]
    joints = machine.with_values(theta).inverse(poses)[None]
    ends = limb_ends(machine.layout, theta[None, None], joints, poses[None])
    index = _index(rng, machine, len(poses), n_stations, 1.0)
    normal, middle = _edges(machine, theta[None], stations(n_stations), ends, index)
    covariance = np.zeros((index.shape[1], 2, 2))
    covariance[:, [0, 1], [0, 1]] = (np.array([0.05, 0.2]) / 889) ** 2
    shift = np.tile([-1 / 889, 0.0], (index.shape[1], 1))
    return Scene(
        machine, theta[None], stations(n_stations), poses[None], joints, np.zeros(1), index,
        normal, covariance, shift, middle,
    )  # fmt: skip


def identified(scene: Scene, *views):
    """Rank test and sentences where each station sees some legs only (numbers from 1)."""
    machine = scene.machine.with_values(scene.theta[0])
    measurements = scene.measurements(np.random.default_rng(0), noise=0.0)
    if views:
        visible = np.zeros((len(views), machine.n_legs), bool)
        for s, view in enumerate(views):
            visible[s, np.array(view) - 1] = True
        edges = measurements.edges
        keep = visible[edges.station, edges.leg]
        measurements = type(measurements)(
            edges.select(keep), measurements.joints, measurements.joint_noise,
            measurements.n_stations, measurements.camera_of_station,
        )  # fmt: skip
    assembled = assemble(scene.machine, measurements, default_gauge(scene.machine))
    state = batch_of(scene.machine, assembled, scene.state())
    values = identifiability(Information(assembled.problem, state), scene.machine)
    edges = measurements.edges
    observed = observed_legs(edges, np.ones(len(edges)), measurements.n_stations, machine.n_legs)
    null = direction_vectors(values.unidentified, machine)
    return values, observed, describe(Situation(machine, observed, scene.poses[0]), null)


# ------------------------------------------------------------------ whole sessions and poor ones


@pytest.mark.parametrize("name", ["gough-stewart", "3-rpr", "3-rps", "6-spu-passive"])
def test_a_whole_session_leaves_nothing_open(name):
    values, _, sentences = identified(make(name))
    assert values.unidentified == ()
    assert sentences == ()


@pytest.mark.parametrize("name", ["gough-stewart", "3-rpr", "3-rps"])
def test_legs_alone_leave_the_size_to_the_tolerance_of_the_scales(name):
    """Cameras measure angles; lengths come from readings, each uncertain by its scale."""
    machine = load_mechanism(name)
    values, _, sentences = identified(make(name, machine=machine))
    assert len(values.unidentified) == 1
    (size,) = sentences
    assert size.text.startswith(
        "The size of everything is known from the nominal model only, by the"
    )
    scales = {f"legs[{j + 1}].scale" for j in range(machine.n_legs)}
    assert set(size.parameters) == scales
    # all scales as one, each known to 0.05 %: 0.05 % / sqrt(legs) of the joints' way
    assert not size.matters
    assert 0 < size.moves_platform < 0.0005 / np.sqrt(machine.n_legs) * 0.3


def test_the_size_of_a_machine_that_turns_its_arms_needs_a_board():
    """Angles have no scale, so more configurations never help."""
    machine = load_mechanism("delta")
    poses = moved(machine, np.random.default_rng(0), 12)
    growth = np.where(np.array(machine.parameters.units) == "m", machine.values, 0.0)
    seen = Situation(machine, np.ones((2, machine.n_legs), dtype=bool), poses)
    (size,) = describe(seen, growth[None] / np.linalg.norm(growth))
    assert size.advice.startswith("Observe a board with the legs (observe: [legs, board])")
    assert "readings" not in size.advice


@pytest.mark.parametrize(
    ("name", "legs"),
    [("gough-stewart", "Legs 1 to 6"), ("3-rpr", "Legs 1 to 3"), ("3-rps", "Legs 1 to 3")],
)
def test_one_configuration_lets_every_leg_slide_along_itself(name, legs):
    values, _, sentences = identified(make(name, n=1, n_stations=2))
    slide = next(s for s in sentences if "grow and shift along itself" in s.text)
    assert slide.text.startswith(f"{legs} keep nearly one direction each")
    assert slide.dimensions == 2 * load_mechanism(name).n_legs
    assert "more configurations" in slide.advice
    assert sum(s.dimensions for s in sentences) == len(values.unidentified)
    assert any(s.matters for s in sentences)


def test_heave_alone_leaves_the_depth_of_all_legs():
    machine = load_mechanism("gough-stewart")
    values, _, sentences = identified(make("gough-stewart", poses=heaved(machine)))
    assert len(values.unidentified) == 1
    assert len(sentences) == 1
    assert sentences[0].text.startswith(
        "How far apart the legs stand and how thick their tubes are"
    )
    assert sentences[0].advice.startswith("Turn the platform in some configurations")


def test_stations_without_shared_legs_are_reported():
    poses = moved(load_mechanism("gough-stewart"), np.random.default_rng(1), 8, turn=0.0)
    scene = make("gough-stewart", poses=poses)
    values, _, sentences = identified(scene, [1, 3, 4, 6], [1, 3, 4, 6], [2, 5])
    group = sentences[0]
    assert group.text.startswith(
        "Legs 2 and 5 are never seen together with the others: legs 2 and 5 as a whole can shift"
        " in all directions against the others."
    )
    assert group.dimensions == 3
    assert group.matters
    assert group.advice.startswith("Add a station that sees legs 2 and 5 together with legs 1, 3,")
    assert "board: {fixed_to: base}" in group.advice
    assert sum(s.dimensions for s in sentences) == len(values.unidentified)


def test_heave_with_stations_apart_also_turns_one_group():
    scene = make("gough-stewart", poses=heaved(load_mechanism("gough-stewart")))
    _, _, sentences = identified(scene, [1, 2, 3], [4, 5, 6], [4, 5, 6])
    assert "legs 4 to 6 as a whole can shift in all directions and turn about z" in (
        sentences[0].text
    )
    assert sentences[0].dimensions == 4
    assert any(s.text.startswith("The tubes' radii of legs 1 to 3 and the di") for s in sentences)


def test_platform_turns_join_stations_that_share_no_leg():
    values, _, sentences = identified(make("gough-stewart", n_stations=2), [1, 2, 3], [4, 5, 6])
    assert values.unidentified == ()
    assert sentences == ()


def test_a_leg_nobody_sees_stands_on_its_readings():
    scene = make("gough-stewart", n=4)
    without = [1, 2, 4, 5, 6]
    rows, _, sentences = identified(scene, without, without, without)
    assert [s.text.split(";")[0] for s in sentences] == ["Leg 3 is in no image"]
    assert sentences[0].dimensions == len(rows.unidentified) == 5
    assert sentences[0].matters
    assert sentences[0].advice.startswith("Take images of leg 3")
    assert all(name.startswith("legs[3]") for name in sentences[0].parameters)


def test_a_passive_leg_nobody_sees_moves_nothing():
    values, _, sentences = identified(make("6-spu-passive"), *[[1, 2, 3, 4, 5, 6]] * 3)
    assert len(sentences) == 1
    assert sentences[0].text == (
        "Leg 7 is in no image, so that nothing determines where its joints are."
        " This does not move the platform."
    )
    assert not sentences[0].matters
    assert sentences[0].dimensions == len(values.unidentified) == 8


def test_common_turns_of_parallel_axes_move_nothing():
    """The 3-UPU with nominal geometry: six of twelve axis directions are unidentifiable
    (errata).
    """
    machine = load_mechanism("3-upu")
    poses = moved(machine, np.random.default_rng(1), 15, turn=0.0)
    _, _, sentences = identified(make("3-upu", poses=poses, errors=0.0))
    turn = sentences[0]
    assert turn.text.startswith("The common direction of both axes of each of legs 1 to 3 is free")
    assert turn.dimensions == 6
    assert not turn.matters
    assert turn.moves_platform < 1e-9
    assert all(".axis." in name for name in turn.parameters)
    assert "does not move the platform" in turn.text


# ------------------------------------------------------------------ from arrays alone


def hexapod():
    machine = load_mechanism("gough-stewart")
    return machine, moved(machine, np.random.default_rng(2), 10)


def unit(machine, change):
    """A change (P,) by name, in units of m."""
    out = np.zeros(len(machine.parameters))
    for name, value in change.items():
        out[machine.parameters.index(name)] = value
    return out


def scene_from(*views, legs=6):
    out = np.zeros((len(views), legs), bool)
    for s, view in enumerate(views):
        out[s, np.array(view) - 1] = True
    return out


@pytest.mark.parametrize("name", ["gough-stewart", "linear-delta", "delta"])
def test_a_leg_grows_along_the_way_that_it_has_at_its_readings(name):
    """With carriages and cranks where they were, and not at reading zero."""
    machine = load_mechanism(name)
    sense = kinematics.closure_at(machine.layout, machine.values, machine.home()).rows.u[0]
    change = {f"legs[1].base.center.{c}": -v for c, v in zip("xyz", sense, strict=True)}
    change |= {n: 1.0 for n in machine.parameters.names if n.startswith("legs[1].length")}
    around = Situation(machine, np.ones((1, machine.n_legs), bool), machine.home()[None])
    (sentence,) = describe(around, unit(machine, change)[None])
    assert "it can grow while its base joint moves back along it" in sentence.text


def test_a_hinge_is_found_through_the_joints_it_goes_through():
    machine, poses = hexapod()
    # in one plane a turn of some joints is a lift of others, and that is as true
    heights = {f"legs[{j}].base.center.z": h for j, h in enumerate((0, 60, -50, 40, 70, -30), 1)}
    machine = machine.with_values(machine.values + 1e-3 * unit(machine, heights))
    centres = machine.base_centers()
    axis = centres[3] - centres[0]
    axis = axis / np.linalg.norm(axis)
    change = np.zeros(len(machine.parameters))
    for leg in (1, 4):
        row = machine.parameters.index(f"legs[{leg + 1}].base.center.x")
        change[row : row + 3] = np.cross(axis, centres[leg] - centres[0])
    in_view = scene_from([1, 4, 2, 5], [1, 4, 3, 6])
    (sentence,) = describe(Situation(machine, in_view, poses), change[None])
    assert sentence.text.startswith(
        "Of the others, only legs 1 and 4 are ever seen together with legs 2 and 5: the base joints"
        " of legs 2 and 5 can turn about the axis through joints 1 and 4 against the others."
    )


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"legs[3].length.offset": 1.0}, "The length offset of leg 3 is free."),
        ({"legs[2].base.center.z": 1.0}, "The base joint of leg 2 is free along z."),
        ({"legs[5].tubes[1].radius": 1.0}, "The tubes' radii of leg 5 are free."),
        (
            {f"legs[{j}].length.offset": 1.0 for j in range(1, 7)},
            "The length offset, of all legs alike, is free.",
        ),
        (
            {"legs[1].base.center.z": 1.0, "legs[2].base.center.z": -1.0,
             "legs[3].base.center.z": 0.6, "legs[5].base.center.z": 1.1},
            "How the base joints lie to each other is free in one way: +1 mm of leg ",
        ),
        (
            {"legs[1].base.center.x": 1.0, "legs[4].length.offset": 0.7,
             "legs[6].platform.center.y": -0.8},
            "Of the machine's numbers, one combination is free: +1 mm of leg 1 base centre x goes "
            "with −0.80 mm of leg 6 platform centre y and +0.70 mm of leg 4 length offset.",
        ),
    ],
)  # fmt: skip
def test_single_changes_have_their_names(change, text):
    machine, poses = hexapod()
    visible = np.ones((2, 6), bool)
    (sentence,) = describe(Situation(machine, visible, poses), unit(machine, change)[None])
    assert sentence.text.startswith(text)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (
            "6-spu-passive",
            "Of the values of legs 1 and 7, one combination each is free, mostly of leg",
        ),
        ("constant-legs", "The tubes' radii of legs 1 and 3 are free."),
    ],
)
def test_legs_with_different_numbers_share_a_sentence(name, text):
    """A passive leg has no length, a strut one tube: fewer numbers than the leg beside it."""
    machine = load_mechanism(name)
    poses = moved(machine, np.random.default_rng(1), 5)
    if name == "constant-legs":
        changes = [{f"legs[{j}].tubes[1].radius": 1.0} for j in (1, 3)]
    else:
        centres = [f"legs[{{}}].{side}.center.{c}" for side in ("base", "platform") for c in "xyz"]
        numbers = np.random.default_rng(2).normal(size=6)
        changes = [{n.format(j): v for n, v in zip(centres, numbers, strict=True)} for j in (1, 7)]
    null = np.array([unit(machine, change) for change in changes])
    sentences = describe(Situation(machine, np.ones((2, machine.n_legs), bool), poses), null)
    assert [s.text.startswith(text) for s in sentences] == [True]


def test_a_leg_growing_into_its_base_is_found():
    machine, poses = hexapod()
    around = Situation(machine, np.ones((1, 6), bool), poses[:1])
    row = machine.parameters.index("legs[3].base.center.x")
    change = unit(machine, {"legs[3].length.offset": 1.0})
    change[row : row + 3] = -around.along[0][2]
    (sentence,) = describe(around, change[None])
    assert "it can grow while its base joint moves back along it" in sentence.text


def test_any_basis_of_the_space_gives_the_same_words():
    scene = make("gough-stewart", poses=heaved(load_mechanism("gough-stewart")))
    values, in_view, expected = identified(scene, [1, 2, 3], [4, 5, 6], [4, 5, 6])
    machine = scene.machine.with_values(scene.theta[0])
    null = direction_vectors(values.unidentified, machine)
    mix = np.random.default_rng(5).normal(size=(len(null), len(null)))
    again = describe(Situation(machine, in_view, scene.poses[0]), mix @ null)
    assert [s.text for s in again] == [s.text for s in expected]


def test_frames_are_no_finding():
    machine, poses = hexapod()
    frames = (generators(machine.layout, machine.values) @ freedoms(machine)).T
    change = unit(machine, {"legs[3].length.offset": 1e-3})
    mixed = change + 0.02 * frames[4] - 0.01 * frames[7]
    (sentence,) = describe(Situation(machine, np.ones((1, 6), bool), poses), mixed[None])
    assert sentence.text.startswith("The length offset of leg 3 is free.")
    assert describe(Situation(machine, np.ones((1, 6), bool), poses), frames[:0]) == ()


def test_many_open_directions_stay_readable():
    machine, poses = hexapod()
    rng = np.random.default_rng(1)
    null = rng.normal(size=(25, len(machine.parameters))) * machine.parameters.tolerance
    sentences = describe(Situation(machine, np.ones((1, 6), bool), poses), null)
    assert 0 < len(sentences) <= MOST_SENTENCES
    assert sum(s.dimensions for s in sentences) == 25


def test_what_the_prior_determines_better_is_not_called_free():
    machine, poses = hexapod()
    null = unit(machine, {"legs[3].length.offset": 1.0})[None]
    visible = np.ones((1, 6), bool)
    (weak,) = describe(Situation(machine, visible, poses), null, np.array([0.5]))
    (open_,) = describe(Situation(machine, visible, poses), null)
    assert weak.text.startswith("The length offset of leg 3 is known from the nominal model only.")
    assert "smaller tolerances" in weak.advice
    assert weak.moves_platform == pytest.approx(open_.moves_platform / np.sqrt(1.25))


@pytest.mark.parametrize("name", ["gough-stewart", "3-upu"])
def test_advice_about_fixed_can_be_written_there(name):
    _, _, sentences = identified(make(name, n=1, n_stations=2))
    table = load_mechanism(name).parameters
    for sentence in sentences:
        (line,) = re.findall(r"(fixed: \[.*\]) in the mechanism file", sentence.advice)
        held = table.with_roles(tuple(yaml.safe_load(line)["fixed"])).fixed
        assert {*sentence.parameters} <= {*held}


def test_all_legs_are_fixed_in_one_entry_beside_what_is_fixed_already():
    machine = load_mechanism("gough-stewart")
    document = machine.document.model_copy(update={"fixed": ("legs[1].base.center.z",)})
    visible = np.ones((1, 6), bool)

    def advice(change, document):
        around = Situation(replace(machine, document=document), visible, hexapod()[1])
        (sentence,) = describe(around, unit(machine, change)[None])
        return re.search(r"; or (.*) the mechanism file if", sentence.advice)[1]

    scales = {f"legs[{j}].scale": 1e-4 * j for j in range(6, 0, -1)}
    assert advice(scales, machine.document) == 'fixed: ["legs[*].scale"] in'
    assert advice(scales, document) == '"legs[*].scale" beside what stands under fixed: in'
    del scales["legs[1].scale"]
    every = ", ".join(f'"legs[{j}].scale"' for j in range(2, 7))
    assert advice(scales, machine.document) == f"fixed: [{every}] in"


def test_a_model_is_fixed_where_its_own_entries_stand():
    """The file's own ``fixed`` is ignored if one of its models was requested."""
    visible = np.ones((1, 3), bool)

    def advice(model):
        machine = load_mechanism("linear-delta", model=model)
        change = unit(machine, {f"legs[{j}].length.constant": 1.0 for j in (1, 2)})[None]
        around = Situation(machine, visible, moved(machine, np.random.default_rng(0), 5))
        (sentence,) = describe(around, change)
        return re.search(r"; or (.*) if the nominal model", sentence.advice)[1]

    assert advice(None).endswith("] in the mechanism file")
    assert advice("firmware").endswith(
        " beside what stands under fixed: in the mechanism file's model firmware"
    )


@pytest.mark.parametrize("name", ["gough-stewart", "3-rps"])
def test_how_far_the_platform_moves_agrees_with_the_forward_solution(name):
    """Both machines at the same readings, the one's frames fitted to the other's."""
    machine = load_mechanism(name)
    few = moved(machine, np.random.default_rng(5), 30)
    few = kinematics.on_manifold(machine.layout, machine.values, few).T_base_platform
    readings, poses = _around(machine, few)
    other = machine.with_values(
        machine.values + np.random.default_rng(6).normal(size=len(machine.parameters)) * 2e-5
    )
    change = other.values - machine.values
    there = other.forward(readings)
    joints = machine.platform_centers()
    a, b = (T[:, None, :3, :3] @ joints[..., None] for T in (poses, there))
    a, b = (p[..., 0] + T[:, None, :3, 3] for p, T in ((a, poses), (b, there)))

    def remainder(frames):
        """Displacements of the joints once B's base and platform frame are laid over A's."""
        base, platform = perturb(np.eye(4)[None], frames[:6][None]), frames[6:]
        own = perturb(np.eye(4)[None], platform[None])
        T = base @ there @ own
        return (T[:, None, :3, :3] @ joints[..., None])[..., 0] + T[:, None, :3, 3] - a

    fitted = least_squares(lambda x: remainder(x).ravel() * 1e3, np.zeros(12), x_scale=1e-5).x
    values = float(np.sqrt(np.mean(np.sum(remainder(fitted) ** 2, axis=-1))))
    items = float(np.linalg.norm(platform_by_parameters(machine, few) @ change))
    plain = float(np.sqrt(np.mean(np.sum((b - a) ** 2, axis=-1))))
    assert values < 0.9 * plain  # the frames do count
    assert items == pytest.approx(values, rel=1e-3)  # of second order, 1e-4 of a radian's


# ------------------------------------------------------------------ parts


def test_pose_derivatives_agree_with_the_forward_kinematics():
    for name in ("gough-stewart", "3-rps", "3-upu"):
        scene = make(name, n=3)
        machine = scene.machine.with_values(scene.theta[0])
        free, step = machine.parameters.free_matrix(), 1e-6
        jacobian = pose_by_parameters(machine, scene.joints[0], scene.poses[0]) @ free
        for k in range(0, free.shape[1], 5):
            there = machine.with_values(machine.values + step * free[:, k])
            fk = there.forward_result(scene.joints[0], scene.poses[0]).T_base_platform
            shift = (fk - scene.poses[0])[:, :3, 3] / step
            np.testing.assert_allclose(shift, jacobian[:, 3:, k], atol=2e-5)


def test_frames_do_not_move_the_platform_and_offsets_do():
    machine, poses = hexapod()
    effect = platform_by_parameters(machine, poses)
    frames = generators(machine.layout, machine.values) @ freedoms(machine)
    assert np.abs(effect @ frames).max() < 1e-9
    assert np.linalg.norm(effect @ unit(machine, {"legs[3].length.offset": 1.0})) > 0.05
    radii = machine.parameters.of_kind("radius")
    assert np.abs(effect[:, radii]).max() == 0


def test_one_pose_does_not_hide_what_others_show():
    """All of a single pose's change could be laid on the frames; the poses around it cannot."""
    machine, poses = hexapod()
    one = platform_by_parameters(machine, poses[:1])
    change = unit(machine, {"legs[3].length.offset": 1.0})
    assert np.linalg.norm(one @ change) > 0.05


def test_groups_follow_what_stations_share():
    in_view = scene_from([1, 4, 2, 5], [1, 4, 3, 6])
    assert (1, 4) in movable_leg_groups(in_view)
    assert (2, 5) in movable_leg_groups(in_view)
    assert [tuple(np.flatnonzero(g)) for g in hanging_together(in_view)] == [tuple(range(6))]
    apart = scene_from([1, 2], [3, 4], [4, 5], [6])
    parts = {tuple(np.flatnonzero(g).tolist()) for g in hanging_together(apart)}
    assert parts == {(0, 1), (2, 3, 4), (5,)}


def test_a_board_on_the_base_joins_stations():
    from pkmcal.measurements import Measurements, Mount, PoseSet

    edges = make("gough-stewart", n=1).measurements(np.random.default_rng(0)).edges
    poses = PoseSet(
        np.array([0, 2, 1]), np.zeros(3, int), np.array([0, 0, 1]), np.zeros((3, 4, 4)),
        np.zeros((3, 6, 6)),
    )  # fmt: skip
    mounts = (Mount("board", "base"), Mount("tool", "platform"))
    measured = Measurements(
        edges, np.zeros((1, 6)), 1e-6, 3, np.zeros(3, int), poses=poses, mounts=mounts
    )
    in_view = observed_by_boards(scene_from([1], [2], [3]), measured)
    assert [np.flatnonzero(row).tolist() for row in in_view] == [[0, 2], [1], [0, 2]]


@pytest.mark.parametrize("carrier", [*base_carriers().values(), *platform_carriers().values()])
def test_carriers_name_motions_of_their_own_numbers(carrier):
    """Motions that a carrier's file declares, for every carrier."""
    assert carrier.called
    parameters = np.random.default_rng(0).normal(size=len(carrier.parameters))
    places = set(re.findall(r"``{(\w+)}``", NamedChanges.__doc__ or ""))
    for motion in carrier.motions(parameters, np.array([0.1, np.nan, 0.3])):
        assert motion.columns.shape[0] == len(parameters)
        assert np.isfinite(motion.columns).all()
        for text in (motion.one, motion.several, motion.together):
            assert {name for _, name, _, _ in Formatter().parse(text) if name} <= places
            assert not text or "{legs}" in text


def test_what_a_carrier_names_is_stated(monkeypatch):
    """Words come from the carrier's file: no other file has its joint."""

    def drift(parameters, readings):
        del readings
        columns = np.zeros((parameters.size, 1))
        columns[[0, 3], 0] = 1.0, -2.0
        return (NamedMotion(columns, "how {legs} drifts {is}", "how {legs} drift {is}"),)

    monkeypatch.setattr(Slider, "motions", staticmethod(drift))
    machine = load_mechanism("linear-delta")
    changes = [{f"legs[{j}].base.center.x": 1.0, f"legs[{j}].base.axis.x": -2.0} for j in (1, 3)]
    null = np.array([unit(machine, change) for change in changes])
    poses = moved(machine, np.random.default_rng(1), 5)
    around = Situation(machine, np.ones((1, 3), bool), poses, imaged=False)
    (sentence,) = describe(around, null)
    assert sentence.text.startswith("How legs 1 and 3 drift is free. Within the nominal model's")
    assert sentence.dimensions == 2


def test_candidates_are_changes_of_this_machine():
    for name in ("gough-stewart", "3-upu", "3-rpr", "6-spu-passive"):
        machine = load_mechanism(name)
        visible = np.ones((2, machine.n_legs), bool)
        visible[1, 0] = False
        for motion in candidates(Situation(machine, visible, machine.home()[None])):
            assert motion.columns.shape[0] == len(machine.parameters)
            assert np.isfinite(motion.columns).all()
