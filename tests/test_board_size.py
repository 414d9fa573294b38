"""A board's size with a tolerance: estimated if the data determine it, in sigma otherwise."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from faults import raises
from pkmcal.boards.board import PRINTED_SIZE_TOLERANCE, board_from_document
from pkmcal.boards.poses import pose_set
from pkmcal.calibration.faults import size_notes
from pkmcal.errors import InputError
from pkmcal.files import Document
from pkmcal.geometry.rigid import perturb
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import bundle
from pkmcal.identify.centres import free_of_gauge
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.start import start_state
from pkmcal.identify.tool import tool_error
from pkmcal.measurements import EdgeSet, Measurements, Mount
from pkmcal.measurements.effects import BOARD_SIZE
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.region import Region, poses_in
from pkmcal.placement.configurations import draw_configurations

CAMERA = np.array([[1, 0, 0, 0.02], [0, -1, 0, -0.03], [0, 0, -1, 0.6], [0, 0, 0, 1.0]])
NOISE = np.array([3e-4, 3e-4, 3e-4, 3e-5, 3e-5, 6e-5])
TOLERANCE = 2e-3


def observed_boards(nominal, rng, size, tolerance, count=20):
    """Machine within its tolerances, and a camera's measurements of a board that is larger than its
    file states by the share ``size``.
    """
    table = nominal.parameters
    free = table.free_matrix()
    change = free @ (table.tolerances_free() * rng.standard_normal(free.shape[1]))
    true = nominal.with_values(table.unit_axes(table.nominal + change))
    poses = draw_configurations(true, count, 0.5, rng)[0][:count]
    there = perturb(CAMERA @ poses, NOISE * rng.standard_normal((count, 6)))
    there[:, :3, 3] /= 1 + size
    covariance = np.tile(np.diag(NOISE**2), (count, 1, 1))
    readings = true.inverse(poses) + 1e-5 * rng.standard_normal((count, nominal.n_joints))
    data = Measurements(
        EdgeSet.empty(),
        readings,
        1e-5,
        1,
        np.zeros(1, dtype=int),
        poses=pose_set(0, np.arange(count), 0, there, covariance),
        mounts=(Mount("board", "platform", tolerance),),
    )
    return true, data


def estimated(nominal, data):
    start = start_state(nominal, data, CAMERA[None])
    return bundle(nominal, data, replace(start, T_mount=np.eye(4)[None]), scale_noise=False)


def test_derivatives_by_the_size_are_those_of_the_residuals():
    nominal = load_mechanism("linear-delta")
    rng = np.random.default_rng(0)
    _, data = observed_boards(nominal, rng, 0.001, TOLERANCE)
    both = replace(
        data,
        mounts=(Mount("tool", "platform"), Mount("board", "platform", TOLERANCE)),
        poses=replace(data.poses, mount=np.arange(20) % 2),
    )
    assembled = assemble(nominal, both, default_gauge(nominal))
    start = start_state(nominal, both, CAMERA[None])
    state = batch_of(nominal, assembled, replace(start, T_mount=np.tile(np.eye(4), (2, 1, 1))))
    problem = assembled.problem
    sizes = problem.unknowns.of_code(BOARD_SIZE)
    at = sizes.start - problem.unknowns.effects.start
    state.columns[0, at] = 0.4 * TOLERANCE
    assert sizes.stop - sizes.start == 1
    by = problem.linearize(state).by_shared[0, :, :, sizes.start]
    ahead, behind = (
        problem.residuals(
            replace(state, columns=state.columns + step * (np.arange(state.columns.shape[1]) == at))
        ).value[0]
        for step in (1e-3, -1e-3)
    )
    np.testing.assert_allclose(by, (ahead - behind) / 2e-3, rtol=1e-6, atol=1e-8)
    assert np.any(by[1::2] != 0)
    assert np.all(by[::2] == 0)  # what a tracker measures has no size


def test_readings_of_carriages_determine_the_size_of_the_board():
    nominal = load_mechanism("linear-delta")
    _, data = observed_boards(nominal, np.random.default_rng(1), 0.003, TOLERANCE)
    result = estimated(nominal, data)
    value, sigma = result.state.columns[BOARD_SIZE][0], result.column_sigma(BOARD_SIZE)[0]
    assert sigma < 0.3 * TOLERANCE
    assert abs(value - 0.003) < 4 * sigma


def errors_at_the_tool(name, runs, tolerance, assumed):
    """z of the tool's displacement, by run and assumed tolerance: RMS over the workspace after
    fitting the frames, over its stated standard deviation.
    """
    nominal = load_mechanism(name)
    work = poses_in(nominal.limits(), Region(), 30)
    out = []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        true, data = observed_boards(nominal, rng, tolerance * rng.standard_normal(), tolerance)
        z = []
        for one in assumed:
            value = estimated(nominal, replace(data, mounts=(Mount("board", "platform", one),)))
            covariance = free_of_gauge(value.machine, value.covariance)
            values = tool_error(true, value.machine, covariance, work, legs_observed=False)
            z.append(np.sqrt(np.nanmean(values.off_position**2) / np.nanmean(values.position**2)))
        out.append(z)
    return np.array(out)


@pytest.mark.parametrize("runs", [12, pytest.param(48, marks=pytest.mark.slow)])
def test_sigma_contains_the_size_where_nothing_determines_it(runs):
    errors = errors_at_the_tool("delta", runs, TOLERANCE, (TOLERANCE, 0.0))
    z, blind = np.mean(errors**2, axis=0)
    # the size is one direction, and most of the tool's error: squares scatter as of one normal
    assert abs(z - 1) < 4 * np.sqrt(2 / runs)
    assert blind > 1 + 10 * np.sqrt(2 / runs)


@pytest.mark.parametrize("size", [0.0, 0.01])
def test_a_hint_states_the_size_of_everything_else(size):
    nominal = load_mechanism("h4")
    _, data = observed_boards(nominal, np.random.default_rng(1), size, TOLERANCE)
    session = SimpleNamespace(document={"board": {"file": "board.yaml"}})
    (information,) = size_notes(session, data, estimated(nominal, data))
    code = "board.size_disagrees" if size else "board.size_by_file"
    assert (information.code, information.subject) == (code, "board.yaml")
    assert information.facts["tolerance"] == pytest.approx(0.2)
    if size == 0:
        return
    value, sigma = information.facts["value"], information.facts["sigma"]
    # the file's own deviation is not in it: the estimate from all other data has its own error only
    assert sigma < TOLERANCE * 1.6
    assert abs(value - size) < 3 * sigma


@pytest.mark.parametrize("share", [0.999999, 1.0, 1.2])
def test_data_that_do_not_determine_the_size_give_no_number(share):
    """A standard deviation of the file's size: what else there is says nothing of it."""
    data = SimpleNamespace(mounts=(Mount("board", "platform", TOLERANCE),))
    estimate = SimpleNamespace(
        state=SimpleNamespace(columns={BOARD_SIZE: np.array([-0.4 * TOLERANCE])}),
        column_sigma=lambda _code: np.array([share * TOLERANCE]),
    )
    session = SimpleNamespace(document={"board": {"file": "board.yaml"}})
    (information,) = size_notes(session, data, estimate)
    assert information.code == "board.size_by_file"
    assert set(information.facts) == {"tolerance"}


def test_files_say_how_well_the_size_is_known():
    fields = {"type": "chessboard", "corners": [7, 6], "square": 0.03}

    def board(**more):
        return board_from_document(Document("board.yaml", "board.yaml", fields | more, {}))

    assert board().tolerance == PRINTED_SIZE_TOLERANCE
    assert board(tolerance=0).tolerance == 0
    assert board(tolerance=2e-4).document["tolerance"] == 2e-4
    with raises(InputError, where="board.yaml, tolerance", found="0.2"):
        board(tolerance=0.2)
