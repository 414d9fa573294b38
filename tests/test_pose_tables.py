"""poses.csv: its valid contents, and messages for mistakes."""

from __future__ import annotations

import numpy as np
import pytest

from faults import fault, raises
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import pose, pose_difference, rotation
from pkmcal.session.poses import check_lengths, read_poses

NAMES = tuple(f"{k:03d}" for k in range(8))
FULL = "configuration,x,y,z,qw,qx,qy,qz"


def table(tmp_path, text, names=NAMES, turn=1e-4):
    path = tmp_path / "poses.csv"
    path.write_text(text)
    return read_poses(path, "poses.csv", names, 2e-5, turn, "tracker")


def rows(values, names=NAMES):
    return "".join(
        f"{name},{','.join(map(str, row))}\n" for name, row in zip(names, values, strict=False)
    )


def whole(n=8, seed=0):
    """Poses with their rows of seven numbers."""
    rng = np.random.default_rng(seed)
    vector, t = rng.uniform(-1, 1, (n, 3)), rng.uniform(-0.2, 0.2, (n, 3))
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    q = np.concatenate([np.cos(angle / 2), np.sin(angle / 2) * vector / angle], axis=1)
    return pose(rotation(vector), t), np.concatenate([t, q], axis=1), np.hstack([t, vector])


def test_quaternions_and_rotation_vectors_say_the_same(tmp_path):
    T, quaternions, vectors = whole()
    quaternions[3, 3:] *= -1  # the same turn
    first = table(tmp_path, FULL + "\n" + rows(quaternions))
    second = table(tmp_path, "configuration,x,y,z,rx,ry,rz\n" + rows(vectors))
    for item in (first, second):
        assert item.kind == "poses"
        np.testing.assert_allclose(pose_difference(item.T, T), 0, atol=1e-12)
    poses = first.poses(station=2, mount=1)
    assert set(poses.station) == {2}
    assert set(poses.mount) == {1}
    np.testing.assert_allclose(poses.whiten[0], np.diag([1e4] * 3 + [5e4] * 3))
    assert poses.rows.tolist() == [6] * 8


def test_columns_may_stand_in_any_order(tmp_path):
    T, numbers, _ = whole()
    text = "configuration,qz,qy,qx,qw,z,y,x\n" + rows(numbers[:, ::-1])
    np.testing.assert_allclose(pose_difference(table(tmp_path, text).T, T), 0, atol=1e-12)


def test_points_have_three_rows_and_heights_one(tmp_path):
    T, numbers, _ = whole()
    points = table(tmp_path, "configuration,x,y,z\n" + rows(numbers[:, :3]), turn=None)
    heights = table(tmp_path, "configuration,z\n" + rows(numbers[:, 2:3]), turn=None)
    assert (points.kind, heights.kind) == ("points", "heights")
    assert points.poses(0, 0).rows.tolist() == [3] * 8
    assert heights.poses(0, 0).rows.tolist() == [1] * 8
    np.testing.assert_array_equal(points.T[:, :3, 3], T[:, :3, 3])
    # a height has information along z only
    assert np.flatnonzero(heights.poses(0, 0).whiten[0]).tolist() == [35]


def test_a_part_of_the_configurations_in_any_order(tmp_path):
    _, numbers, _ = whole()
    results = table(tmp_path, FULL + "\n" + rows(numbers[:4], ("005", "001", "007", "002")))
    assert results.configuration.tolist() == [5, 1, 7, 2]


def spoilt(row, column, value):
    numbers = whole()[1].tolist()
    numbers[row][column] = value
    return FULL + "\n" + rows(numbers)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("configuration,x,y,z,qw,qx,qy,qs\n" + rows(whole()[1]),
         ["poses.csv, line 1", "this column is not known", "found qs", "qw, qx, qy, qz"]),
        ("configuration,x,y,z,qw\n" + rows(whole()[1][:, :4]), ["line 1", "has no meaning"]),
        (spoilt(2, 3, 0.2), ["poses.csv, line 4", "qw, qx, qy, qz", "not of length one"]),
        (FULL + "\n" + rows(whole()[1], ("000", "001", "1", "003")),
         ["line 4", "no joint readings", "found 1", "expected 001", "leading zeros"]),
        (FULL + "\n" + rows(whole()[1], ("000", "001", "001", "003")), ["line 4", "occurs twice"]),
        (FULL + "\n" + rows(whole()[1][:2]), ["too few poses", "found 2 rows"]),
        ("configuration,z\n" + rows(whole()[1][:6, :1]), ["too few heights", "7 at least"]),
        ("configuration,x,y,z,rx,ry,rz\n" + rows(np.rad2deg(whole()[2])),
         ["line 2", "rx, ry, rz", "longer than a whole turn", "rx [deg]"]),
        (spoilt(1, 1, "0,3"), ["line 3", "another number of cells"]),
        (spoilt(1, 1, "much"), ["line 3, column y", "not a number"]),
    ],
)  # fmt: skip
def test_faults_are_reported_with_their_place(tmp_path, text, parts):
    message = fault(table, tmp_path, text)
    for part in parts:
        assert part in message


def test_whole_poses_need_the_noise_of_their_turns(tmp_path):
    with raises(InputError, code="poses.no_noise") as caught:
        table(tmp_path, FULL + "\n" + rows(whole()[1]), turn=None)
    assert "rotation" in caught.value.expected


def test_millimetres(tmp_path):
    T, numbers, _ = whole()
    numbers[:, :3] *= 1000
    value = table(tmp_path, FULL + "\n" + rows(numbers))
    with raises(InputError, code="poses.units", where="poses.csv"):
        check_lengths(value, T)
    numbers[:, :3] /= 1000
    check_lengths(table(tmp_path, FULL + "\n" + rows(numbers)), T)


def test_starts_of_points_and_heights(tmp_path):
    T, _, _ = whole()
    T_tracker_base = pose(rotation(np.array([0.3, -2.0, 1.0])), np.array([3.0, 1.0, -0.5]))
    in_view = (T_tracker_base @ T)[:, :3, 3]
    points = table(tmp_path, "configuration,x,y,z\n" + rows(in_view), turn=None)
    np.testing.assert_allclose(points.start(T), T_tracker_base, atol=1e-12)
    heights = table(tmp_path, "configuration,z\n" + rows(T[:, 2:3, 3] + 0.25), turn=None)
    np.testing.assert_allclose(heights.start(T)[:3, 3], [0, 0, 0.25], atol=1e-12)
