"""pkmcal export: every format with every machine, refusals, and written files."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import yaml

from conftest import run
from document_keys import assert_keys
from export_sources import CAMERA, built, calibration, source_of
from faults import raises
from pkmcal.calibration.machine_source import load_source
from pkmcal.cameras import camera_models, load_camera
from pkmcal.errors import InputError, ResultError
from pkmcal.exporters import ros
from pkmcal.exporters.contract import Difference, exporters, make_export
from pkmcal.exporters.samples import samples
from pkmcal.geometry.rigid import apply, pose, rotation
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.mechanisms.carriers.contract import Winding, base_carriers, platform_carriers

OURS = ("c", "json", "klipper", "linuxcnc", "marlin", "repetier", "reprap", "ros", "smoothie",
        "yaml")  # fmt: skip
ELSEWHERE = ("hangprinter", "mujoco", "sdf", "urdf")
"""Formats of test_hangprinter.py, test_export_mujoco.py and test_export_trees.py."""
MACHINES = sorted(catalogue())
DELTAS = ("delta", "linear-delta")
HEXAPODS = ("gough-stewart", "6-spu-passive")
EXPRESSED = {
    "c": tuple(name for name in MACHINES if name != "four-belt"),
    "json": MACHINES,
    "yaml": MACHINES,
    "reprap": DELTAS,
    "klipper": DELTAS,
    "marlin": ("linear-delta",),
    "repetier": (),
    "smoothie": ("linear-delta",),
    "linuxcnc": (*DELTAS, *HEXAPODS, "3-rpr", "6-rus", "h4", "hexaglide"),
    "ros": (),
}
REFUSALS = {
    "c": {"export.not_determined"},
    "reprap": {"export.no_delta"},
    "marlin": {"export.no_delta", "export.no_linear_delta"},
    "repetier": {"export.no_delta", "export.no_linear_delta", "export.no_steps"},
    "smoothie": {"export.no_delta", "export.no_linear_delta"},
    "klipper": {"export.no_delta"},
    "linuxcnc": {"export.joints_not_coordinates"},
    "ros": {"export.no_cameras"},
}


def test_every_format_of_the_folder_is_found():
    # a new format is read back here, or by tests of its own
    assert {*OURS, *ELSEWHERE} == set(exporters())
    assert all(name == exporter.name for name, exporter in exporters().items())


@pytest.mark.parametrize("name", OURS)
def test_a_format_expresses_a_machine_or_states_that_it_does_not(name):
    refusals = set()
    for machine in MACHINES:
        source = source_of(load_mechanism(machine))
        if machine not in EXPRESSED[name]:
            with pytest.raises(InputError) as caught:
                make_export(source, name)
            refusals.add(caught.value.code)
            continue
        made = make_export(source, name)
        assert made.differences
        assert not any(d.beyond for d in made.differences)
        for text in made.files.values():
            assert machine in text
            assert "Nominal model only, not calibrated." in text
    assert refusals == REFUSALS.get(name, set())


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("c", "0, /* length */", "REAL(0.00001), /* length */"),
        ("c", "{{REAL(0.9", "{{REAL(0.8"),
        ("json", '"value": 0.2693,', '"value": 0.2694,'),
        ("yaml", "center: [0.2693", "center: [0.26930001"),
        ("linuxcnc", "base.3.y 243.", "base.3.y 244."),
        ("linuxcnc", "HOME_OFFSET = 0\n", "HOME_OFFSET = 0.001\n"),
    ],
)
def test_what_reads_back_otherwise_is_not_written(name, old, new, monkeypatch, tmp_path):
    exporter = exporters()[name]
    files = exporter.files(source_of(load_mechanism("gough-stewart")))
    spoilt = {key: text.replace(old, new, 1) for key, text in files.items()}
    assert spoilt != files
    monkeypatch.setattr(type(exporter), "files", lambda self, source: spoilt)
    done = run("export", "gough-stewart", "--to", name, "-o", tmp_path / "out", "--json")
    assert (done.code, done.json["code"]) == (1, "export.reads_otherwise")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", sorted(exporters()))
def test_numbers_have_the_fewest_digits_that_read_back(name, tmp_path):
    """269.3, not 269.30000000000001, which is the same number to every reader."""
    source = load_source(calibration(tmp_path, built("linear-delta")))
    hexapod = source_of(load_mechanism("gough-stewart"))
    for one in (source, hexapod):
        try:
            files = exporters()[name].files(one)
        except InputError:  # another machine's format
            continue
        for text in files.values():
            for word in re.findall(r"(?<![\w.])-?\d+\.\d{12,}(?:e[-+]?\d+)?", text):
                assert len(word) <= len(repr(float(word))), word


def test_a_difference_that_is_no_number_is_beyond():
    assert Difference("x", float("nan"), 1.0).beyond
    assert Difference("x", float("inf"), 1.0).beyond
    assert not Difference("x", 1.0, 1.0).beyond


def test_samples_need_poses_within_the_ranges():
    machine = load_mechanism("linear-delta")
    values = machine.values.copy()
    names = machine.parameters.names
    values[[k for k, n in enumerate(names) if n.endswith("length.constant")]] = 0.01
    with raises(ResultError, code="export.no_workspace"):
        samples(machine.with_values(values))


def test_samples_of_a_machine_without_ranges(tmp_path):
    text = catalogue()["gough-stewart"].read_text().replace(", range: [0.345, 0.485]", "")
    (tmp_path / "m.yaml").write_text(text + "home: {position: [0, 0, 0.36]}\n")
    machine = load_mechanism(tmp_path / "m.yaml")
    poses, joints = samples(machine)
    assert len(poses) > 30
    np.testing.assert_allclose(machine.inverse(poses), joints, atol=1e-12)
    made = make_export(source_of(machine), "c")
    assert "-INFINITY" in made.files["pkmcal_kinematics.c"]
    assert (
        "MIN_LIMIT"
        not in make_export(source_of(machine), "linuxcnc").files["pkmcal_kinematics.ini"]
    )


# Carriers as elementary joints


def each(carriers):
    return sorted(set(carriers.values()), key=lambda carrier: carrier.__name__)


def swung(chain, angle):
    """The arms (n, 3) turned by angles (n,)."""
    return (rotation(angle[:, None] * chain.axis) @ chain.arm[..., None])[..., 0]


@pytest.mark.parametrize("carrier", each(base_carriers()), ids=lambda c: c.__name__)
def test_every_base_carriers_chain_is_its_place(carrier):
    rng = np.random.default_rng(0)
    parameters, q = rng.normal(size=(20, len(carrier.parameters))), rng.normal(size=20)
    chain = carrier.chain(parameters)
    if issubclass(carrier, Winding):  # no elementary joint holds a cable on its pulley
        assert chain is None
        return
    shifted = {
        "fixed": lambda: chain.arm,
        "slide": lambda: chain.arm + q[:, None] * chain.axis,
        "turn": lambda: swung(chain, q),
    }
    values = chain.point + shifted[chain.motion]()
    np.testing.assert_allclose(values, carrier.place(parameters, q)[0], atol=1e-14)
    assert carrier.driven == (chain.motion != "fixed")


@pytest.mark.parametrize("carrier", each(platform_carriers()), ids=lambda c: c.__name__)
def test_every_platform_carriers_chain_is_its_place(carrier):
    rng = np.random.default_rng(1)
    parameters, phi = rng.normal(size=(20, len(carrier.parameters))), rng.normal(size=20)
    T = pose(rotation(rng.normal(size=(20, 3))), rng.normal(size=(20, 3)))
    chain = carrier.chain(parameters)
    still = np.zeros((20, 3))
    own = {"fixed": chain.arm, "turn": swung(chain, phi), "float": still}[chain.motion]
    values = apply(T, chain.point + own) + (chain.arm if chain.motion == "float" else still)
    np.testing.assert_allclose(values, carrier.place(parameters, T, phi)[0], atol=1e-14)


# What a calibration gives


def test_calibrated_values_are_exported(tmp_path):
    machine = built("gough-stewart")
    folder = calibration(tmp_path, machine)
    source = load_source(folder)
    np.testing.assert_array_equal(source.machine.values, machine.values)
    text = make_export(source, "yaml").files["mechanism.yaml"]
    value = yaml.safe_load(text)["legs"][3]["base"]["center"]
    k = machine.parameters.index("legs[4].base.center.x")
    assert value == machine.values[k : k + 3].tolist()
    sigma = source.sigma_of("legs[4].base.center.x")
    assert f"{sigma:.3g}" in text
    assert "Calibrated: well." in text
    assert "three centres: legs 1, 3, 5" in text
    document = json.loads(make_export(source, "json").files["machine.json"])
    np.testing.assert_array_equal(document["covariance"], source.covariance)
    assert document["parameters"][k]["sigma"] == sigma
    assert document["calibrated"]
    assert set(document["T_base_camera"]) == {"front", "left side"}


def test_a_calibrations_own_mechanism_file_is_the_calibration(tmp_path):
    folder = calibration(tmp_path, built("gough-stewart"))
    assert load_source(folder / "mechanism.yaml").calibrated
    assert load_source(folder / "calibration.json").calibrated
    other = tmp_path / "mechanism.yaml"
    other.write_text((folder / "mechanism.yaml").read_text())
    assert not load_source(other).calibrated


def test_a_demonstration_is_exported(demo, tmp_path):
    calibrated = json.loads((demo.calibration / "calibration.json").read_text())
    value = {p["name"]: p["value"] for p in calibrated["parameters"]}
    for name in ("c", "linuxcnc", "ros"):
        done = run("export", demo.calibration, "--to", name, "-o", tmp_path / name)
        assert done.code == 0, done.err
    assert len(list((tmp_path / "ros").iterdir())) == 4
    hal = (tmp_path / "linuxcnc" / "pkmcal_kinematics.hal").read_text()
    assert f"base.3.x {1e3 * value['legs[4].base.center.x']!r}\n" in hal
    # what the frames hold is zero, in every file
    texts = [hal, (demo.calibration / "mechanism.yaml").read_text()]
    assert "platform.0.z 0\n" in hal
    assert not re.findall(r"\S*\de-(?:1[3-9]|[2-9]\d)", "\n".join(texts))
    source = (tmp_path / "c" / "pkmcal_kinematics.c").read_text()
    assert repr(value["legs[4].base.center.x"]) in source


# The command


def test_the_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = calibration(tmp_path, built("gough-stewart"))
    done = run("export", folder, "--to", "yaml")
    assert done.code == 0
    assert "Calibrated: well." in done.out
    assert (folder.parent / "export-yaml" / "mechanism.yaml").is_file()
    done = run("export", "h4", "--to", "json", "--json")
    assert done.code == 0
    assert done.json["machine"] == "h4"
    assert_keys("export --json", done.json)
    assert not done.json["calibrated"]
    assert (tmp_path / "export-json" / "machine.json").is_file()
    assert all(d["largest"] <= d["limit"] for d in done.json["differences"])
    # again, over the earlier export
    assert run("export", "delta", "--to", "json").code == 0


@pytest.mark.parametrize(
    ("words", "field", "value"),
    [
        (("h4", "--to", "stl"), "expected", "c, "),
        (("h4", "--to", "jsn"), "expected", "json, or another of c, "),
        (("h5", "--to", "c"), "code", "machine.unknown"),
        (("h4",), "what", "Missing option '--to'"),
        ((".", "--to", "c"), "code", "calibration.missing"),
        (("nothing.yaml", "--to", "c"), "code", "file.missing"),
    ],
)
def test_wrong_words(words, field, value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = run("export", *words, "--json")
    assert done.code == 2
    assert done.json[field].startswith(value)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_other_files_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("all")
    done = run("export", "h4", "--to", "c", "-o", tmp_path, "--json")
    assert (done.code, done.json["code"]) == (2, "output.foreign_files")
    assert done.json["found"] == "thesis.tex"
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_refused_calibration_is_refused(tmp_path):
    folder = calibration(tmp_path, built("gough-stewart"), usable=False)
    out = tmp_path / "out"
    done = run("export", folder, "--to", "c", "-o", out, "--json")
    assert (done.code, done.json["exit_code"]) == (1, 1)
    assert done.json["code"] == "calibration.refused"
    assert "The rods cannot be told apart." in done.json["what"]
    assert not out.exists()
    done = run("export", folder, "--to", "c", "-o", out, "--force")
    assert done.code == 0
    for path in out.iterdir():
        assert "REFUSED, NOT TO BE USED: This calibration should not" in path.read_text()


def test_the_session_must_be_one(tmp_path):
    folder = calibration(tmp_path, built("gough-stewart"))
    done = run("export", folder, "--to", "ros", "--session", tmp_path, "-o", tmp_path / "out",
               "--json")  # fmt: skip
    assert (done.code, done.json["code"]) == (2, "session.missing")


# ROS


def test_ros_gets_cameras_and_where_they_stand(tmp_path):
    source = load_source(calibration(tmp_path, built("gough-stewart")))
    made = make_export(source, "ros")
    assert set(made.files) == {
        "static_transforms.launch.yaml",
        "camera_info_front.yaml",
        "camera_info_left_side.yaml",
    }
    values = ros.transforms(made.files["static_transforms.launch.yaml"])
    np.testing.assert_allclose(values["front"], source.T_base_camera["front"], atol=1e-14)
    # its z axis, forward, points from the camera to the base's origin
    forward = -values["left_side"][:3, 3] / np.linalg.norm(values["left_side"][:3, 3])
    np.testing.assert_allclose(values["left_side"][:3, 2], forward, atol=1e-12)
    path = tmp_path / "camera.yaml"
    path.write_text(made.files["camera_info_front.yaml"])
    np.testing.assert_array_equal(load_camera(path).parameters, CAMERA.parameters)


def test_a_tampered_transform_is_found(tmp_path):
    source = load_source(calibration(tmp_path, built("gough-stewart")))
    exporter = exporters()["ros"]
    files = exporter.files(source)
    # any digits: how 0.9 is rounded depends on the processor
    shifted = {name: re.sub(r"--x 0\.\d+", "--x 0.8", text) for name, text in files.items()}
    assert any(d.beyond for d in exporter.check(shifted, source))
    other = {name: text.replace("600.0", "600.1") for name, text in files.items()}
    assert any(d.beyond for d in exporter.check(other, source))


def test_a_camera_that_is_not_found_is_named(tmp_path):
    folder = calibration(tmp_path / "a", built("gough-stewart"), session=False)
    made = make_export(load_source(folder), "ros")
    assert list(made.files) == ["static_transforms.launch.yaml"]
    assert "No camera_info for front and left side" in made.notes[0].text
    there = calibration(tmp_path / "b", built("gough-stewart")).parent
    assert len(make_export(load_source(folder, there), "ros").files) == 3


PRISM = [1e-3, 0.0, 0.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("model", "lens", "possible"),
    [
        ("unified", [0.9, 0, 0, 0, 0], False),
        ("double_sphere", [-0.2, 0.58], False),
        ("extended_unified", [0.6, 1.1], False),
        ("rational", [0.5, 0.1, 4e-4, -3e-4, 0.01, 0.7, 0.15, 0.01, *PRISM], False),
        ("rational", [0.5, 0.1, 4e-4, -3e-4, 0.01, 0.7, 0.15, 0.01, *np.zeros(6)], True),
    ],
)
def test_lenses_that_ros_lacks_have_no_camera_info(tmp_path, model, lens, possible):
    camera = camera_models()[model]((640, 480), np.array([300.0, 300, 320, 240, *lens]))
    made = make_export(
        load_source(calibration(tmp_path, built("gough-stewart"), camera=camera)), "ros"
    )
    assert (len(made.files) > 1) is possible
    codes = {note.code for note in made.notes}
    assert ("export.ros_lens" in codes) is not possible


def test_frames_have_names_that_ros_takes(tmp_path):
    source = source_of(
        load_mechanism("h4"), T_base_camera={n: np.eye(4) for n in ("a b", "a/b", "2", "ü")}
    )
    assert list(ros.frame_names(source).values()) == ["a_b", "a_b_2", "camera_2", "camera"]
