"""Makes the pictures of README and docs/ from a simulated session, with Chromium.

    python tools/pictures.py [names...] [--out docs/pictures] [--work build/pictures]

Without names, all of them. The sessions are kept in the work folder and made once. Figures that
the documentation quotes are printed.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Thread

import cv2
import numpy as np

import pkmcal
from pkmcal.arrays import Array
from pkmcal.identify.bundle import bundle
from pkmcal.identify.centres import Centres, free_of_gauge, joint_centres
from pkmcal.identify.start import start_state
from pkmcal.judge.against_truth import compare_with_truth
from pkmcal.measurements import Measurements
from pkmcal.outcome import Part
from pkmcal.outcome.blocks.images import Images
from pkmcal.outcome.blocks.plot import panels
from pkmcal.placement.default_camera import default_camera
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.planning.plan import plan_measurements as make_plan
from pkmcal.planning.subject import of_machine
from pkmcal.report import pictures
from pkmcal.report import residuals as residual_plots
from pkmcal.report.calibration import outcome_of as outcome_of_calibration
from pkmcal.report.calibration import save
from pkmcal.report.plan import outcome_of
from pkmcal.session.load import Session
from pkmcal.simulation import load_truth, simulate_session, true_machine
from pkmcal.simulation.demo import DEMO_MECHANISM, DEMO_SEED, DEMO_SETTINGS
from pkmcal.web.report_page import report_page
from pkmcal.web.serving import (
    LOOPBACK_ADDRESS,
    listening_socket,
    new_token,
    serve_until_interrupted,
)

sys.path.insert(0, str(Path(__file__).parent))
import diagrams
import guide
from case import Case, simulated

HERE = Path(__file__).resolve().parents[1]
LARGEST = 200_000
"""Largest size of a picture, bytes."""
REPEATS, EDGE_REPEATS = 12, 200
"""Number of simulated sessions with images, and with edges only."""


@dataclass(frozen=True)
class Shot:
    """Page for a screenshot: HTML and its size in pixels; or a session, in `pkmcal view`."""

    html: str
    width: int
    height: int
    session: Session | None = None


def whole_page(body: str, width: int, height: int, more_style: str = "") -> Shot:
    """A white page in the report's font."""
    style = (
        "html, body { margin: 0; background: #fff; overflow: hidden; }"
        "body { font: 16px/1.5 'Liberation Sans', Arial, sans-serif; color: #1a1e24; }"
    )
    html = f"<!doctype html><meta charset=utf-8><style>{style}{more_style}</style>{body}"
    return Shot(html, width, height)


def result(case: Case) -> Shot:
    """README's first picture: an image with fitted edges beside the geometry's change."""
    session, estimate = case.session, case.result.estimate
    centres = joint_centres(
        session.machine, estimate.machine, free_of_gauge(estimate.machine, estimate.covariance)
    )
    images = pictures.album(case.result, outward(case), centres).images
    chosen = next((one for one in images if one.title == "station2 / 0011"), images[0])
    report = outcome_of_calibration(case.result)
    (geometry,) = (part for part in report.parts if part.name == "geometry")
    image = Part("image", "", blocks=(Images(images=(chosen,), size="figure"),))
    html = guide.parts_page(
        image,
        geometry,
        style="main { display: grid; grid-template-columns: 640px 470px; gap: 22px; padding: 8px; }"
        " main h2, .bar, .hint, .images-bar, .space-block figcaption { display: none !important; }"
        " .space-block .space-stage { height: 480px; }",
    )
    return Shot(html, 1180, 542)


def outward(case: Case) -> Array:
    """Pixels by which each edge lies outward."""
    session, value = case.session, case.result
    edges, cameras = value.observation.edges, session.camera_of_station
    return residual_plots.outward_shift(edges, value.estimate, session.joints, cameras)


def report(case: Case) -> Shot:
    """The top of the report."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        save(case.result, out)
        html = (out / "report.html").read_text(encoding="utf-8")
    return Shot(html, 1180, 900)


def frames(case: Case) -> Shot:
    """The machine with its frames and cameras."""
    return whole_page(diagrams.frames(case.truth), 720, 415)


def edge_planes(_case: Case) -> Shot:
    """Across a leg: the two planes through its edges and the camera's centre."""
    return whole_page(diagrams.edge_planes(), 800, 300)


def measurement_passes(case: Case) -> Shot:
    """One image, and the edges predicted in it after each stage."""
    return whole_page(diagrams.measurement_passes(case), 1160, 360)


def profile(case: Case) -> Shot:
    """Two profiles across edges with their model, and the strongest gradient."""
    places = diagrams.measured_places(case)
    return whole_page(diagrams.two_profiles(places), 880, 330)


def positions(case: Case) -> Shot:
    """Errors of edge positions: by the model, and by the strongest gradient."""
    places = diagrams.measured_places(case)
    for name, values in (("model", places.model_error), ("gradient", places.gradient_error)):
        for tube in (0, 1):
            mine = values[places.tube == tube]
            print_line(
                f"position by {name}, tube {tube + 1}: median {np.median(mine):+.3f} px,"
                f" rms {np.sqrt(np.mean(mine**2)):.3f} px, n {mine.size}"
            )
    return whole_page(diagrams.position_errors(places), 880, 330)


def residuals(case: Case) -> Shot:
    """The report's histogram of the edges' residuals, and the boxes by leg."""
    edges, estimate = case.result.observation.edges, case.result.estimate
    plots = panels(
        residual_plots.histogram(estimate.edge_residuals),
        residual_plots.by_leg(case.session, edges, estimate),
    )
    html = guide.parts_page(Part("residuals", "", blocks=plots), style="main h2 { display: none; }")
    return Shot(html, 900, 310)


def repeats(case: Case) -> Shot:
    """Errors over standard deviations: repeated sessions with edges only, and with images."""
    edges = np.concatenate([_edge_scores(case, k) for k in range(EDGE_REPEATS)])
    groups: dict[str, list[Array]] = {}
    for k in range(REPEATS):
        for name, values in _image_scores(case, 100 + k).items():
            groups.setdefault(name, []).append(values)
    images = {name: np.concatenate(values) for name, values in groups.items()}
    print_line(f"edges only: error / sigma of centres {rms(edges):.2f}, n {edges.size}")
    for name, values in images.items():
        print_line(f"images: error / sigma of {name} {rms(values):.2f}, n {values.size}")
    return whole_page(diagrams.repeats(edges, images["centres"]), 880, 330)


def _edge_scores(case: Case, seed: int) -> Array:
    """Errors of joint centres over their standard deviations, edges with exactly known noise.

    Each session is of a machine of its own: what stays known by tolerance, such as its readings'
    scales, would otherwise be wrong by the same in all of them.
    """
    truth, rng = case.truth, np.random.default_rng(seed)
    nominal = case.session.machine
    machine = true_machine(nominal, DEMO_SETTINGS.tolerance, rng)
    edges, joints = simulate_edges(
        machine,
        truth.T_camera_base,
        default_camera(),
        truth.T_base_platform,
        EdgeNoise(),
        rng,
        images=truth.images,
    )
    cameras = np.zeros(len(truth.stations), dtype=int)
    measured = Measurements(edges, joints, 3e-6, len(cameras), cameras)
    start = start_state(nominal, measured, truth.T_camera_base)
    estimate = bundle(nominal, measured, start, use_prior=False, scale_noise=False)
    centres = joint_centres(
        machine, estimate.machine, free_of_gauge(estimate.machine, estimate.covariance)
    )
    return np.concatenate([normalised(body) for body in centres])


def _image_scores(case: Case, seed: int) -> dict[str, Array]:
    """Errors over standard deviations by kind of parameter, from rendered images."""
    folder = simulated(case.work / f"repeat{seed}", seed)
    estimate = pkmcal.calibrate(folder).estimate
    truth = load_truth(folder, case.session.machine)
    covariance = free_of_gauge(estimate.machine, estimate.covariance)
    centres = joint_centres(truth.machine, estimate.machine, covariance)
    error = estimate.machine.values - truth.machine.values
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    out = {"centres": np.concatenate([normalised(body) for body in centres])}
    for kind in ("offset", "radius"):
        at = estimate.machine.parameters.of_kind(kind)
        out[kind] = error[at] / sigma[at]
    return out


def normalised(body: Centres) -> Array:
    """Errors of a body's centres over their standard deviations, (3L,)."""
    variance = np.einsum("iaa->ia", body.blocks)
    return (body.change / np.sqrt(variance)).ravel()


def accuracy(case: Case) -> None:
    """Errors against the truth, as README quotes them, for 6 and 15 configurations a station."""
    for folder, count in ((case.folder, 6), (_larger(case.work / "larger", 15), 15)):
        value = pkmcal.calibrate(folder)
        print_line(f"{count} configurations a station, {sum(value.timings.values()):.1f} s")
        compared = compare_with_truth(value, folder)
        for what, e in (("drawing", compared.drawing), ("calibrated", compared.calibrated)):
            print_line(
                f"  {what}: centres {e.centre * 1e3:.3f} mm, offsets {e.offset * 1e3:.3f} mm,"
                f" platform {e.position * 1e3:.3f} mm, {np.rad2deg(e.orientation):.4f} degrees"
            )


def _larger(folder: Path, count: int) -> Path:
    if not folder.exists():
        machine = pkmcal.load_mechanism(DEMO_MECHANISM)
        settings = replace(DEMO_SETTINGS, configurations=count)
        simulate_session(folder, machine, default_camera(), settings, seed=DEMO_SEED)
    return folder


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def print_line(words: str) -> None:
    """A line for people."""
    sys.stdout.write(words + "\n")


def captured_page(shot: Shot, path: Path) -> None:
    """The page as a PNG file, small."""
    browser = next(
        filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
    )
    if browser is None:
        sys.exit("Chromium is needed: apt-get install chromium")
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "page.html", Path(folder) / "page.png"
        source.write_text(shot.html, encoding="utf-8")
        command = [browser, "--headless=new", "--no-sandbox", "--hide-scrollbars"]
        # plots in space need WebGL, and a moment
        command += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        command += ["--virtual-time-budget=8000"]
        command += [f"--window-size={shot.width},{shot.height}", f"--screenshot={target}"]
        address = source.as_uri() if shot.session is None else served(shot.session)
        subprocess.run([*command, address], check=True, capture_output=True, timeout=120)
        image = cv2.imread(str(target))
    # six bits a colour: sensor noise below them is not seen, and would double the file
    image = (image & 0xFC) | (image >> 6)
    cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    size = path.stat().st_size
    print_line(f"{path}: {shot.width}x{shot.height}, {size / 1e3:.0f} kB")
    if size > LARGEST:
        sys.exit(f"{path} is larger than {LARGEST / 1e3:.0f} kB")


def served(session: Session) -> str:
    """The address at which a session is to be viewed, until this program ends."""
    socket_, token = listening_socket(0), new_token()
    port = socket_.getsockname()[1]
    app = pkmcal.view(session.folder).application(token, port)
    Thread(target=serve_until_interrupted, args=(app, socket_), daemon=True).start()
    return f"http://{LOOPBACK_ADDRESS}:{port}/{token}/"


def plan(_case: Case) -> Shot:
    """Poses of three cameras round a hexapod from a plan: the page's plot in space."""
    machine = pkmcal.load_mechanism(DEMO_MECHANISM)
    subject = of_machine(machine, [default_camera()], machine.joint_names)
    outcome = outcome_of(make_plan(subject, free_stations=3))
    (where,) = (part for part in outcome.parts if part.name == "where")
    html = guide.parts_page(where, style="main h2 { display: none; }")
    return Shot(html, 1000, 690)


def view(case: Case) -> Shot:
    """An image of the session in `pkmcal view`, the nominal model at the rough pose."""
    return Shot("", 1180, 640, case.session)


def tutorial_images(case: Case) -> Shot:
    """An image from each place of the tutorial's session."""
    return whole_page(guide.images(case.work), 1180, 330)


def tutorial_check(case: Case) -> Shot:
    """The nominal model over one of them, at the rough and at the localized pose."""
    return Shot(guide.laid_over(guide.session(case.work)), 1000, 420)


def tutorial_report(case: Case) -> Shot:
    """The top of its report."""
    return Shot(guide.report(case.work), 1180, 900)


def tutorial_workspace(case: Case) -> Shot:
    """The tool over the workspace, before and after."""
    return Shot(guide.report_part(case.work, "workspace"), 1000, 770)


def tutorial_residuals(case: Case) -> Shot:
    """Residuals of the edges."""
    return Shot(guide.report_part(case.work, "residuals"), 1000, 750)


def tutorial_validation(case: Case) -> Shot:
    """The page of what was held out."""
    return Shot(guide.confirmed(case.work), 1000, 665)


def trouble_scale(case: Case) -> Shot:
    """The top of a refused report: one reading has another scale."""
    value = guide.calibrated(guide.wrong(case.work, "legs", "encoder's scale 1 %"))
    return Shot(report_page(outcome_of_calibration(value)), 1180, 345)


def trouble_columns(case: Case) -> Shot:
    """The nominal model over an image whose readings are in exchanged columns."""
    spoil = guide.two_columns_exchanged
    folder = guide.wrong(case.work, "legs", "two columns exchanged", spoil)
    return Shot(guide.laid_over(folder), 1000, 420)


def trouble_numbering(case: Case) -> Shot:
    """The same for legs in another numbering."""
    spoil = guide.numbered_from_another_leg
    folder = guide.wrong(case.work, "legs", "numbered from another leg", spoil)
    return Shot(guide.laid_over(folder), 1000, 420)


PICTURES: dict[str, Callable[[Case], Shot]] = {
    f.__name__.replace("_", "-"): f
    for f in (
        result,
        report,
        frames,
        edge_planes,
        measurement_passes,
        profile,
        positions,
        residuals,
        repeats,
        plan,
        view,
        tutorial_images,
        tutorial_check,
        tutorial_report,
        tutorial_workspace,
        tutorial_residuals,
        tutorial_validation,
        trouble_scale,
        trouble_columns,
        trouble_numbering,
    )
}


def main() -> None:
    """Make the requested pictures."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", help=f"{', '.join(PICTURES)} or accuracy; all if none")
    parser.add_argument("--out", type=Path, default=HERE / "docs" / "pictures")
    parser.add_argument("--work", type=Path, default=HERE / "build" / "pictures")
    args = parser.parse_args()
    case = Case(args.work)
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.names or [*PICTURES, "accuracy"]:
        if name == "accuracy":
            accuracy(case)
        else:
            captured_page(PICTURES[name](case), args.out / f"{name}.png")


if __name__ == "__main__":
    main()
