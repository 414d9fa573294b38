"""More than an input may hold is refused in a sentence that has the limit, before any work."""

import re
import shutil
import tracemalloc

import numpy as np
import pytest
import yaml

import pkmcal
from faults import fault, raises
from pkmcal.cameras import load_camera
from pkmcal.errors import InputError
from pkmcal.files import csv_text, limits, read_csv, read_json, read_yaml, validated_document
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.session.image_files import image_header
from pkmcal.session.load import load_session
from pkmcal.session.schema import session_schema


@pytest.fixture
def session(tmp_path):
    """An example session."""
    pkmcal.new().save(tmp_path / "session")
    return tmp_path / "session"


def changed(path, change):
    """A YAML file whose data were changed."""
    data = yaml.safe_load(path.read_text())
    change(data)
    path.write_text(yaml.safe_dump(data, default_flow_style=None))
    return path


def limited(most, number, call, *arguments):
    """Whether a call is refused with a limit and the number that was found."""
    with pytest.raises(InputError) as caught:
        call(*arguments)
    assert (str(most) in caught.value.expected, str(number) in caught.value.found) == (True, True)
    return True


@pytest.mark.parametrize(
    ("read", "most"),
    [
        (read_yaml, limits.LARGEST_WRITTEN_FILE),
        (load_camera, limits.LARGEST_WRITTEN_FILE),
        (read_json, limits.LARGEST_TEXT_FILE),
        (read_csv, limits.LARGEST_TEXT_FILE),
    ],
)
def test_a_file_that_is_too_large_is_not_read(tmp_path, read, most):
    path = tmp_path / "large.yaml"
    with path.open("wb") as stream:
        stream.truncate(most + 1)  # of zeros, which take no room on the disk
    tracemalloc.start()
    try:
        assert limited(most, most + 1, read, path)
        assert tracemalloc.get_traced_memory()[1] < most / 2
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("text", [pytest.param("a: [{}]\n", marks=pytest.mark.slow), "{}"])
def test_yaml_of_too_many_values_is_read_no_further(tmp_path, text):
    most = limits.MOST_YAML_NODES
    each = "1, " if "[" in text else "k{}: 1\n"
    lines = "".join(each.format(k) for k in range(most))
    path = tmp_path / "a.yaml"
    path.write_text(text.format(lines))
    with raises(InputError, code="file.too_many_values") as caught:
        read_yaml(path)
    assert str(most) in caught.value.what


def test_of_many_faults_in_a_file_the_first_are_looked_at(tmp_path):
    path = tmp_path / "session.yaml"
    path.write_text("".join(f"k{k}: 1\n" for k in range(2000)))
    message = fault(validated_document, read_yaml(path), session_schema())
    assert "line 1, k0" in message
    assert int(re.findall(r"and (\d+) more", message)[0]) < limits.MOST_FAULTS_NAMED


def test_legs_and_tubes(tmp_path):
    source = catalogue()["gough-stewart"]
    tube = {"radius": 0.01, "from": 0.1, "to": 0.2}
    for most, change in (
        (limits.MOST_MACHINE_LEGS, lambda data: data.update(legs=data["legs"] * 6)),
        (limits.MOST_LEG_TUBES, lambda data: data["legs"][1].update(tubes=[tube] * 36)),
    ):
        path = tmp_path / "mechanism.yaml"
        path.write_text(source.read_text())
        assert limited(most, 36, load_mechanism, changed(path, change))


def test_stations(session):
    def many(data):
        station = next(iter(data["stations"].values()))
        data["stations"] = {f"s{k}": station for k in range(201)}

    path = changed(session / "session.yaml", many)
    assert limited(limits.MOST_STATIONS, 201, load_session, path.parent)


def test_rows_and_columns_of_a_table(tmp_path):
    for rows, columns, most in ((limits.MOST_ROWS + 1, 1, limits.MOST_ROWS), (1, 100, 100)):
        names = [f"c{k}" for k in range(columns)]
        values = np.zeros((rows, columns))
        (tmp_path / "a.csv").write_text(csv_text(names, [str(k) for k in range(rows)], values))
        assert limited(most, most + 1 if columns > 1 else "", read_csv, tmp_path / "a.csv")


@pytest.mark.parametrize(
    "most",
    [pytest.param(limits.MOST_IMAGES, marks=pytest.mark.slow), limits.MOST_HANDHELD_IMAGES],
)
def test_images(demo, tmp_path, most):
    """One repeat of a configuration too many, by hand."""
    folder = tmp_path / "session"
    shutil.copytree(demo.session, folder)
    images = folder / "images" / "station1"
    first = min(images.iterdir())
    for k in range(most + 1):
        (images / f"{first.stem}_{k}.png").symlink_to(first)

    def by_hand(data):
        station = data["stations"]["station1"]
        station.pop("pose")
        station.update(handheld=True, images="images/station1/{configuration}_{repeat}.png")
        data["stations"] = {"station1": station}

    changed(folder / "session.yaml", by_hand)
    assert limited(most, most + 1, load_session, folder)


def test_pixels(tmp_path):
    side = 2**14 + 1
    camera = {"model": "pinhole", "focal": [1e4, 1e4], "center": [1e4, 1e4]}
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump({**camera, "image_size": [side, side]}))
    assert f"at most {limits.MOST_PIXELS}" in fault(load_camera, path)
    header = b"P5 %d %d 255\n" % (side, side)
    path = tmp_path / "a.pgm"
    with path.open("wb") as stream:
        stream.write(header)
        stream.truncate(len(header) + side**2)
    assert limited(limits.MOST_PIXELS, side**2, image_header, path)
