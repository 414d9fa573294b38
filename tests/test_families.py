"""Nominal models of few numbers, and of files of joint centres."""

from __future__ import annotations

import numpy as np
import pytest

import pkmcal
from conftest import run
from pkmcal.errors import InputError
from pkmcal.mechanisms import load_mechanism
from pkmcal.session.load import load_session
from pkmcal.starter.families import family_model

NUMBERS = {
    "hexapod": {"base_radius": 0.18, "platform_radius": 0.12, "leg": 0.3, "travel": 0.1},
    "rotary-hexapod": {
        "base_radius": 0.18, "platform_radius": 0.12, "arm": 0.04, "leg": 0.2,
        "base_spacing": 0.08, "platform_spacing": 0.04, "arm_angle": 1.2,
    },
    "delta": {"base_radius": 0.085, "platform_radius": 0.035, "arm": 0.1, "leg": 0.22},
    "linear-delta": {"base_radius": 0.14, "platform_radius": 0.035, "leg": 0.27, "travel": 0.3},
}  # fmt: skip
TUBE = 0.004


@pytest.fixture(params=NUMBERS)
def family(request):
    return request.param


@pytest.fixture
def folder(family, tmp_path):
    """Session by the command, with lengths in mm."""
    words = [
        word
        for name, value in (NUMBERS[family] | {"tube_radius": TUBE}).items()
        for word in (
            f"--{name.replace('_', '-')}",
            f"{value:g} rad" if name == "arm_angle" else f"{1e3 * value:g} mm",
        )
    ]
    assert run("new", tmp_path / "mine", "--machine", family, *words).code == 0
    return tmp_path / "mine"


def ends(machine):
    """A and B (L, 3) at home, base frame."""
    home = machine.home()
    at_home = machine.ends_at(machine.inverse(home[None])[0], home)
    return at_home.a, at_home.b


def test_a_family_has_its_numbers(family, folder):
    numbers = NUMBERS[family]
    machine = load_mechanism(folder / "mechanism.yaml")
    base = np.linalg.norm([leg.base.center for leg in machine.document.legs], axis=1)
    np.testing.assert_allclose(base, numbers["base_radius"], atol=2e-6)
    platform = np.linalg.norm(machine.platform_centers(), axis=1)
    np.testing.assert_allclose(platform, numbers["platform_radius"], atol=2e-6)
    a, b = ends(machine)
    np.testing.assert_allclose(np.linalg.norm(b - a, axis=1), numbers["leg"], atol=3e-6)
    assert all(leg.tubes[0].radius == TUBE for leg in machine.document.legs)
    if "travel" in numbers:
        np.testing.assert_allclose(np.ptp(machine.joint_ranges, axis=1), numbers["travel"])
    readings = machine.inverse(machine.home()[None])
    assert machine.forward_result(readings).singularity[0] > 0.1
    np.testing.assert_allclose(machine.forward(readings)[0], machine.home(), atol=1e-9)


def test_the_files_comment_explains_every_number(family, folder):
    lines = (folder / "mechanism.yaml").read_text().splitlines()
    for name in NUMBERS[family] | {"tube_radius": TUBE}:
        (at,) = (k for k, line in enumerate(lines) if line.startswith(f"# {name}: "))
        assert all(line.startswith("#   ") for line in lines[at + 1 : at + 3])


def test_command_and_function_write_the_same(family, folder):
    result = pkmcal.new(family, **NUMBERS[family], tube_radius=TUBE)
    assert {name: (folder / name).read_text() for name in result.texts} == result.texts


def test_a_new_session_of_a_family_lacks_its_images_alone(folder):
    session = load_session(folder, measured=False)
    assert {station.observe for station in session.stations} == {("legs",)}
    done = run("check", folder, "--json")
    assert done.code == 2
    assert "mechanism.yaml" not in done.out
    assert run("show", folder / "mechanism.yaml", "-o", folder / "page.html").code == 0


@pytest.mark.parametrize(
    ("degrees", "apart"), [(90, 0.08 + 2 * 0.04), (-90, 0.0), (0, 0.08), (-150, 0.08 - 0.04)]
)
def test_servos_of_a_pair_are_mirrored(degrees, apart):
    """apart : distance of the ends of a pair's level arms."""
    machine = machine_of("rotary-hexapod", arm_angle=np.deg2rad(degrees))
    half = np.diag([1.0, -1.0, 1.0])  # across the plane y = 0, in which the first pair is
    still, risen = (
        machine.ends_at(np.full(6, angle), machine.home()).a for angle in (0.0, np.deg2rad(30))
    )
    np.testing.assert_allclose(still[0], half @ still[1], atol=1e-9)
    np.testing.assert_allclose(risen[0], half @ risen[1], atol=1e-9)
    np.testing.assert_allclose(risen[:, 2], 0.04 * np.sin(np.deg2rad(30)), atol=1e-9)
    assert np.linalg.norm(still[0] - still[1]) == pytest.approx(apart, abs=3e-6)
    outwards = [still[j, 0] - machine.document.legs[j].base.center[0] for j in (0, 1)]
    np.testing.assert_allclose(outwards, 0.04 * np.cos(np.deg2rad(degrees)), atol=2e-6)


def machine_of(family, **changed):
    """Machine of a family's numbers."""
    return family_model(family, NUMBERS[family] | changed).machine()


def test_numbers_that_were_not_given_are_named():
    result = pkmcal.new("hexapod", base_radius=0.18, platform_radius=0.12, leg=0.3)
    options = [one.facts["option"] for one in result.outcome.findings]
    assert options == ["--base-spacing", "--platform-spacing"]
    result = pkmcal.new("rotary-hexapod", **NUMBERS["rotary-hexapod"])
    assert result.outcome.findings == ()
    numbers = {key: value for key, value in NUMBERS["rotary-hexapod"].items() if key != "arm_angle"}
    (assumed,) = pkmcal.new("rotary-hexapod", **numbers).outcome.findings
    assert assumed.facts["option"] == "--arm-angle"


@pytest.mark.parametrize(
    ("name", "changed", "where"),
    [
        ("hexapod", {"leg": 0.1}, "--leg"),
        ("rotary-hexapod", {"leg": 0.05}, "--leg"),
        ("delta", {"leg": 0.15}, "--leg"),
        ("linear-delta", {"leg": 0.1}, "--leg"),
        ("hexapod", {"base_radius": 0.0}, "base_radius"),
        ("hexapod", {"platform_radius": -0.1}, "platform_radius"),
        ("hexapod", {"leg": float("nan")}, "leg"),
        ("hexapod", {"base_radius": 180.0}, "base_radius"),
        ("hexapod", {"base_spacing": 0.32}, "--base-spacing"),
        ("hexapod", {"travel": 0.6}, "--travel"),
        ("hexapod", {"arm": 0.1}, "--arm"),
        ("hexapod", {"arm_angle": 1.0}, "--arm-angle"),
        ("rotary-hexapod", {"arm_angle": 90.0}, "arm_angle"),
        ("delta", {"travel": 0.1}, "--travel"),
        ("hexapod", {"tube_radius": 0.2}, "--tube-radius"),
        # regular hexagons: a singular architecture
        ("hexapod", {"base_spacing": 0.18, "platform_spacing": 0.12}, "--machine"),
        ("gough-stewart", {"leg": 0.3}, "--machine"),
        (None, {"leg": 0.3}, "--machine"),
        ("hexapod", {"printer": "printer.cfg"}, "--printer"),
        ("hexapod", {"unit": "mm"}, "--unit"),
    ],
)
def test_impossible_numbers_are_refused(name, changed, where):
    with pytest.raises(InputError) as refused:
        pkmcal.new(name, **(NUMBERS.get(name, {}) | changed))
    assert refused.value.where == where


@pytest.mark.parametrize("name", NUMBERS)
def test_a_family_needs_its_numbers(name):
    for number in NUMBERS[name].keys() - {
        "travel",
        "base_spacing",
        "platform_spacing",
        "arm_angle",
    }:
        less = {key: value for key, value in NUMBERS[name].items() if key != number}
        with pytest.raises(InputError) as refused:
            pkmcal.new(name, **less)
        assert f"--{number.replace('_', '-')}" in refused.value.found


def test_built_in_machines_need_no_numbers():
    for name in ("delta", "linear-delta"):
        assert pkmcal.new(name).texts["mechanism.yaml"].startswith("# A")


# files of joint centres


@pytest.fixture
def hexapod():
    return machine_of("hexapod")


def hal_text(machine, factor=1e3):
    """Pins of genhexkins; factor : to the file's unit."""
    centers = {"base": machine.base_centers(), "platform": machine.platform_centers()}
    lines = [
        f"setp genhexkins.{end}.{j}.{axis} {factor * x:.6f}"
        for end, points in centers.items()
        for j, point in enumerate(points)
        for axis, x in zip("xyz", point, strict=True)
    ]
    return "loadrt genhexkins\n" + "\n".join(lines) + "\n"


def table_text(machine):
    """CSV table in mm."""
    rows = np.hstack([machine.base_centers(), machine.platform_centers()]) * 1e3
    heads = [f"{end}_{axis} [mm]" for end in ("base", "platform") for axis in "xyz"]
    body = "".join(f"{j + 1},{','.join(f'{x:.6f}' for x in row)}\n" for j, row in enumerate(rows))
    return f"leg,{','.join(heads)}\n{body}"


@pytest.mark.parametrize("kind", ["mm", "inch", "csv"])
def test_joint_centres_are_read_back(kind, hexapod, tmp_path):
    path = tmp_path / ("hexapod.csv" if kind == "csv" else "hexapod.hal")
    factor = {"inch": 1 / 0.0254}.get(kind, 1e3)
    path.write_text(table_text(hexapod) if kind == "csv" else hal_text(hexapod, factor))
    unit = () if kind == "csv" else ("--unit", kind)
    options = ("--leg", "300 mm", "--travel", "100 mm", "--tube-radius", "4 mm")
    done = run("new", tmp_path / "mine", "--from", path, *unit, *options)
    assert done.code == 0
    machine = load_mechanism(tmp_path / "mine" / "mechanism.yaml")
    np.testing.assert_allclose(machine.base_centers(), hexapod.base_centers(), atol=2e-6)
    np.testing.assert_allclose(machine.platform_centers(), hexapod.platform_centers(), atol=2e-6)
    np.testing.assert_allclose(machine.home(), hexapod.home(), atol=1e-5)
    np.testing.assert_allclose(machine.joint_ranges, hexapod.joint_ranges, atol=1e-5)


def test_home_is_where_legs_have_the_length(hexapod, tmp_path):
    """Base and platform frames elsewhere than in the middle, at other heights."""
    centers = np.hstack([hexapod.base_centers(), hexapod.platform_centers()])
    centers += [0.1, -0.2, 0.03, 0.05, 0.01, -0.07]
    path = tmp_path / "centres.csv"
    names = [f"{end}_{axis}" for end in ("base", "platform") for axis in "xyz"]
    rows = [f"{j},{','.join(map(repr, row.tolist()))}\n" for j, row in enumerate(centers)]
    path.write_text(f"leg,{','.join(names)}\n{''.join(rows)}")
    result = pkmcal.new(from_file=path, leg=0.3)
    result.save(tmp_path / "mine")
    a, b = ends(load_mechanism(tmp_path / "mine" / "mechanism.yaml"))
    np.testing.assert_allclose(np.linalg.norm(b - a, axis=1), 0.3, atol=3e-6)


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("setp genhexkins.base.3.y", "# setp base.3.y", "h.hal"),
        (
            "genhexkins.base.0.x ",
            "genhexkins.base.0.x [KINS]",
            "h.hal, line 2, genhexkins.base.0.x",
        ),
        ("genhexkins", "trivkins", "h.hal"),
        ("genhexkins.base.0.x", "genhexkins.bsae.0.x", "h.hal, line 2"),
        ("genhexkins.base.0.x", "genhexkins.base.6.x", "h.hal, line 2"),
    ],
)
def test_incomplete_pins_are_refused(old, new, where, hexapod, tmp_path):
    text = hal_text(hexapod)
    (tmp_path / "h.hal").write_text(text.replace(old, new))
    with pytest.raises(InputError) as refused:
        pkmcal.new(from_file=tmp_path / "h.hal", unit="mm", leg=0.3)
    assert refused.value.where == where


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("leg,", "strut,", "h.csv, line 1"),
        ("base_x [mm]", "base_x [deg]", "h.csv, line 1"),
        ("\n1,", "\n1,,", "h.csv, line 2"),
        ("\n1,1", "\n1,x1", "h.csv, line 2, base_x"),
        (" [mm]", "", "h.csv, leg 1, base_x"),
        ("\n3,", "\n2,", "h.csv, line 4, leg"),
        (",", ";", "h.csv, line 1"),
    ],
)
def test_wrong_tables_are_refused(old, new, where, hexapod, tmp_path):
    text = table_text(hexapod)
    assert old in text
    (tmp_path / "h.csv").write_text(text.replace(old, new))
    with pytest.raises(InputError) as refused:
        pkmcal.new(from_file=tmp_path / "h.csv", leg=0.3)
    assert refused.value.where == where


@pytest.mark.parametrize(
    ("arguments", "where"),
    [
        ({}, "--from"),
        ({"leg": 0.3, "arm": 0.1}, "--from"),
        ({"leg": 0.05}, "--leg"),
        ({"leg": 0.3, "travel": 0.7}, "--travel"),
        ({"leg": 0.3, "unit": "mm"}, "--unit"),
        ({"leg": 0.3, "machine": "h4"}, "--from"),
    ],
)
def test_arguments_beside_a_table(arguments, where, hexapod, tmp_path):
    (tmp_path / "h.csv").write_text(table_text(hexapod))
    with pytest.raises(InputError) as refused:
        pkmcal.new(from_file=tmp_path / "h.csv", **arguments)
    assert refused.value.where == where


def test_a_hal_file_needs_its_unit(hexapod, tmp_path):
    (tmp_path / "h.hal").write_text(hal_text(hexapod))
    for unit in (None, "furlong"):
        with pytest.raises(InputError) as refused:
            pkmcal.new(from_file=tmp_path / "h.hal", leg=0.3, unit=unit)
        assert refused.value.where == "--unit"
