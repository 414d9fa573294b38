"""Errors that depend on the pose and are not in the model: detection, and accuracy.

    python benchmarks/pose_errors.py [--sessions 10] [--only WORDS] [--observer legs|poses] [--list]

Simulated sessions of a hexapod, each with its own machine and stations, without rendered images:
``legs`` by the edges of its legs (three stations, twelve configurations each, edges with the noise
and shading of fitted edges), ``poses`` by a tracker (thirty poses). Each error of ERRORS changes
readings, edges or poses by its physics. Reported for each: results that are refused, that carry a
warning, and that are accepted without one; accepted ones, with a warning or without, that are off
by more than three stated standard deviations; the error of the tool over the session's poses in
standard deviations, root mean square and median. "none" are right sessions.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml

from pkmcal.boards.views import Boards
from pkmcal.calibration.calibrate import calibrate_measurements
from pkmcal.calibration.camera_refinement import measurements_of, refinement_of
from pkmcal.errors import PkmcalError
from pkmcal.geometry.cylinders import contour_point, line_through, tangent_basis
from pkmcal.geometry.rigid import apply, dot, perturb, pose, rotation, rotation_vector
from pkmcal.identify.tool import tool_error
from pkmcal.measurements import OWN_SHADING, SHADING_SIGMA, Observation, concatenate
from pkmcal.mechanisms import load_mechanism, mechanism_text
from pkmcal.observe.predict import tubes_of
from pkmcal.outcome.finding import Level
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.placement.edges import (
    EDGE_TURN_POINTS,
    EdgeNoise,
    disturbed,
    moved_outward,
    visible_edges,
)
from pkmcal.placement.stations import one_a_station
from pkmcal.session.load import load_session
from pkmcal.simulation import Settings, with_forearms
from pkmcal.simulation.truth import draw_truth

FAR = 3.0
"""Stated standard deviations beyond which an error is not to be accepted."""
STATIONS, CONFIGURATIONS, POSES = 3, 12, 30
IMAGE_SIZE = (1280, 960)
EDGE_NOISE = EdgeNoise(0.06, 0.06)
TRACKER_NOISE = (5e-5, 2e-4)
"""m and rad."""
RADII_ALONG = 48


@dataclass
class Deformed:
    """Effect of an error on a true session of K configurations and L legs.

    readings : (K, m) added to the readings. base : (K, 4, 4) motion of the base against the
    stations. camera : (K, 6) motion of the first station, left perturbation. bend : (K, L, n, 3) m,
    displacement of the axis of each leg at n places from A to B, base frame. radius : (L, n) m.
    lens : by station, true intrinsics over the stated ones.
    """

    readings: np.ndarray
    base: np.ndarray
    camera: np.ndarray
    bend: np.ndarray
    radius: np.ndarray
    lens: dict[int, dict[str, float]] = field(default_factory=dict)


class Scene(NamedTuple):
    """A true session: machine, poses (K, 4, 4), readings q (K, m), legs' ends a, b (K, L, 3)."""

    machine: Any
    poses: np.ndarray
    q: np.ndarray
    a: np.ndarray
    b: np.ndarray

    @property
    def time(self) -> np.ndarray:
        """(K,) from 0 to 1."""
        return np.linspace(0, 1, len(self.q))

    @property
    def load(self) -> np.ndarray:
        """(K, L) force of each leg under the platform's weight, mean magnitude one."""
        u = line_through(self.a, self.b)[0]
        arm = np.cross(self.b - self.poses[:, None, :3, 3], u)
        rows = np.concatenate([u, arm], axis=-1).swapaxes(1, 2)
        force = np.linalg.solve(rows, np.tile([0, 0, 1.0, 0, 0, 0], (len(u), 1))[..., None])[..., 0]
        return force / np.mean(np.abs(force))


Error = Callable[[Scene, Deformed, np.random.Generator], None]


def lag(share: float) -> Error:
    """Readings that lag behind by a share of the last step."""

    def make(s: Scene, d: Deformed, _rng: np.random.Generator) -> None:
        d.readings -= share * np.diff(s.q, axis=0, prepend=s.q[:1])

    return make


def backlash(metres: float) -> Error:
    """Play of all motors, each up to twice as much."""

    def make(s: Scene, d: Deformed, rng: np.random.Generator) -> None:
        each = metres * rng.uniform(0, 2, s.q.shape[1])
        d.readings += each / 2 * np.sign(np.diff(s.q, axis=0, prepend=s.q[:1]))

    return make


def cyclic(metres: float, pitch: float) -> Error:
    """Screws whose lead varies once a turn."""

    def make(s: Scene, d: Deformed, rng: np.random.Generator) -> None:
        phase = rng.uniform(0, 2 * np.pi, s.q.shape[1])
        d.readings += metres * np.sin(2 * np.pi * s.q / pitch + phase)

    return make


def sag(metres: float) -> Error:
    """Legs that shorten under the platform's weight, more where they carry more."""

    def make(s: Scene, d: Deformed, _rng: np.random.Generator) -> None:
        d.readings += metres * (s.load - s.load.mean(axis=0))

    return make


def compliance(metres: float) -> Error:
    """Droop of commanded axes: the arm sinks with the square of its reach."""

    def make(s: Scene, d: Deformed, _rng: np.random.Generator) -> None:
        where = s.poses[:, :3, 3] - s.a.mean(axis=(0, 1))
        reach = np.sum(where[:, :2] ** 2, axis=1)
        commanded = s.poses.copy()
        commanded[:, 2, 3] += metres * reach / np.mean(reach)
        off = s.machine.inverse(commanded) - s.q
        d.readings += off - off.mean(axis=0)

    return make


def droop(metres: float) -> Error:
    """Legs that bend under their own weight, more where they lie flatter and are longer."""

    def make(s: Scene, d: Deformed, _rng: np.random.Generator) -> None:
        u = line_through(s.a, s.b)[0]
        down = np.array([0, 0, -1.0])
        across = down - dot(u, down)[..., None] * u
        length = s.q / s.q.mean()
        d.bend += (metres * length[..., None] ** 4 * across)[:, :, None] * _bow(d)[..., None]

    return make


def bow(metres: float) -> Error:
    """Legs that are bent for good, each its own way about its length."""

    def make(s: Scene, d: Deformed, rng: np.random.Generator) -> None:
        u = line_through(s.a, s.b)[0]
        side = np.cross(u, [0, 0, 1.0])
        side /= np.linalg.norm(side, axis=-1)[..., None]
        angle = rng.uniform(0, 2 * np.pi, s.q.shape[1])[:, None]
        direction = np.cos(angle) * side + np.sin(angle) * np.cross(u, side)
        d.bend += (metres * direction)[:, :, None] * _bow(d)[..., None]

    return make


def taper(metres: float) -> Error:
    """Legs that are thicker at one end, all equally."""

    def make(_s: Scene, d: Deformed, rng: np.random.Generator) -> None:
        d.radius += metres * (np.linspace(0, 1, d.radius.shape[1]) - 0.5) * rng.choice([-1, 1])

    return make


def warming(metres: float) -> Error:
    """Legs that grow with time, each up to twice as much."""

    def make(s: Scene, d: Deformed, rng: np.random.Generator) -> None:
        d.readings -= metres * rng.uniform(0, 2, s.q.shape[1]) * s.time[:, None]

    return make


def loose(metres: float) -> Error:
    """Joints with play, that lie as the legs' forces and chance have them."""

    def make(s: Scene, d: Deformed, rng: np.random.Generator) -> None:
        ends = metres * rng.standard_normal((2, *s.a.shape)) / np.sqrt(3)
        u = line_through(s.a, s.b)[0]
        ends[1] += metres * np.tanh(2 * (s.load - np.median(s.load)))[..., None] * u
        t = np.linspace(0, 1, d.bend.shape[2])[:, None]
        d.bend += ends[0][:, :, None] * (1 - t) + ends[1][:, :, None] * t
        d.readings += dot(u, ends[1] - ends[0])

    return make


def flex(radians: float) -> Error:
    """A base that tilts on its feet with where the platform's weight is."""

    def make(s: Scene, d: Deformed, _rng: np.random.Generator) -> None:
        where = s.poses[:, :2, 3] - s.poses[:, :2, 3].mean(axis=0)
        where /= np.sqrt(np.mean(np.sum(where**2, axis=1)))
        turn = radians * np.stack([-where[:, 1], where[:, 0], 0 * where[:, 0]], axis=-1)
        d.base = pose(rotation(turn), np.zeros(3))

    return make


def creeping(metres: float) -> Error:
    """A camera or tracker that sinks and turns slowly."""

    def make(s: Scene, d: Deformed, rng: np.random.Generator) -> None:
        direction = rng.standard_normal(6) * np.repeat([metres / 3, metres], 3)
        d.camera += s.time[:, None] * direction

    return make


def lens(stations: range, **factors: float) -> Error:
    """Stations whose true intrinsics are others than their file's, by factors."""

    def make(_s: Scene, d: Deformed, rng: np.random.Generator) -> None:
        sense = rng.choice([-1, 1])
        for k in stations:
            d.lens[k] = {name: 1 + sense * (x - 1) for name, x in factors.items()}

    return make


def _bow(d: Deformed) -> np.ndarray:
    t = np.linspace(0, 1, d.bend.shape[2])
    return 4 * t * (1 - t)


def nothing(_s: Scene, _d: Deformed, _rng: np.random.Generator) -> None:
    """A right session."""


ERRORS: dict[str, tuple[Error, tuple[str, ...]]] = {
    "none": (nothing, ("legs", "poses")),
    "readings lag by 2 %": (lag(0.02), ("legs", "poses")),
    "readings lag by .2 %": (lag(0.002), ("legs", "poses")),
    "backlash of .1 mm": (backlash(1e-4), ("legs", "poses")),
    "cyclic error of .05 mm": (cyclic(5e-5, 0.02), ("legs", "poses")),
    "platform sags by .2 mm": (sag(2e-4), ("legs", "poses")),
    "axes droop by .2 mm": (compliance(2e-4), ("legs", "poses")),
    "legs droop by .3 mm": (droop(3e-4), ("legs",)),
    "legs bent by 1 mm": (bow(1e-3), ("legs",)),
    "legs taper by .2 mm": (taper(2e-4), ("legs",)),
    "legs warm by .1 mm": (warming(1e-4), ("legs", "poses")),
    "joints loose by .05 mm": (loose(5e-5), ("legs", "poses")),
    "base tilts by .3 mrad": (flex(3e-4), ("legs", "poses")),
    "station creeps by .3 mm": (creeping(3e-4), ("legs", "poses")),
}
"""Errors that depend on the pose, or on time, and who observes them."""
LENSES: dict[str, tuple[Error, tuple[str, ...]]] = {
    "pixel aspect .3 %": (lens(range(STATIONS), fx=1.0015, fy=0.9985), ("legs",)),
    "focal .3 % at one station": (lens(range(1), fx=1.003, fy=1.003), ("legs",)),
    "centre .5 % at one station": (lens(range(1), cx=1.005), ("legs",)),
}
"""Lenses that differ from their files."""
ERRORS |= LENSES


class Made(NamedTuple):
    """A session as measured: what estimates need, and the truth."""

    session: Any
    observation: Observation
    measurements: Any
    cameras: Any
    scene: Scene
    T_camera_base: np.ndarray


def truth_of(observer: str, seed: int) -> tuple[Any, Any, Any]:
    """Nominal model, truth and camera."""
    nominal = with_forearms(load_mechanism("gough-stewart"))
    camera = camera_of_size(IMAGE_SIZE)
    count = CONFIGURATIONS if observer == "legs" else POSES
    settings = Settings(stations=STATIONS if observer == "legs" else 1, configurations=count)
    cameras = one_a_station(camera, settings.n_stations)
    return nominal, draw_truth(nominal, cameras, settings, seed), camera


def made(error: str, observer: str, seed: int, folder: Path) -> Made:
    """The session, written into a folder."""
    nominal, truth, camera = truth_of(observer, seed)
    rng = np.random.default_rng([seed, 51])
    q, poses = truth.joints, truth.T_base_platform
    ends = truth.machine.ends_at(q, poses)
    scene = Scene(truth.machine, poses, q, ends.a, ends.b)
    K, L = ends.a.shape[:2]
    still = np.tile(np.eye(4), (K, 1, 1))
    d = Deformed(np.zeros(q.shape), still, np.zeros((K, 6)), np.zeros((K, L, RADII_ALONG, 3)),
                 np.zeros((L, RADII_ALONG)))  # fmt: skip
    ERRORS[error][0](scene, d, rng)
    write_texts(folder, nominal, truth, camera, truth.readings + d.readings, observer)
    if observer == "poses":
        write_poses(folder, scene, d, truth.T_camera_base[0], rng)
        session = load_session(folder)
        return Made(session, None, None, None, scene, truth.T_camera_base)
    session = load_session(folder)
    sets, points = [], []
    for s in range(len(truth.T_camera_base)):
        rows = truth.images[truth.images[:, 0] == s, 1]
        T = truth.T_camera_base[s] @ d.base[rows]
        if s == 0:
            T = perturb(T, d.camera[rows])
        factors = [d.lens.get(s, {}).get(name, 1.0) for name in ("fx", "fy", "cx", "cy")]
        rest = np.ones(len(camera.parameters) - 4)
        true = replace(camera, parameters=camera.parameters * np.append(factors, rest))
        edges, pixels = edges_of(camera, true, scene, d, T, rows, rng)
        sets.append(replace(edges, station=np.full(len(edges), s)))
        points.append(pixels)
    edges, points = concatenate(sets), np.concatenate(points)
    at = np.repeat(np.arange(len(edges)), points.shape[1])
    observation = Observation(edges, (), points.reshape(-1, 2), at, truth.T_camera_base)
    cameras = refinement_of(session, False)
    measurements = measurements_of(session, Boards(), edges, cameras)
    return Made(session, observation, measurements, cameras, scene, truth.T_camera_base)


def edges_of(
    camera: Any, true: Any, scene: Scene, d: Deformed, T: np.ndarray, rows: np.ndarray, rng: Any
) -> tuple[Any, np.ndarray]:
    """Edges in the images of one station, and (N, n, 2) pixels along each.

    true : the camera that took them, for which the session states another.
    """
    tubes = tubes_of(scene.machine)
    radius = scene.machine.values[tubes.radius]
    a, b = apply(T[:, None], scene.a[rows]), apply(T[:, None], scene.b[rows])
    exact, _ = visible_edges(camera, tubes, radius, a, b)
    e, k = exact, exact.configuration
    start, end = a[k, e.leg], b[k, e.leg]
    u = line_through(start, end)[0]
    length = np.sqrt(dot(end - start, end - start))
    along = e.span[:, :1] + (e.span[:, 1:] - e.span[:, :1]) * np.linspace(0, 1, EDGE_TURN_POINTS)
    by_tube = {(leg, tube): r for leg, tube, r in zip(tubes.leg, tubes.tube, radius, strict=True)}
    r = np.array([by_tube[pair] for pair in zip(e.leg, e.tube, strict=True)])
    p = contour_point(start[:, None], u[:, None], e.normal[:, None], r[:, None], along)
    t = np.clip(along / length[:, None], 0, 1) * (RADII_ALONG - 1)
    low = np.minimum(t.astype(int), RADII_ALONG - 2)
    part = (t - low)[..., None]

    def of(values: np.ndarray) -> np.ndarray:
        """(N, n, c) of values (N, RADII_ALONG, c)."""
        each = np.arange(len(values))[:, None]
        return values[each, low] * (1 - part) + values[each, low + 1] * part

    bend = np.einsum("kij,knj->kni", T[k, :3, :3], of(d.bend[rows[k], e.leg]))
    thick = of(d.radius[e.leg][..., None])
    rays = camera.ray(true.project(p + bend + thick * e.normal[:, None]))
    turned = np.einsum("nki,nij->nkj", rays, e.basis)
    off = np.einsum("nki,ni->nk", rays, e.normal)
    turn = np.stack(
        [-np.linalg.lstsq(A, y, rcond=None)[0] for A, y in zip(turned, off, strict=True)]
    )
    normal = e.normal + np.einsum("nij,nj->ni", e.basis, turn)
    normal /= np.linalg.norm(normal, axis=-1)[:, None]
    by_shift, by_tilt = moved_outward(camera, normal, e.basis, rays)
    line = np.unique(np.stack([e.leg, e.tube, e.side], axis=1), axis=0, return_inverse=True)[
        1
    ].ravel()
    shade = SHADING_SIGMA * rng.standard_normal(line.max() + 1)[line]
    shade += OWN_SHADING * rng.standard_normal(len(line))
    normal = normal + np.einsum("nij,nj->ni", e.basis, by_shift * shade[:, None])
    normal = disturbed(normal, e.basis, by_shift, by_tilt, EDGE_NOISE, rng)
    parts = np.stack([by_shift * EDGE_NOISE.shift, by_tilt * EDGE_NOISE.tilt], axis=-1)
    edges = replace(
        e, configuration=rows[k], normal=normal,
        basis=tangent_basis(normal, rays[:, EDGE_TURN_POINTS // 2]),
        covariance=parts @ parts.mT, shift=by_shift,
    )  # fmt: skip
    # in the new basis the same up to a turn by the tilt's square
    return edges, camera.project(rays)


def write_texts(
    folder: Path, nominal: Any, truth: Any, camera: Any, readings: Any, observer: str
) -> None:
    """Files of a session; of images there are blank ones, which nothing reads."""
    (folder / "mechanism.yaml").write_text(mechanism_text(nominal))
    rows = [["configuration", *nominal.joint_names]]
    rows += [
        [n, *map(repr, v)] for n, v in zip(truth.configurations, readings.tolist(), strict=True)
    ]
    with (folder / "joints.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    stations: dict[str, Any] = {}
    if observer == "poses":
        noise = dict(zip(("position", "rotation"), TRACKER_NOISE, strict=True))
        stations["tracker"] = {"tracker": {"poses": "poses.csv", "noise": noise}}
    else:
        (folder / "camera.yaml").write_text(yaml.safe_dump(camera.document()))
        blank = cv2.imencode(".png", np.zeros(IMAGE_SIZE[::-1], dtype=np.uint8))[1].tobytes()
        for s, name in enumerate(truth.stations):
            rough = truth.rough[s]
            stations[name] = {
                "camera": "camera.yaml", "images": f"images/{name}/{{configuration}}.png",
                "observe": "legs",
                "pose": {
                    key: [float(x) for x in getattr(rough, key)]
                    for key in ("position", "look_at", "up")
                },
            }  # fmt: skip
            (folder / "images" / name).mkdir(parents=True)
            for k in truth.images[truth.images[:, 0] == s, 1].tolist():
                (folder / "images" / name / f"{truth.configurations[k]}.png").write_bytes(blank)
    document = {"pkmcal": 1, "mechanism": "mechanism.yaml",
                "joints": {"file": "joints.csv", "noise": 3e-6}, "stations": stations}  # fmt: skip
    (folder / "session.yaml").write_text(yaml.safe_dump(document, sort_keys=False))


def write_poses(folder: Path, scene: Scene, d: Deformed, T: np.ndarray, rng: Any) -> None:
    """The tracker's table."""
    target = pose(rotation(np.array([0.3, 0.2, 0.4])), np.array([0.03, 0.02, -0.04]))
    in_view = perturb(T @ d.base @ scene.poses @ target, d.camera)
    noise = np.repeat(TRACKER_NOISE[::-1], 3) * rng.standard_normal((len(in_view), 6))
    # noise of the target about itself, not about the tracker
    middle = in_view[:, :3, 3].copy()
    in_view = perturb(in_view, noise)
    in_view[:, :3, 3] = middle + noise[:, 3:]
    turn = rotation_vector(in_view[:, :3, :3])
    rows = [["configuration", "x", "y", "z", "rx", "ry", "rz"]]
    for k, (x, r) in enumerate(zip(in_view[:, :3, 3].tolist(), turn.tolist(), strict=True)):
        rows.append([f"{k:04d}", *map(repr, x), *map(repr, r)])
    with (folder / "poses.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)


class Outcome(NamedTuple):
    """Result of a session.

    what : refused, warned or silent. z : error of the tool in standard deviations, root mean square
    over the poses. sigma : m, that standard deviation. findings : sentences.
    """

    what: str
    z: float
    sigma: float
    findings: tuple[str, ...]


def calibrated(one: Made, folder: Path) -> Any:
    """The calibration."""
    from pkmcal import calibrate

    if one.measurements is None:
        return calibrate(folder)
    return calibrate_measurements(one.session, one.observation, one.measurements, one.T_camera_base)


def judged(result: Any, scene: Scene) -> Outcome:
    """Against the truth."""
    error = result.tool_error(scene.poses)
    off = tool_error(
        scene.machine, result.machine, error.parameters, scene.poses, scene.q,
        legs_observed=result.estimate.edge_weights.size > 0,
    )  # fmt: skip
    sigma = float(np.sqrt(np.nanmean(error.position**2)))
    z = float(np.sqrt(np.nanmean(off.off_position**2))) / sigma
    v = result.verdict
    text = tuple(f"{one.code}: {one.text}" for one in v.findings if one.level is not Level.NOTE)
    what = "refused" if not v.usable else "warned" if v.warnings else "silent"
    return Outcome(what, z, sigma, text)


def outcome(error: str, observer: str, seed: int) -> Outcome:
    """One session."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        one = made(error, observer, seed, folder)
        try:
            return judged(calibrated(one, folder), one.scene)
        except PkmcalError as problem:
            text = f"{problem.code}: {problem}"
            return Outcome("refused", float("nan"), float("nan"), (text,))


def main() -> None:
    """A line for each error."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sessions", type=int, default=10, help="of each error and observer")
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    parser.add_argument("--only", nargs="*", help="errors whose names have one of these words")
    parser.add_argument("--observer", choices=["legs", "poses"], help="these sessions alone")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--list", action="store_true", help="each session, with what is reported")
    options = parser.parse_args()
    begin = time.perf_counter()
    seeds = range(options.first, options.first + options.sessions)
    far = 0
    with ProcessPoolExecutor(options.workers) as pool:
        titles = ("refused", "warned", "silent", "warned > 3", "silent > 3", "median z", "worst z")
        print(f"{'':36}" + "".join(f"{title:>11}" for title in (*titles, "sigma mm")))
        for error, (_, observers) in ERRORS.items():
            if options.only and not any(word in error for word in options.only):
                continue
            for observer in observers:
                if options.observer not in (None, observer):
                    continue
                value = list(
                    pool.map(outcome, *zip(*[(error, observer, k) for k in seeds], strict=True))
                )
                count = [sum(x.what == w for x in value) for w in ("refused", "warned", "silent")]
                beyond = [
                    sum(x.what == w and x.z > FAR for x in value) for w in ("warned", "silent")
                ]
                far += beyond[1]
                z = np.array([x.z for x in value if x.what != "refused"])
                middle, worst = (np.median(z), z.max()) if z.size else (np.nan, np.nan)
                sigma = np.nanmedian([x.sigma for x in value] + [np.nan]) * 1e3
                numbers = "".join(f"{k:11}" for k in (*count, *beyond))
                print(f"{error + ', ' + observer:36}{numbers}{middle:11.2f}{worst:11.2f}"
                      f"{sigma:11.4f}", flush=True)  # fmt: skip
                if options.list:
                    for k, x in zip(seeds, value, strict=True):
                        text = " | ".join(x.findings)[:400]
                        print(f"    {k}: {x.what} {x.z:.2f} {x.sigma * 1e3:.4f} {text}")
    print(f"silent beyond {FAR:g}: {far}; {time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    main()
