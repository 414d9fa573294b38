"""Attainable accuracy of a session's edges: the tool's error with random signs of the edge errors.

    OPENBLAS_NUM_THREADS=1 python benchmarks/allowed.py FOLDER [FOLDER ...] [--draws 16]

FOLDER is a session with its truth.json, as for `benchmarks/scenes.py`. It is calibrated without its
truth; then every measured edge is compared with its true place. The tool error of one session is a
single draw: by chance it may be small although the edges are bad. So the errors of each line (one
side of one tube at one station) are multiplied by a random sign, all together so that their
correlation remains, and the joint estimate is repeated; also with half the errors. The root mean
square over the draws is the accuracy that any method of calibration can expect of edges as good as
these, and of edges twice as good.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scenes import TRUTH, TrueMachine, errors_of, numbers_of, parts_of, read_truth, rms


def true_normals(edges: Any, truth: TrueMachine, radius: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Normals (n, 3) of the edges as the true machine has them.

    radius : (n,) of their tubes, m. row : (n,) of T_base_platform.
    """
    from pkmcal.geometry.cylinders import edge_normal_jacobians

    T, pose = truth.T_camera_base[edges.station], truth.T_base_platform[row]
    ends = truth.a[edges.leg], (pose @ np.pad(truth.b, ((0, 0), (0, 1)), constant_values=1.0)[
        edges.leg][..., None])[:, :3, 0]  # fmt: skip
    a, b = ((T[:, :3, :3] @ end[..., None])[..., 0] + T[:, :3, 3] for end in ends)
    return edge_normal_jacobians(a, b, radius, edges.side).n


def true_radii(folder: Path, nominal: Any, edges: Any) -> np.ndarray:
    """Radii (n,) m of the edges' tubes."""
    data = json.loads((folder / TRUTH).read_text())
    if "tube_radius" in data:
        return np.where(edges.tube == 0, data["tube_radius"], data["rod_radius"])
    from pkmcal.simulation.truth import load_truth

    return load_truth(folder, nominal).machine.radii_of(edges.leg, edges.tube)


def edges_at(edges: Any, normal: np.ndarray, turn: np.ndarray) -> Any:
    """Edges with normals (n, 3), rotated by ``turn`` (n, 2) in their bases."""
    normal = normal + (edges.basis @ turn[..., None])[..., 0]
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    basis = edges.basis - normal[..., None] * (normal[:, None] @ edges.basis)
    basis = basis / np.linalg.norm(basis, axis=1, keepdims=True)
    return replace(edges, normal=normal, basis=basis)


def tool_error(calibration: Any, estimate: Any, truth: TrueMachine) -> float:
    """The tool's error, m, of an estimate from the calibration's session."""
    numbers = numbers_of(calibration.machine)
    covariance = estimate.covariance[np.ix_(numbers, numbers)]
    return errors_of(*parts_of(estimate.machine.values[numbers]), covariance, truth).tool


def allowed(folder: Path, draws: int, seed: int) -> tuple[float, ...]:
    """Tool errors, mm: as calibrated, and over draws with whole errors and with half of them."""
    from pkmcal.calibration import calibrate
    from pkmcal.identify.bundle import bundle
    from pkmcal.measurements.effects import lines

    with tempfile.TemporaryDirectory() as temporary:
        copy = Path(temporary) / folder.name
        shutil.copytree(folder, copy, ignore=shutil.ignore_patterns(TRUTH))
        calibration = calibrate.calibrate_session(copy, seed=seed)
    session, measurements, estimate = (
        calibration.session,
        calibration.measurements,
        calibration.estimate,
    )
    truth = read_truth(folder, session.machine)
    if isinstance(truth, str):
        raise SystemExit(f"{folder.name}: {truth}")
    edges = measurements.edges
    # the truth lists images station by station, as the session does
    images = [(k, p.configuration) for k, s in enumerate(session.stations)
                   for p in s.images]  # fmt: skip
    number = {key: row for row, key in enumerate(images)}
    row = np.array([number[key] for key in zip(edges.station, edges.configuration, strict=True)])
    normal = true_normals(edges, truth, true_radii(folder, session.machine, edges), row)
    turn = (edges.basis.mT @ (edges.normal - normal)[..., None])[..., 0]
    line = lines(measurements)[1]
    rng = np.random.default_rng(seed)
    out = [tool_error(calibration, estimate, truth)]
    for share in (1.0, 0.5):
        errors = []
        for _ in range(draws):
            sign = rng.choice([-1.0, 1.0], size=line.max() + 1)[line]
            shifted = edges_at(edges, normal, share * sign[:, None] * turn)
            again = bundle(session.machine, replace(measurements, edges=shifted), estimate.state)
            errors.append(tool_error(calibration, again, truth))
        out.append(rms(np.array(errors)))
    return tuple(1e3 * error for error in out)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("--draws", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(f"{'tool, mm':24} calibrated  other signs  half the errors")
    for folder in options.folders:
        value = allowed(folder.resolve(), options.draws, options.seed)
        print(f"{folder.name:24} {value[0]:10.3f} {value[1]:12.3f} {value[2]:16.3f}", flush=True)


if __name__ == "__main__":
    main()
