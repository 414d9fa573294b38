"""Boards: their files, their corners in rendered images, and messages for wrong ones."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import pytest

from faults import raises
from pkmcal.boards.board import chessboard, load_board
from pkmcal.boards.circles import circle_centres
from pkmcal.boards.detect import detect_boards
from pkmcal.boards.find import (
    Markers,
    detect_board,
    detect_markers,
    dictionary,
    marker_outlines,
)
from pkmcal.boards.lattice import lattices
from pkmcal.boards.layout import another_grid, marker_layout
from pkmcal.boards.prints import Print
from pkmcal.boards.saddles import SaddleOptions, largest_block, saddles
from pkmcal.cameras import camera_models
from pkmcal.errors import InputError
from pkmcal.files import yaml_text
from pkmcal.geometry.rigid import apply, inverse, pose, rotation

SIZE = (480, 360)
GREY = 110
FILES = {
    "charuco": "type: charuco\nsquares: [9, 7]\nsquare: 0.03\nmarker: 0.022\n"
    "dictionary: DICT_5X5_100\n",
    "chessboard": "type: chessboard\ncorners: [8, 5]\nsquare: 0.03\n",
    "aruco_grid": "type: aruco_grid\nmarkers: [5, 4]\nmarker: 0.04\ngap: 0.012\n"
    "dictionary: DICT_APRILTAG_36h11\n",
    "circle_grid": "type: circle_grid\ncircles: [8, 6]\nspacing: 0.03\n",
    "circle_grid_asymmetric": (
        "type: circle_grid\ncircles: [4, 11]\nspacing: 0.02\nasymmetric: true\n"
    ),
    "kalibr_aprilgrid": (
        "target_type: 'aprilgrid'\ntagCols: 5\ntagRows: 4\ntagSize: 0.036\ntagSpacing: 0.3\n"
    ),
}


def board_of(tmp_path, text):
    path = tmp_path / "board.yaml"
    path.write_text(text)
    return load_board(path)


def camera_of(model, *values):
    kind = camera_models()[model]
    parameters = np.zeros(len(kind.parameter_names))
    parameters[: len(values)] = values
    return kind(SIZE, parameters)


CAMERAS = {
    "pinhole": camera_of("pinhole", 520, 522, 243, 176, -0.15, 0.05, 4e-4, -3e-4),
    "fisheye": camera_of("fisheye", 190, 190.5, 238, 181, 0.02, -4e-3),
    "unified": camera_of("unified", 300, 301, 240, 178, 0.9),
}


def texture(board, per_square=60):
    """The printed board as grey levels, its place of (0, 0) in pixels, and pixels a metre."""
    data = board.document
    if board.type == "chessboard":
        columns, rows = (n + 1 for n in board.counts)
        y, x = np.mgrid[: rows * per_square, : columns * per_square] // per_square
        image = np.where((x + y) % 2 == 0, 20, 230).astype(np.uint8)
        return image, per_square, per_square / data["square"]
    if board.type == "circle_grid":
        return circles(board)
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, data["dictionary"]))
    if board.type == "charuco":
        printed = cv2.aruco.CharucoBoard(
            tuple(data["squares"]), data["square"], data["marker"], words
        )
        size = [n * per_square for n in data["squares"]]
        scale = per_square / data["square"]
    else:
        return aprilgrid(data) if data["leftward"] else marker_grid(data, words)
    image = printed.generateImage(tuple(size), marginSize=0, borderBits=1)
    return (20 + image * (210 / 255)).astype(np.uint8), 0, scale


def marker_grid(data, words, side=80):
    """As :func:`texture`; OpenCV's own image of a grid does not keep a scale."""
    columns, rows = data["markers"]
    step = round(side * (1 + data["gap"] / data["marker"]))
    image = np.full((rows * step, columns * step), 230, dtype=np.uint8)
    for k in range(rows * columns):
        y, x = k // columns * step, k % columns * step
        marker = cv2.aruco.generateImageMarker(words, k, side)
        image[y : y + side, x : x + side] = 20 + marker * (210 / 255)
    return image, 0, side / data["marker"]


def circles(board, per_spacing=80):
    """As :func:`texture`; circles with a radius of a third of the spacing."""
    scale, middles = per_spacing / board.document["spacing"], board.points[:, :2]
    size = np.rint((middles.max(axis=0)[::-1]) * scale).astype(int) + 2 * per_spacing
    image = np.full(size, 230, dtype=np.uint8)
    for at in middles * scale + per_spacing - 0.5:
        centre = tuple(np.rint(at * 256).astype(int).tolist())
        cv2.circle(image, centre, round(per_spacing / 3 * 256), 20, -1, cv2.LINE_AA, 8)
    return image, per_spacing, scale


def aprilgrid(data, side=80):
    """As :func:`texture`, from Kalibr's rules: tags with a border of two modules and black squares
    at their corners, the first at the lower left with its code rotated by 180 degrees, ids to the
    right and upward; then turned by 180 degrees, so that the tags are upright.
    """
    columns, rows = data["markers"]
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    gap = round(side * data["gap"] / data["marker"])
    step = side + gap
    image = np.full((rows * step + gap, columns * step + gap), 230, dtype=np.uint8)
    for k in range(rows * columns):
        y, x = (rows - 1 - k // columns) * step + gap, k % columns * step + gap
        bits = cv2.aruco.generateImageMarker(words, k, 8)[1:-1, 1:-1]
        tag = np.pad(bits, 2)[::-1, ::-1].repeat(side // 10, axis=0).repeat(side // 10, axis=1)
        for dy, dx in np.ndindex(2, 2):
            corner = y - gap + dy * step, x - gap + dx * step
            image[corner[0] : corner[0] + gap, corner[1] : corner[1] + gap] = 20
        image[y : y + side, x : x + side] = 20 + tag * (210 / 255)
    return np.ascontiguousarray(image[::-1, ::-1]), gap, side / data["marker"]


@lru_cache(maxsize=3)
def rays_between_pixels(model, image_size, parameters, fine):
    """Rays (fine H, fine W, 3) of a camera, ``fine`` to a pixel in each direction."""
    width, height = image_size
    x, y = np.arange(width, dtype=float), np.arange(height, dtype=float)
    camera = camera_models()[model](image_size, np.array(parameters))
    rays = camera.ray(np.stack(np.meshgrid(x, y), axis=-1))
    # between the pixels' centres rays are smooth; cv2 lays the finer grid centre on centre
    return cv2.resize(rays, None, fx=fine, fy=fine, interpolation=cv2.INTER_CUBIC)


def render(camera, T_camera_board, board, seed=0, noise=2.0, fine=4, hide=None):
    """Image of the board on a white sheet in front of a grey room, through the camera's rays.

    hide : (x0, y0, x1, y1) px of a grey patch.
    """
    printed, first, scale = texture(board)
    printed = cv2.copyMakeBorder(
        printed, *[round(0.02 * scale)] * 4, cv2.BORDER_CONSTANT, value=230
    )
    shift = first + round(0.02 * scale)
    width, height = camera.image_size
    parameters = tuple(camera.parameters.tolist())
    rays = rays_between_pixels(camera.model, camera.image_size, parameters, fine)
    # the rectangle of pixels that show the sheet, with its border's blur
    along = np.linspace(0, 1, 40)
    u, v = (np.concatenate(one) for one in zip(
        (along, 0 * along), (along, 1 + 0 * along), (0 * along, along), (1 + 0 * along, along),
        strict=True,
    ))  # fmt: skip
    sheet = np.stack([u * printed.shape[1], v * printed.shape[0]], axis=-1)
    metres = np.concatenate([(sheet - shift) / scale, np.zeros((len(u), 1))], axis=-1)
    outline = camera.project(apply(T_camera_board, metres))
    low, high = np.zeros(2, dtype=int), np.array([width, height])
    if np.isfinite(outline).all():
        low, high = (
            np.clip(edge, low, high).astype(int)
            for edge in (outline.min(axis=0) - 3, outline.max(axis=0) + 4)
        )
    rows, columns = (slice(fine * low[k], fine * high[k]) for k in (1, 0))
    rays = rays[rows, columns]
    back = inverse(T_camera_board)
    direction = rays @ back[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        far = -back[2, 3] / direction[..., 2]
        xy = (back[:2, 3] + far[..., None] * direction[..., :2]) * scale + shift - 0.5
    good = np.isfinite(xy).all(axis=-1) & (far > 0)
    place = np.where(good[..., None], xy, -1e4).astype(np.float32)
    in_view = cv2.remap(
        printed, place[..., 0], place[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, GREY
    )
    image = np.full((height, width), float(GREY))
    image[low[1] : high[1], low[0] : high[0]] = in_view.reshape(
        high[1] - low[1], fine, high[0] - low[0], fine
    ).mean(axis=(1, 3))
    if hide:
        x0, y0, x1, y1 = hide
        image[y0:y1, x0:x1] = 90
    image = cv2.GaussianBlur(image, (0, 0), 0.6)
    image = image + np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def view(board, turn, at, distance):
    """T_camera_board with the board's middle in direction `at` (m at unit depth), turned."""
    rot = rotation(np.array(turn, dtype=float))
    middle = np.array([*at, 1.0]) * distance
    return pose(rot, middle - rot @ board.points.mean(axis=0))


VIEWS = {
    ("charuco", "pinhole"): ((0.3, -0.4, 0.1), (0.02, -0.03), 0.42),
    ("charuco", "fisheye"): ((-0.2, 0.3, 0.0), (0.3, 0.1), 0.15),
    ("chessboard", "pinhole"): ((0.4, 0.2, -0.3), (0.0, 0.05), 0.4),
    ("chessboard", "fisheye"): ((0.2, 0.5, 0.1), (-0.5, 0.1), 0.14),
    ("aruco_grid", "pinhole"): ((0.3, 0.3, 0.05), (0.0, 0.0), 0.45),
    ("circle_grid", "pinhole"): ((0.5, 0.4, 0.05), (0.0, 0.0), 0.42),
    ("circle_grid_asymmetric", "pinhole"): ((-0.4, 0.5, 0.2), (0.0, 0.0), 0.42),
    ("kalibr_aprilgrid", "pinhole"): ((0.3, -0.3, 0.1), (0.0, 0.0), 0.38),
}


@pytest.fixture(params=VIEWS, ids="-".join)
def shot(request, tmp_path):
    kind, model = request.param
    board, camera = board_of(tmp_path, FILES[kind]), CAMERAS[model]
    T_camera_board = view(board, *VIEWS[request.param])
    return board, camera, T_camera_board


def test_corners_are_found_where_they_are(shot):
    """All corners, to a few hundredths of a pixel, with honest standard deviations."""
    board, camera, T_camera_board = shot
    value = detect_board(render(camera, T_camera_board, board), board)
    truth = camera.project(apply(T_camera_board, board.points))
    assert value.success
    assert not value.mirrored
    assert set(value.ids) | set(value.weak) == set(range(len(board.points)))
    assert len(value.ids) >= 0.9 * len(board.points)
    off = value.pixels - truth[value.ids]
    assert np.sqrt(np.mean(off**2)) < 0.04
    assert 0.4 < np.sqrt(np.mean((off / value.sigma[:, None]) ** 2)) < 1.8


def test_own_corners_beat_opencv(tmp_path):
    board, camera = board_of(tmp_path, FILES["charuco"]), CAMERAS["pinhole"]
    own, other = [], []
    for k, turn in enumerate(((0.5, 0.0, 0.0), (0.0, 0.6, 0.1), (-0.4, -0.4, 0.3))):
        T_camera_board = view(board, turn, (0.0, 0.0), 0.42)
        image = render(camera, T_camera_board, board, seed=k)
        value = detect_board(image, board)
        truth = camera.project(apply(T_camera_board, board.points))[value.ids]
        own.append(value.pixels - truth)
        rough = value.pixels.astype(np.float32).reshape(-1, 1, 2).copy()
        until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-3)
        fine = cv2.cornerSubPix(image, rough, (4, 4), (-1, -1), until)
        other.append(fine.reshape(-1, 2) - truth)
    ours, theirs = (np.sqrt(np.mean(np.concatenate(e) ** 2)) for e in (own, other))
    assert ours < 0.7 * theirs


def test_a_partly_hidden_charuco_board_is_used(tmp_path):
    board, camera = board_of(tmp_path, FILES["charuco"]), CAMERAS["pinhole"]
    T_camera_board = view(board, (0.2, -0.2, 0.0), (0.0, 0.0), 0.42)
    image = render(camera, T_camera_board, board, hide=(0, 0, 190, 360))
    value = detect_board(image, board)
    truth = camera.project(apply(T_camera_board, board.points))
    assert 15 <= len(value.ids) < 48
    assert np.all(truth[value.ids, 0] > 185)
    assert np.abs(value.pixels - truth[value.ids]).max() < 0.2


def test_a_board_out_of_sight_has_a_reason(tmp_path):
    board = board_of(tmp_path, FILES["charuco"])
    values = detect_board(np.full((360, 480), 90, dtype=np.uint8), board)
    assert not values.success
    assert values.reason == "none of the board's markers"
    assert values.ids.shape == (0,)
    assert values.pixels.shape == (0, 2)


@pytest.mark.parametrize("turn", [0.0, np.pi])
def test_colours_determine_which_way_up_a_chessboard_is(tmp_path, turn):
    board = board_of(tmp_path, FILES["chessboard"])
    assert not board.turnable
    assert chessboard((7, 5), 0.03).turnable
    camera = CAMERAS["pinhole"]
    T_camera_board = view(board, (0.2, 0.1, 0.0), (0.0, 0.0), 0.4)
    about = pose(rotation(np.array([0.0, 0.0, turn])), np.zeros(3))
    middle = board.points.mean(axis=0)
    about[:3, 3] = middle - about[:3, :3] @ middle
    value = detect_board(render(camera, T_camera_board @ about, board), board)
    truth = camera.project(apply(T_camera_board @ about, board.points))
    assert np.abs(value.pixels - truth[value.ids]).max() < 0.3


def test_mirror_images_are_reported(tmp_path):
    board, camera = board_of(tmp_path, FILES["charuco"]), CAMERAS["pinhole"]
    T_camera_board = view(board, (0.2, -0.2, 0.0), (0.0, 0.0), 0.42)
    image = np.ascontiguousarray(render(camera, T_camera_board, board)[:, ::-1])
    value = detect_board(image, board)
    assert value.mirrored
    truth = camera.project(apply(T_camera_board, board.points))[value.ids]
    np.testing.assert_allclose(value.pixels, [SIZE[0] - 1, 0] + [-1, 1] * truth, atol=0.2)


def images(folder, board, count=2, size=None, start=0):
    paths = []
    for k in range(start, start + count):
        T_camera_board = view(board, (0.2 * k - 0.2, 0.25, 0.1), (0.0, 0.0), 0.42)
        image = render(CAMERAS["pinhole"], T_camera_board, board, seed=k)
        paths.append(folder / f"p{k}.png")
        cv2.imwrite(str(paths[-1]), image if size is None else cv2.resize(image, size))
    return paths


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Two images of each board."""
    folder = tmp_path_factory.mktemp("boards")
    boards = {}
    for kind in FILES:
        (folder / kind).mkdir()
        board = board_of(folder / kind, FILES[kind])
        boards[kind] = board, images(folder / kind, board)
    return boards


def described(tmp_path, kind, *pairs):
    text = FILES[kind]
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    return board_of(tmp_path, text)


def test_every_image_has_a_result(pictures):
    board, paths = pictures["charuco"]
    results = detect_boards(paths, board)
    assert [d.name for d in results] == ["p0.png", "p1.png"]
    assert all(len(d.ids) == 48 for d in results)


@pytest.mark.parametrize(
    ("kind", "pairs", "shows", "message"),
    [
        ("chessboard", (("[8, 5]", "[7, 5]"),), "8x5 inner", "7x5 inner"),
        pytest.param("chessboard", (("[8, 5]", "[9, 6]"),), "8x5 inner", "9x6 inner",
                     marks=pytest.mark.slow),  # the same search as above, of other counts
        pytest.param("charuco", (("[9, 7]", "[7, 9]"),), "9x7 squares", "7x9 squares",
                     marks=pytest.mark.slow),
        ("charuco", (("[9, 7]", "[9, 6]"),), "9x7 squares", "9x6 squares"),
        pytest.param("charuco", (("5X5_100", "4X4_100"),), "markers of DICT_5X5_50", "9x7 squares",
                     marks=pytest.mark.slow),  # every dictionary is searched
        ("aruco_grid", (("[5, 4]", "[4, 5]"),), "a grid of 5x4 markers", "4x5 markers"),
        ("aruco_grid", (("[5, 4]", "[5, 3]"),), "markers 15, 16, 17, 18 beyond", "5x3 markers"),
        ("aruco_grid", (("[5, 4]", "[5, 4]\nfirst_id: 1"),), "first_id: 0", "first_id: 1"),
        ("aruco_grid", (("[5, 4]", "[5, 4]\nfirst_id: 5"),), "first_id: 0", "first_id: 5"),
    ],
)  # fmt: skip
def test_a_wrong_board_file_states_what_fits(pictures, tmp_path, kind, pairs, shows, message):
    board = described(tmp_path, kind, *pairs)
    with pytest.raises(InputError) as caught:
        detect_boards(pictures[kind][1], board)
    assert caught.value.code == "board.another"
    assert shows in caught.value.found
    assert message in caught.value.expected


@pytest.mark.parametrize(("gap", "advice"), [("0.3", "gap: 0.012;"), ("0.024", "a ruler")])
def test_gaps_that_are_not_as_described(pictures, tmp_path, gap, advice):
    """As a part of a marker's side, as other programs write it, or simply wrong."""
    board = described(tmp_path, "aruco_grid", ("0.012", gap))
    with pytest.raises(InputError) as caught:
        detect_boards(pictures["aruco_grid"][1], board)
    assert "which is 0.012 m" in caught.value.found
    assert advice in caught.value.next_step


def test_a_layout_is_that_of_the_markers_whatever_the_lens(tmp_path):
    """Part of the board through a fisheye: steps along rows and columns, the gap, and the possible
    first ids; ids of one row are not put into two.
    """
    board = board_of(tmp_path, FILES["aruco_grid"])
    words = dictionary(board.document["dictionary"])
    turns = (0.3, -0.3, 0.1), (-0.4, 0.2, 0.0)
    images = [render(CAMERAS["fisheye"], view(board, t, (0.0, 0.0), 0.28), board) for t in turns]
    results = [detect_markers(image, words) for image in images]
    layout = marker_layout(results)
    assert (layout.along, layout.down) == (1, 5)
    assert layout.gap == pytest.approx(0.3, abs=0.03)
    assert layout.first_ids() == [0]
    assert another_grid(layout, board) is None
    right = [  # without the first column: the board may begin with 1, if it is no wider
        Markers(ids[ids % 5 > 0], corners[ids % 5 > 0]) for ids, corners in results
    ]
    assert marker_layout(right).first_ids() == [1, 0]
    assert another_grid(marker_layout(right), board) is None
    assert marker_layout([Markers(ids[:2], corners[:2]) for ids, corners in results]) is None


def test_a_circles_centre_is_not_its_images_centroid(tmp_path):
    """At a large tilt the detector finds centroids, which perspective displaces."""
    board = board_of(tmp_path, FILES["circle_grid"])
    T_camera_board = view(board, (0.0, 0.9, 0.0), (0.0, 0.0), 0.42)
    image = render(CAMERAS["pinhole"], T_camera_board, board)
    truth = CAMERAS["pinhole"].project(apply(T_camera_board, board.points))
    found, rough = cv2.findCirclesGrid(image, board.counts)
    assert found
    rough = rough.reshape(-1, 2)
    centres, good, _ = circle_centres(image, board, rough)
    assert good.all()
    assert np.sqrt(np.mean((rough - truth) ** 2)) > 0.1
    assert np.sqrt(np.mean((centres - truth) ** 2)) < 0.02


def test_a_printed_aprilgrid_is_kalibrs(tmp_path):
    """Tags, their order and the black squares, as drawn from Kalibr's rules."""
    board = board_of(tmp_path, FILES["kalibr_aprilgrid"])
    image, first, scale = texture(board)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    dark = Print.of(board).dark_at(
        (x.ravel() + 0.5 - first) / scale, (y.ravel() + 0.5 - first) / scale
    )
    assert np.mean((image < 100) == dark.reshape(image.shape)) > 0.999


def test_grids_that_look_the_same_turned_by_half(tmp_path):
    texts = {
        "type: circle_grid\ncircles: [5, 4]\nspacing: 0.03\n": True,
        "type: circle_grid\ncircles: [4, 11]\nspacing: 0.03\nasymmetric: true\n": False,
        "type: circle_grid\ncircles: [4, 10]\nspacing: 0.03\nasymmetric: true\n": True,
    }
    for text, turnable in texts.items():
        board = board_of(tmp_path, text)
        turned = board.points.max(axis=0) - board.points
        places = {tuple(at) for at in np.rint(board.points * 1e4).astype(int).tolist()}
        same = {tuple(at) for at in np.rint(turned * 1e4).astype(int).tolist()} == places
        assert board.turnable == turnable == same


@pytest.mark.parametrize(
    ("text", "kind", "counts"),
    [
        (
            "target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\n"
            "rowSpacingMeters: 0.06\ncolSpacingMeters: 0.06\n",
            "chessboard",
            (6, 7),
        ),
        (FILES["kalibr_aprilgrid"], "aruco_grid", (5, 4)),
        (
            "target_type: 'circlegrid'\ntargetCols: 6\ntargetRows: 7\nspacingMeters: 0.02\n"
            "asymmetricGrid: False\n",
            "circle_grid",
            (6, 7),
        ),
    ],
)
def test_targets_of_kalibr(tmp_path, text, kind, counts):
    board = board_of(tmp_path, text)
    assert (board.type, board.counts) == (kind, counts)
    for line in text.splitlines()[1:]:
        with pytest.raises(InputError) as caught:
            board_of(tmp_path, text.replace(line + "\n", ""))
        assert caught.value.where.endswith(line.partition(":")[0])
    with pytest.raises(InputError) as caught:
        board_of(tmp_path, text.replace("target_type: '", "target_type: 'x"))
    assert caught.value.where.endswith("target_type")
    assert caught.value.found.startswith("x")


def test_a_checkerboard_of_kalibr_without_squares(tmp_path):
    text = (
        "target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\n"
        "rowSpacingMeters: 0.06\ncolSpacingMeters: 0.05\n"
    )
    with pytest.raises(InputError) as caught:
        board_of(tmp_path, text)
    assert caught.value.where.endswith("line 4, rowSpacingMeters")


@pytest.mark.parametrize(
    ("pictured", "described"),
    [
        ("circle_grid", "type: chessboard\ncorners: {counts}\nsquare: 0.02\n"),
        (
            "circle_grid_asymmetric",
            "type: circle_grid\ncircles: {counts}\nspacing: 0.02\n",
        ),
    ],
)
def test_circles_described_as_another_board(tmp_path, pictured, described):
    board = board_of(tmp_path, FILES[pictured])
    image = render(CAMERAS["pinhole"], view(board, *VIEWS[pictured, "pinhole"]), board)
    path = tmp_path / "circles.png"
    cv2.imwrite(str(path), image)
    other = board_of(tmp_path, described.format(counts=list(board.counts)))
    with pytest.raises(InputError) as caught:
        detect_boards([path], other)
    assert caught.value.found == board.described


def test_a_grid_of_kalibr_described_as_one_that_runs_to_the_right(tmp_path):
    """Ids that go on to the left are named, in place of a lens that fits them."""
    board = board_of(tmp_path, FILES["kalibr_aprilgrid"])
    image = render(CAMERAS["pinhole"], view(board, *VIEWS["kalibr_aprilgrid", "pinhole"]), board)
    path = tmp_path / "tags.png"
    cv2.imwrite(str(path), image)
    (detection,) = detect_boards([path], board)
    assert detection.success
    text = yaml_text({**board.document, "leftward": False})
    with pytest.raises(InputError) as caught:
        detect_boards([path], board_of(tmp_path, text))
    assert caught.value.code == "board.another"
    assert "ids go on by -1 to the right and by +5 downward" in caught.value.found


def test_a_border_of_another_width(tmp_path):
    """Kalibr's tags, described as OpenCV prints them."""
    board = board_of(tmp_path, FILES["kalibr_aprilgrid"])
    image = render(CAMERAS["pinhole"], view(board, *VIEWS["kalibr_aprilgrid", "pinhole"]), board)
    cv2.imwrite(str(tmp_path / "tags.png"), image)
    other = board_of(tmp_path, yaml_text({**board.document, "border": 1}))
    with pytest.raises(InputError) as caught:
        detect_boards([tmp_path / "tags.png"], other)
    assert caught.value.code == "board.another"
    assert caught.value.found.endswith("of DICT_APRILTAG_36h11 with border: 2")


def test_two_boards_mixed(pictures):
    """A minority of images with another board is not used, with the reason; a majority refused."""
    board, paths = pictures["charuco"]
    other = pictures["chessboard"][1]
    *right, odd = detect_boards([*paths, other[0]], board)
    assert all(detection.success for detection in right)
    assert not odd.success
    assert "a chessboard of 8x5 inner corners" in odd.reason
    with raises(InputError, code="board.mixed", found="a chessboard of 8x5 inner corners"):
        detect_boards([paths[0], *other[:2]], board)


def test_a_board_without_readable_markers_is_no_other_board(tmp_path, pictures):
    """White paper over the markers of one image, of which the squares are a chessboard then."""
    board, paths = pictures["charuco"]
    detection = detect_boards(paths, board)[0]
    image = cv2.imread(str(paths[0]), cv2.IMREAD_GRAYSCALE)
    homography, _ = cv2.findHomography(board.points[detection.ids, :2], detection.pixels)
    square, half = board.document["square"], board.document["marker"] * 0.55
    for row, column in np.ndindex(*board.document["squares"][::-1]):
        if (row + column) % 2:
            middle = (np.array([column, row]) + 0.5) * square
            sides = middle + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
            quad = cv2.perspectiveTransform(sides[None], homography)
            cv2.fillPoly(image, [np.rint(quad[0]).astype(np.int32)], int(image.max()))
    cv2.imwrite(str(tmp_path / "unread.png"), image)
    *right, odd = detect_boards([*paths, tmp_path / "unread.png"], board)
    assert all(one.success for one in right)
    assert not odd.success


def test_no_board_anywhere(tmp_path, pictures):
    paths = [tmp_path / f"{k}.png" for k in range(2)]
    for k, path in enumerate(paths):
        noise = np.random.default_rng(k).normal(90, 5, (180, 240))
        cv2.imwrite(str(path), noise.astype(np.uint8))
    with raises(InputError, code="board.not_found", found="none of the board's markers"):
        detect_boards(paths, pictures["charuco"][0])


@pytest.mark.parametrize("camera", CAMERAS)
def test_blocks_of_corners_separate_boards_from_textures(tmp_path, camera):
    """Every inner corner of a chessboard counts; of a texture as rough, hardly any point."""
    board = board_of(tmp_path, FILES["chessboard"])
    image = render(CAMERAS[camera], view(board, (0.3, -0.2, 0.1), (0.0, 0.0), 0.4), board)
    columns, rows = board.counts
    assert largest_block(image) >= 0.75 * (columns - 2) * (rows - 2)
    texture = cv2.GaussianBlur(np.random.default_rng(0).normal(128, 40, image.shape), (0, 0), 1.5)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    assert largest_block(texture) == 0


def flat_chessboard(counts, square, noise, turn=0.0):
    """Grey levels uint8 of a chessboard seen from the front, without blur of its own."""
    columns, rows = counts
    row, column = np.indices((rows + 1, columns + 1))
    image = np.where((row + column) % 2 == 0, 60.0, 190.0)
    image = np.pad(image, 1, constant_values=190.0).repeat(square, 0).repeat(square, 1)
    if turn:
        size = (640, 480)
        move = cv2.getRotationMatrix2D(np.array(image.shape[::-1]) / 2, turn, 1.0)
        move[:, 2] += (np.array(size) - image.shape[::-1]) / 2
        image = cv2.warpAffine(image, move, size, borderValue=150.0)
        image = cv2.GaussianBlur(image, (0, 0), 0.8)
    image = np.rint(image + np.random.default_rng(0).normal(0, noise, image.shape))
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("counts", [(3, 3), (4, 3), (3, 4)])
@pytest.mark.parametrize("turn", [3.0, 23.0, 44.0])
def test_the_smallest_chessboards(counts, turn):
    image = flat_chessboard(counts, 25, 3.0, turn)
    assert len(detect_board(image, chessboard(counts, 0.03)).ids) == counts[0] * counts[1]


@pytest.mark.parametrize("seed", [15, 26, 30])
def test_an_image_gives_the_same_corners_again(seed):
    """Whatever random numbers OpenCV has drawn before; with these, this board was missed."""
    cv2.setRNGSeed(seed)
    assert len(detect_board(flat_chessboard((3, 3), 25, 3.0, 3.0), chessboard((3, 3), 0.03)).ids)


def test_phases_of_noise_are_uniform():
    noise = np.random.default_rng(0).normal(128, 4, (480, 640))
    image = np.clip(np.rint(noise), 0, 255).astype(np.uint8)
    harmonic = saddles(image, SaddleOptions(false_alarms=image.size))[1]
    assert len(harmonic) == 2000
    assert np.mean(np.abs(harmonic.real) > np.abs(harmonic.imag)) == pytest.approx(0.5, abs=0.1)


def test_a_corner_without_a_place_is_not_used():
    """A fit without blur holds for every place between two pixels."""
    image = flat_chessboard((7, 6), 32, 3.0)
    value = detect_board(image, chessboard((7, 6), 0.03))
    assert len(value.ids) > 30
    assert value.sigma.max() < 8.0  # a quarter of a square


def test_a_marker_with_two_dark_bits():
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    marker = cv2.aruco.generateImageMarker(words, 190, 60)
    image = cv2.GaussianBlur(np.pad(marker, 30, constant_values=255), (0, 0), 0.8)
    assert len(marker_outlines(image)) > 0


def windows(pitch, sides=(1.0, 1.0)):
    """Image of 8 x 6 sharp dark rectangles, of half the pitch times ``sides``, x and y."""
    image = np.full((480, 640), 200, np.uint8)
    half = np.rint(0.28 * pitch * np.array(sides)).astype(int)
    for row, column in np.ndindex(6, 8):
        y, x = 60 + pitch * row, 80 + pitch * column
        image[y - half[1] : y + half[1], x - half[0] : x + half[0]] = 40
    return image


@pytest.mark.parametrize(
    ("pitch", "sides", "blur"),
    [
        (20, (1.0, 1.0), 0.0),
        (60, (1.0, 1.0), 0.0),
        # as a circle, a blurred square and a rectangle have little of the fourth harmonic
        (12, (1.0, 1.0), 1.2),
        (60, (1.2, 0.8), 0.0),
    ],
)
def test_windows_are_no_circles(tmp_path, pitch, sides, blur):
    """Dark rectangles on the places of circles."""
    image = windows(pitch, sides)
    image = cv2.GaussianBlur(image, (0, 0), blur) if blur else image
    cv2.imwrite(str(tmp_path / "windows.png"), image)
    with pytest.raises(InputError) as caught:
        detect_boards([tmp_path / "windows.png"], board_of(tmp_path, FILES["circle_grid"]))
    assert caught.value.found == "only 0 of 48 corners are sharp and uncovered"


def test_windows_beside_a_board_do_not_hide_it(tmp_path):
    """OpenCV's detector finds the dark windows first, light circles last."""
    board = board_of(tmp_path, FILES["circle_grid"])
    image = np.full((480, 640), 200, np.uint8)
    image[:240, :320] = cv2.resize(windows(60), (320, 240), interpolation=cv2.INTER_AREA)
    image[240:, 320:] = 30
    truth = np.array([(350 + 35 * c, 265 + 35 * r) for r, c in np.ndindex(6, 8)])
    for x, y in truth.tolist():
        cv2.circle(image, (x, y), 11, 220, -1, cv2.LINE_AA)
    detection = detect_board(cv2.GaussianBlur(image, (0, 0), 0.8), board)
    np.testing.assert_array_equal(detection.ids, np.arange(48))
    np.testing.assert_allclose(detection.pixels, truth, atol=0.02)


@pytest.mark.parametrize("size", [(1, 1), (1, 5000), (5000, 1), (2, 3000), (20, 20)])
@pytest.mark.parametrize("kind", ["charuco", "chessboard", "aruco_grid", "circle_grid"])
def test_images_of_hardly_any_pixels(tmp_path, kind, size):
    cv2.imwrite(str(tmp_path / "a.png"), np.random.default_rng(0).integers(0, 255, size, np.uint8))
    board = board_of(tmp_path, FILES[kind])
    with pytest.raises(InputError) as caught:
        detect_boards([tmp_path / "a.png"], board)
    assert caught.value.where.endswith("a.png")
    assert caught.value.expected == board.described


def test_images_of_two_sizes(tmp_path, pictures):
    board, paths = pictures["charuco"]
    odd = images(tmp_path, board, 1, (640, 480), start=7)
    with pytest.raises(InputError) as caught:
        detect_boards([*paths, *odd], board)
    facts = caught.value.where, caught.value.found, caught.value.expected
    assert facts == ("p7.png", "640x480 pixels", "480x360, as the other 2")


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("type: charucco\n",
         {"where": "board.yaml, line 1, type", "found": "charucco", "expected": "charuco"}),
        ("square: 0.03\n", {"where": "board.yaml, type",
                            "expected": "charuco or chessboard or aruco_grid or circle_grid"}),
        (FILES["charuco"].replace("0.022", "0.04"),
         {"where": "board.yaml, line 4, marker", "found": "0.04 m",
          "expected": "less than the square's 0.03 m"}),
        (FILES["charuco"].replace("5X5_100", "5X5_10"),
         {"where": "board.yaml, line 5, dictionary", "found": "'DICT_5X5_10'",
          "expected": "DICT_5X5_100"}),
        (FILES["charuco"].replace("DICT_5X5_100", "foo"),
         {"where": "board.yaml, line 5, dictionary", "found": "'foo'",
          "expected": "a name such as DICT_4X4_50"}),
        (FILES["chessboard"].replace("0.03", "30"),
         {"where": "board.yaml, line 3, square", "found": "30",
          "expected": "0.03, or 30 mm"}),
        (FILES["chessboard"].replace("corners", "corner"),
         {"where": "board.yaml", "found": "neither corners nor squares",
          "expected": "either corners, the inner ones, such as [7, 6], or squares, one more "
                      "each way", "next_step": "Then look at line 2, corner"}),
        (FILES["chessboard"].replace("[8, 5]", "[8, 2]"),
         {"where": "board.yaml", "found": "neither corners nor squares",
          "expected": "either corners, the inner ones, such as [7, 6], or squares, one more "
                      "each way", "next_step": "Then look at line 2, corners[2]"}),
    ],
)  # fmt: skip
def test_faults_of_board_files(tmp_path, text, facts):
    with raises(InputError, **facts):
        board_of(tmp_path, text)


def test_squares_or_inner_corners(tmp_path):
    one = board_of(tmp_path, FILES["chessboard"])
    two = board_of(tmp_path, FILES["chessboard"].replace("corners: [8, 5]", "squares: [9, 6]"))
    np.testing.assert_array_equal(one.points, two.points)
    assert one.lines == two.lines
    assert len(one.lines) == 13


def test_points_stand_where_opencv_has_them(tmp_path):
    board = board_of(tmp_path, FILES["charuco"])
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    theirs = cv2.aruco.CharucoBoard((9, 7), 0.03, 0.022, words).getChessboardCorners()
    np.testing.assert_allclose(board.points, np.asarray(theirs).reshape(-1, 3), atol=1e-7)
    grid = board_of(tmp_path, FILES["aruco_grid"])
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    theirs = cv2.aruco.GridBoard((5, 4), 0.04, 0.012, words).getObjPoints()
    np.testing.assert_allclose(grid.points, np.asarray(theirs).reshape(-1, 3), atol=1e-7)


def discs(columns, rows, without=(), pitch=34, shift=0):
    """Image of dark discs in rows, every second one shifted; places (rows, columns, 2) px."""
    image = np.full((pitch * (rows + 3), pitch * (columns + 4)), 210, np.uint8)
    row, column = np.mgrid[:rows, :columns]
    places = np.stack([pitch * (column + 2) + shift * (row % 2), pitch * (row + 2)], axis=-1)
    for at in np.ndindex(rows, columns):
        if at not in without:
            cv2.circle(image, tuple(places[at].tolist()), 10, 40, -1, cv2.LINE_AA)
    turn = cv2.getRotationMatrix2D((image.shape[1] / 2, image.shape[0] / 2), 7.0, 0.9)
    image = cv2.warpAffine(image, turn, image.shape[::-1], borderValue=210)
    return cv2.GaussianBlur(image, (0, 0), 0.8), places @ turn[:, :2].T + turn[:, 2]


@pytest.mark.parametrize(
    ("described", "shift"),
    [
        ("type: chessboard\ncorners: [8, 5]\nsquare: 0.03\n", 0),
        ("type: circle_grid\ncircles: [7, 6]\nspacing: 0.02\n", 0),
        (FILES["circle_grid_asymmetric"], 17),
    ],
)
def test_discs_everywhere_are_no_board(tmp_path, described, shift):
    """A grid of circles has only its counts: a part of a larger one is none."""
    cv2.imwrite(str(tmp_path / "discs.png"), discs(20, 14, shift=shift)[0])
    with pytest.raises(InputError) as caught:
        detect_boards([tmp_path / "discs.png"], board_of(tmp_path, described))
    assert caught.value.code == "board.not_found"


def test_a_grid_of_other_counts(tmp_path):
    cv2.imwrite(str(tmp_path / "discs.png"), discs(8, 6)[0])
    board = board_of(tmp_path, "type: circle_grid\ncircles: [7, 6]\nspacing: 0.02\n")
    with raises(InputError, code="board.not_found", found="a lattice of 8x6 circles"):
        detect_boards([tmp_path / "discs.png"], board)


def test_circles_that_are_covered(tmp_path):
    """Single circles may be; of a grid without its first column, nobody knows which column is."""
    board = board_of(tmp_path, "type: circle_grid\ncircles: [7, 6]\nspacing: 0.02\n")
    image, places = discs(7, 6, {(0, 0), (2, 3), (5, 6)})
    detection = detect_board(image, board)
    assert set(range(42)) - set(detection.ids.tolist()) == {0, 17, 41}
    np.testing.assert_allclose(detection.pixels, places.reshape(-1, 2)[detection.ids], atol=0.05)
    assert not detect_board(discs(6, 6)[0], board).success


@pytest.mark.parametrize("tilt", [0.0, 1.1])
def test_lattices_keep_their_steps(tilt):
    """Points of a plane at a large tilt, shuffled, with others beside them."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:9, :7].reshape(2, -1)
    x, y = column - 3.0, (row - 4.0) * np.cos(tilt)
    grid = np.stack([x, y], axis=-1) * 500 / (14 + (row - 4.0) * np.sin(tilt))[:, None]
    beside = rng.uniform((150, -200), (300, 200), (40, 2))
    order = rng.permutation(len(grid) + len(beside))
    first, *_ = lattices(np.concatenate([grid, beside])[order])
    mine = order[first.points] < len(grid)
    assert mine.sum() == len(grid)
    cells, number = first.cells[mine], order[first.points[mine]]
    true = np.stack([column, row], axis=-1)[number]
    steps = np.linalg.lstsq(true - true.mean(axis=0), cells - cells.mean(axis=0), rcond=None)[0]
    np.testing.assert_allclose(np.abs(np.linalg.det(steps)), 1.0, atol=1e-9)
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
