"""Background shared by hand-held images: camera poses from it, and their uncertainty."""

import cv2
import numpy as np
import pytest

from pkmcal.cameras.pinhole import Pinhole
from pkmcal.geometry.rigid import angle_between, inverse, pose, rotation
from pkmcal.observe.background import (
    BACKGROUND_OPTIONS,
    Neighbour,
    Surroundings,
    Texture,
    agreement,
    beside_machine,
    partners,
    texture_of,
)
from pkmcal.observe.image_localization import PoseHypotheses
from pkmcal.observe.predict import LegsInCamera

CAMERA = Pinhole((1200, 900), np.array([1000.0, 1000.0, 599.5, 449.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
FEET = np.array([[0.2, 0.0, 0.0], [-0.1, 0.17, 0.0], [-0.1, -0.17, 0.0]])
HEADS = 0.6 * FEET + [0.0, 0.0, 0.3]


def turned(degrees):
    """A turn (4, 4) about the base's z axis."""
    return pose(rotation(np.radians(degrees) * np.array([0.0, 0.0, 1.0])), np.zeros(3))


def looking(azimuth, away=1.0, height=0.35):
    """T_camera_base of a camera directed at the machine from an azimuth (degrees)."""
    a = np.radians(azimuth)
    eye = np.array([away * np.cos(a), away * np.sin(a), height])
    z = np.array([0.0, 0.0, 0.15]) - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    rot = np.stack([x, np.cross(z, x), z])
    return pose(rot, -rot @ eye)


def legs_of(T):
    a, b = FEET @ T[:3, :3].T + T[:3, 3], HEADS @ T[:3, :3].T + T[:3, 3]
    return LegsInCamera(a, b, (b - a) / np.linalg.norm(b - a, axis=-1, keepdims=True))


class Scene:
    """Points all round a machine, each with its own descriptor, and cameras that see some of them.

    noise : px. wrong : share of the points that bear another one's descriptor.
    """

    def __init__(self, azimuths, seed, points=900, noise=0.5, wrong=0.3):
        rng = np.random.default_rng(seed)
        angle, away = rng.uniform(0, 2 * np.pi, points), rng.uniform(1.5, 3.0, points)
        height = rng.uniform(-0.8, 1.5, points)
        world = np.stack([away * np.cos(angle), away * np.sin(angle), height], axis=-1)
        names = rng.standard_normal((points, 128)).astype(np.float32)
        names /= np.linalg.norm(names, axis=1, keepdims=True)
        self.T = [looking(a) for a in azimuths]
        self.textures = []
        for T in self.T:
            visible = world @ T[:3, :3].T + T[:3, 3]
            pixel = CAMERA.project(np.where(visible[:, 2:] > 0.1, visible, np.nan))
            with np.errstate(invalid="ignore"):
                inside = ((pixel > 0) & (pixel < CAMERA.image_size)).all(axis=1)
            pixel = pixel[inside] + noise * rng.standard_normal((inside.sum(), 2))
            mine = names[inside].copy()
            mistaken = rng.random(len(mine)) < wrong
            mine[mistaken] = mine[mistaken][rng.permutation(mistaken.sum())]
            self.textures.append(Texture(CAMERA.ray(pixel), pixel, mine))
        self.room = Surroundings(
            range(len(azimuths)), lambda _: (np.zeros((0, 0), dtype=np.uint8), CAMERA)
        )
        self.room.texture = lambda k: self.textures[k]

    def placed(self, *which):
        return {k: Neighbour(CAMERA, self.T[k], legs_of(self.T[k])) for k in which}


def test_partners_are_mutual_and_no_point_is_counted_twice():
    one, other = Scene([0, 12], seed=1, wrong=0.0).textures
    pairs = partners(one, other)
    same = (one.descriptor[pairs[:, 0]] == other.descriptor[pairs[:, 1]]).all(axis=1)
    assert same.mean() > 0.9
    assert len(pairs) > 50
    again = replace_texture(one, np.concatenate([np.arange(len(one.ray))] * 2))
    assert len(partners(again, other)) <= len(pairs)
    assert len(partners(one, replace_texture(other, np.arange(1)))) == 0


def replace_texture(texture, numbers):
    return Texture(*(part[numbers] for part in texture))


def test_what_may_be_the_machine_is_left_out():
    T = looking(0)
    middle = CAMERA.project((T[:3, :3] @ [0.0, 0.0, 0.15] + T[:3, 3])[None])
    pixel = np.concatenate([middle, [[5.0, 5.0], [1190.0, 880.0]]])
    assert beside_machine(pixel, CAMERA, legs_of(T)).tolist() == [False, True, True]
    # a camera that sees none of the joints sees the room alone
    away = legs_of(T)
    behind = LegsInCamera(-away.a, -away.b, away.u)
    assert beside_machine(pixel, CAMERA, behind).all()


@pytest.mark.parametrize("apart", [10, 20, 30])
def test_the_room_distinguishes_similar_poses(apart):
    scene = Scene([0, apart], seed=apart)
    pairs = scene.room.shared(0, 1)
    rays = [scene.textures[k].ray[numbers] for k, numbers in enumerate(pairs)]
    T_0, T_1 = scene.T
    poses = np.stack([T_0, *(T_0 @ turned(by) for by in (120, -120))])
    right, *wrong = agreement(*rays, T_1 @ inverse(poses))
    assert right > 20 > 5 > max(wrong)


def test_chance_is_not_taken_for_agreement():
    """Of unrelated pairs, one in e^g gains g at most (Markov)."""
    gains = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        rays = rng.uniform(-0.5, 0.5, (2, 30, 3))
        rays[..., 2] = 1.0
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        apart = looking(0) @ inverse(looking(rng.uniform(5, 180)))
        gains.append(agreement(*rays, apart[None]))
    gains = np.concatenate(gains)
    for g in (1.0, 2.0, 3.0):
        assert np.mean(gains > g) <= np.exp(-g)


def test_few_pairs_decide_nothing():
    ray = np.tile([0.0, 0.0, 1.0], (BACKGROUND_OPTIONS.fewest_pairs - 1, 1))
    assert not agreement(ray, ray, (looking(0) @ inverse(looking(20)))[None]).any()


def test_landmarks_place_a_image():
    scene = Scene([0, 12, 24, 18], seed=5)
    landmarks = scene.room.landmarks(scene.placed(0, 1, 2))
    count = scene.room.place(3, landmarks)
    assert len(count) == 1
    assert np.degrees(angle_between(count[0], scene.T[3])) < 0.2
    assert np.linalg.norm(inverse(count[0])[:3, 3] - inverse(scene.T[3])[:3, 3]) < 0.01


def test_landmarks_are_where_the_points_are():
    scene = Scene([0, 15], seed=6, noise=0.0, wrong=0.0)
    for k, above_limit in scene.room.landmarks(scene.placed(0, 1)).items():
        assert len(above_limit.point) > 20
        T = scene.T[k]
        pixel = CAMERA.project(above_limit.point @ T[:3, :3].T + T[:3, 3])
        assert np.abs(pixel - scene.textures[k].pixel[above_limit.number]).max() < 1e-3


def test_a_neighbour_determines_the_pose_up_to_the_distance():
    """The camera lies on the line of poses, as far along it as the cameras are apart."""
    s = Scene([0, 15, 180], seed=4)
    apart = np.linalg.norm((inverse(s.T[0]) - inverse(s.T[1]))[:3, 3])
    lines = s.room.relative(0, s.placed(1, 2), np.array([0.5, 1.0]) * apart)
    assert lines.shape == (1, 2, 4, 4)  # the third camera shows another part of the room
    assert np.degrees(angle_between(lines[0], s.T[0])).max() < 3.0
    assert np.linalg.norm((inverse(lines[0, 1]) - inverse(s.T[0]))[:3, 3]) < 0.2 * apart
    halfway = (inverse(s.T[0]) + inverse(s.T[1]))[:3, 3] / 2
    np.testing.assert_allclose(inverse(lines[0, 0])[:3, 3], halfway, atol=0.1 * apart)


def test_an_image_of_another_part_of_the_room_is_not_placed():
    scene = Scene([0, 12, 24, 180], seed=7)
    assert not len(scene.room.place(3, scene.room.landmarks(scene.placed(0, 1, 2))))


def test_the_right_pose_is_chosen_though_legs_prefer_a_similar_one():
    scene = Scene([0, 20], seed=8)
    T = scene.T[0]
    places = np.stack([T @ turned(120), T, T @ turned(240)])
    hypotheses = PoseHypotheses(places, np.array([20.0, 16.0, 12.0]), 1.0)
    legs = LegsInCamera(*(np.stack(v) for v in zip(*(
        (one.a, one.b, one.u) for one in map(legs_of, places)), strict=True)))  # fmt: skip
    values = scene.room.weighed(hypotheses, 0, CAMERA, legs, scene.placed(1))
    assert angle_between(values.T_camera_base[0], T) < 1e-6
    assert values.rival_probability < 1e-3
    # nobody is placed yet: the legs' word stands
    assert scene.room.weighed(hypotheses, 0, CAMERA, legs, {}) is hypotheses


def test_a_place_that_is_turned_a_little_is_turned_back():
    scene = Scene([0, 15, -15], seed=9)
    T = scene.T[0] @ turned(4.0)
    legs = legs_of(T)
    legs = LegsInCamera(legs.a[None], legs.b[None], legs.u[None])
    hypotheses = PoseHypotheses(T[None], np.array([10.0]), 1.0)
    near = scene.room.about(hypotheses, 0, CAMERA, legs, scene.placed(1, 2))
    assert len(near) == 1
    assert np.degrees(angle_between(near[0], scene.T[0])) < 2.5


def test_texture_is_found_where_it_is():
    """An image of many patches, shifted by 40 pixels: its points shift with it."""
    rng = np.random.default_rng(3)
    small = rng.integers(0, 255, (60, 80), dtype=np.uint8)
    image = cv2.resize(small, (1200, 900), interpolation=cv2.INTER_CUBIC)
    shifted = np.roll(image, 40, axis=1)
    one, other = texture_of(image, CAMERA), texture_of(shifted, CAMERA)
    pairs = partners(one, other)
    step = other.pixel[pairs[:, 1]] - one.pixel[pairs[:, 0]]
    assert len(pairs) > 100
    assert np.abs(np.median(step, axis=0) - [40.0, 0.0]).max() < 0.1
    assert len(texture_of(np.zeros((900, 1200), dtype=np.uint8), CAMERA).ray) == 0
