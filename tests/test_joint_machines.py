"""The joint estimate of every machine of the catalogue, with boards beside the legs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkmcal.cameras import camera_models
from pkmcal.geometry.rigid import perturb
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import bundle
from pkmcal.identify.gauge import default_gauge, in_gauge
from pkmcal.identify.start import start_state
from pkmcal.identify.state import State
from pkmcal.measurements import Measurements, Mount, PoseSet
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.simulation import Settings, draw_truth
from test_identify_residuals import check
from test_identify_scene import exact

NAMES = sorted(n for n in catalogue() if any(r.size for r in load_mechanism(n).radii()))
"""Machines whose legs a camera can see; cranks and sliders are in test_h4 and test_delta."""
JOINT_NOISE = 3e-6
POSE_SIGMA = np.array([2e-4, 2e-4, 2e-4, 1e-4, 1e-4, 1e-4])


def camera():
    return camera_models()["pinhole"](
        (1024, 768), np.array([889.0, 889, 511.5, 383.5, 0, 0, 0, 0, 0])
    )


class Session:
    """Measurements of a true machine without images; boards optionally."""

    def __init__(
        self, machine, seed=0, stations=2, configurations=8, boards=(), noise=1.0, settings=None
    ):
        settings = settings or Settings(
            stations=stations, configurations=configurations, joint_noise=JOINT_NOISE
        )
        eye = camera()
        self.nominal = machine
        self.truth = draw_truth(machine, (eye,) * stations, settings, seed)
        rng = np.random.default_rng(seed + 1000)
        edges, joints = simulate_edges(
            self.truth.machine,
            self.truth.T_camera_base,
            eye,
            self.truth.T_base_platform,
            EdgeNoise(shift=0.1 * noise, tilt=0.1 * noise),
            rng,
            images=self.truth.images,
            joint_noise=JOINT_NOISE * noise,
        )
        self.mounts = tuple(Mount(f"board {k}", body) for k, body in enumerate(boards))
        on_platform = np.array([b == "platform" for b in boards], dtype=bool)
        turn = rng.normal(size=(len(boards), 6)) * np.repeat([0.5, 0.1], 3)
        self.T_mount = perturb(np.broadcast_to(np.eye(4), (len(boards), 4, 4)), turn)
        self.measurements = Measurements(
            edges, joints, JOINT_NOISE, stations, np.zeros(stations, dtype=int),
            poses=self._poses(on_platform, noise, rng), mounts=self.mounts,
        )  # fmt: skip

    def _poses(self, on_platform, noise, rng):
        truth = self.truth
        rows = [(s, k, m) for s, k in truth.images for m in range(len(on_platform))]
        s, k, m = np.array(rows, dtype=int).reshape(-1, 3).T
        body = np.where(on_platform[m][:, None, None], truth.T_base_platform[k], np.eye(4))
        in_view = truth.T_camera_base[s] @ body @ self.T_mount[m]
        in_view = perturb(in_view, noise * POSE_SIGMA * rng.normal(size=(len(m), 6)))
        whiten = np.broadcast_to(np.diag(1 / POSE_SIGMA), (len(m), 6, 6))
        return PoseSet(s, k, m, in_view, whiten)

    def state(self):
        truth = self.truth
        return State(
            truth.machine.values,
            truth.T_camera_base,
            truth.T_base_platform,
            T_mount=self.T_mount,
            on_platform=self.measurements.on_platform,
        )

    def guess(self, rng, measurements=None):
        step = rng.normal(size=(len(self.truth.T_camera_base), 6)) * np.repeat([0.02, 0.01], 3)
        rough = perturb(self.truth.T_camera_base, step)
        return start_state(self.nominal, measurements or self.measurements, rough)


@pytest.mark.parametrize("name", NAMES)
def test_jacobian_with_boards(name):
    rng = np.random.default_rng(1)
    session = Session(load_mechanism(name), configurations=3, boards=("base", "platform"))
    assembled = assemble(session.nominal, session.measurements, default_gauge(session.nominal))
    state = batch_of(session.nominal, assembled, session.state())
    check(assembled.problem, state, rng)
    shifted = replace(
        state,
        T_base_platform=perturb(state.T_base_platform, 0.02 * rng.normal(size=(1, 6, 6))
                                @ session.nominal.layout.motion @ session.nominal.layout.motion.T),
        T_mount=perturb(state.T_mount, 0.3 * rng.normal(size=(1, 2, 6))),
    )  # fmt: skip
    check(assembled.problem, shifted, rng)


@pytest.mark.parametrize("name", NAMES)
def test_truth_is_found_without_noise(name):
    # for a platform that only translates, distances follow from readings and radii: the prior
    # decides
    machine = exact(name) if name == "3-upu" else load_mechanism(name)
    session = Session(machine, boards=("base",), noise=1e-4)
    fit = bundle(
        session.nominal,
        session.measurements,
        session.guess(np.random.default_rng(2)),
        robust=False,
        scale_noise=False,
    )
    truth = in_gauge(session.nominal, session.state(), default_gauge(session.nominal))
    error = fit.machine.values - session.nominal.parameters.unit_axes(truth.theta)
    sigma = np.sqrt(np.diag(fit.covariance))
    # micrometres where images leave tens of them; the prior biases what they do not determine
    assert np.all(np.abs(error) < 1e-5 + 4 * sigma)
    values = fit.data_share > 0.9
    assert values.sum() > 0.5 * len(error)
    assert np.median(np.abs(error[values])) < 3e-6


@pytest.mark.parametrize(
    "name",
    [name if name == "3-rps" else pytest.param(name, marks=pytest.mark.slow) for name in NAMES],
)
def test_errors_are_as_large_as_they_say(name):
    """The others by another simulation in test_catalogue.py."""
    squares, shares = [], []
    for seed in range(6):
        session = Session(load_mechanism(name), seed=seed)
        fit = bundle(
            session.nominal, session.measurements, session.guess(np.random.default_rng(seed))
        )
        truth = in_gauge(session.nominal, session.state(), default_gauge(session.nominal))
        table = session.nominal.parameters
        # an axis by its two turns: along itself it changes by squares of small angles only
        error = table.to_free(fit.machine.values) - table.to_free(truth.theta)
        by = np.linalg.pinv(table.free_matrix())
        sigma = np.sqrt(np.maximum(np.diag(by @ fit.covariance @ by.T), 0.0))
        free = sigma > 1e-9
        squares.append(np.mean((error[free] / sigma[free]) ** 2))
        shares.append(fit.statistics.chi2 / fit.statistics.dof)
    assert 0.6 < np.mean(squares) < 1.5, squares
    assert 0.8 < np.mean(shares) < 1.25, shares
