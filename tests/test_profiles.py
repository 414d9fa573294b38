"""The shading-aware edge model against profiles of Lambert-shaded cylinders, made another way.

The oracle shades a cylinder's surface by its angle to the light, blurs it numerically, and adds a
camera's noise and 8-bit rounding at pixels whose place on the profile is random.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from pkmcal.observe.profiles import (
    PROFILE_OPTIONS,
    Profiles,
    cut_of,
    estimate_blur,
    locate,
    residual_curves,
    without_highlights,
)

FINE = 0.01
PLACE = np.arange(-14, 14, FINE) + FINE / 2  # px outward of the edge
FRONTAL = (0.0, 0.4)
"""Light from near the camera (rad beside it): the limb is dark, the tube brightens inwards."""
ANY = (-1.5, 1.5)


class Limb(NamedTuple):
    """A tube in front of a background: half width (px), angle of the light, grey levels; reflection
    of the lamp in polished metal, times as bright as the rest.
    """

    half_width: float
    light: float
    albedo: float
    ground: float
    slope: float
    ambient: float = 0.25
    lamp: float = 0.0

    def brightness(self):
        """At PLACE: Lambert's law inside, a plain slope outside."""
        normal = np.arcsin(np.clip(PLACE / self.half_width + 1, -1, 1))
        lit = self.ambient + (1 - self.ambient) * np.maximum(np.cos(normal - self.light), 0)
        # 35 degrees within the limb, some five wide
        lit = lit + self.lamp * np.exp(-0.5 * ((np.pi / 2 - normal - 0.6) / 0.09) ** 2)
        return np.where(PLACE < 0, self.albedo * lit, self.ground + self.slope * PLACE)

    def contrast(self):
        """Grey levels between the limb itself and the background beside it."""
        inside = self.brightness()[PLACE < 0][-1]
        return abs(inside - self.ground)


def blurred(brightness, blur):
    reach = np.arange(-round(6 * blur / FINE), round(6 * blur / FINE) + 1) * FINE
    kernel = np.exp(-0.5 * (reach / blur) ** 2)
    return np.convolve(brightness, kernel / kernel.sum(), mode="same")


def cubic(distance):
    """Cubic convolution kernel of the images' interpolation, a = -0.75 as OpenCV's."""
    t, a = np.abs(distance), -0.75
    near = (a + 2) * t**3 - (a + 3) * t**2 + 1
    far = a * (t**3 - 5 * t**2 + 8 * t - 4)
    return np.where(t < 1, near, np.where(t < 2, far, 0.0))


class Made(NamedTuple):
    """Profiles with their true edge positions."""

    profiles: Profiles
    truth: np.ndarray


def draw_limb(rng, light, albedo, ground, half_width, least_contrast, lamp):
    while True:
        limb = Limb(
            np.exp(rng.uniform(*np.log(half_width))),
            rng.uniform(*light),
            rng.uniform(*albedo),
            rng.uniform(*ground),
            rng.normal(),
            lamp=lamp,
        )
        if limb.contrast() >= least_contrast:
            return limb


def make(
    seed,
    number=300,
    *,
    blur=0.7,
    light=ANY,
    albedo=(120, 230),
    ground=(20, 60),
    half_width=(3.5, 50),
    noise=1.0,
    count=24,
    gain=1.0,
    least_contrast=40,
    lamp=0.0,
):
    """Random profiles; the signal is exact at the profile's places, the noise interpolated."""
    rng = np.random.default_rng(seed)
    offsets = PROFILE_OPTIONS.sampled_offsets
    grey, truth, widths, clipped = [], [], [], []
    for _ in range(number):
        limb = draw_limb(rng, light, albedo, ground, half_width, least_contrast, lamp)
        level = gain * blurred(limb.brightness(), blur)
        shift = rng.uniform(-1, 1)
        pixels = np.arange(-8, 9) + rng.uniform(0, 1, (count, 1))
        exact = np.interp(pixels - shift, PLACE, level)
        read = np.clip(np.round(exact + noise * rng.normal(size=exact.shape)), 0, 255)
        weights = cubic(offsets[:, None] - pixels[:, None, :])
        clean = np.minimum(np.interp(offsets - shift, PLACE, level), 255)
        samples = clean + (weights @ (read - np.minimum(exact, 255))[..., None])[..., 0]
        grey.append(samples.mean(axis=0))
        truth.append(shift)
        widths.append(limb.half_width)
        clipped.append(np.any(samples >= PROFILE_OPTIONS.saturated, axis=0))
    counts = np.full(number, float(count))
    explained = np.array(clipped)[:, -len(PROFILE_OPTIONS.profile_offsets) :]
    station = np.zeros(number, dtype=int)
    profiles = Profiles.of(np.array(grey), explained, counts, np.array(widths), station)
    return Made(profiles, np.array(truth))


def plain(grey, half_width):
    """Whole profiles (N, samples) at the places that the model explains."""
    count, none = len(grey), np.zeros(len(grey), dtype=int)
    many, width = np.full(count, 24.0), np.full(count, half_width)
    return Profiles(grey, many, width, none, none, none, none > 0)


def steepest(profiles):
    """Place of the strongest gradient, to sub-pixel by a parabola."""
    offsets, slope = PROFILE_OPTIONS.profile_offsets, np.abs(np.gradient(profiles.grey, axis=1))
    best = np.clip(slope.argmax(axis=1), 1, len(offsets) - 2)
    slope_before, here, slope_after = (slope[np.arange(len(best)), best + d] for d in (-1, 0, 1))
    step = np.clip(
        (slope_before - slope_after) / (2 * (slope_before - 2 * here + slope_after) - 1e-9), -1, 1
    )
    return offsets[best] + step * (offsets[1] - offsets[0])


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def located(profiles, blur):
    """Positions of profiles each by itself: about the trial position that leaves least."""
    curves = residual_curves(profiles, {0: blur})
    return locate(profiles, curves, PROFILE_OPTIONS.shifts[curves.argmin(axis=-1)])


BRIGHT_TUBE = {"albedo": (120, 230), "ground": (20, 60)}
DARK_TUBE = {"albedo": (60, 120), "ground": (150, 235)}


@pytest.mark.parametrize("blur", [0.55, pytest.param(0.7, marks=pytest.mark.slow), 0.8])
@pytest.mark.parametrize("scene", [BRIGHT_TUBE, DARK_TUBE], ids=["bright tube", "dark tube"])
def test_well_exposed_edges_are_unbiased(blur, scene):
    """A hundredth of a pixel off in the mean, for any width, light and contrast above 40 levels.

    Noise alone leaves 0.02 / sqrt(300) = 0.001 px; the tabulated half widths leave the rest, and
    the priors of the shading: on slim legs only the limb's few samples are used, so that with much
    blur the priors matter, towards less shading (0.013 px at 0.8 px).
    """
    made = make(1, blur=blur, **scene)
    at = located(made.profiles, blur)
    assert at.valid.mean() > 0.98
    off = (at.position - made.truth)[at.valid]
    assert abs(off.mean()) < (0.01 if blur < 0.75 else 0.015)
    assert rms(off) < 0.03
    assert np.abs(off).max() < 0.15


def test_the_strongest_gradient_is_biased_where_the_model_is_not():
    """Why the model exists: with light from beside the camera a tube brightens inwards faster
    than the blurred edge itself changes, and the gradient is strongest inside the tube."""
    made = make(2, light=FRONTAL, albedo=(200, 235), ground=(0, 15), least_contrast=30)
    at = located(made.profiles, 0.7)
    gradient = steepest(made.profiles) - made.truth
    model = at.position - made.truth
    assert np.median(gradient) < -0.12
    assert abs(np.median(model)) < 0.01
    assert rms(gradient) > 6 * rms(model)


@pytest.mark.parametrize(
    ("noise", "count", "narrow", "wide"),
    [
        # The sigma counts what real surfaces differ from the model, MODEL_ERROR of the contrast.
        # This oracle's do not, so where noise is small it is too large by up to three times.
        (1.0, 24, 0.3, 1.2),
        # Here grey-level noise is what there is.
        (3.0, 24, 0.6, 1.6),
        (3.0, 8, 0.6, 1.6),
    ],
)
def test_the_stated_sigma_covers_the_scatter(noise, count, narrow, wide):
    made = make(3, 400, noise=noise, count=count)
    at = located(made.profiles, 0.7)
    ratio = ((at.position - made.truth) / at.sigma)[at.valid]
    assert narrow < rms(ratio) < wide
    # a normal law has 0.3 % beyond three sigmas
    assert np.mean(np.abs(ratio) > 3 * wide) < 0.01


def test_more_noise_is_a_larger_sigma():
    levels = [located(make(4, 100, noise=n).profiles, 0.7).sigma for n in (0.5, 2.0, 8.0)]
    medians = [float(np.median(sigma)) for sigma in levels]
    assert medians[0] < medians[1] < medians[2]


def test_overexposed_edges_are_cut_or_dropped():
    """Clipped samples are ignored; the remaining ones have less information, and sigma is
    larger.
    """
    made = make(5, 600, gain=1.7, albedo=(150, 230))
    cut = made.profiles.cut > 0
    assert 0.3 < cut.mean() < 0.99
    at = located(made.profiles, 0.7)
    used = cut & at.valid
    assert used.sum() > 30
    assert (cut & ~at.valid).sum() > 30
    off = at.position - made.truth
    # shading hides behind what is clipped, all to one side
    assert abs(off[used].mean()) < 0.02
    assert 0.3 < rms((off / at.sigma)[used]) < 1.2


def test_what_is_cut_off_widens_the_sigma():
    """Well-exposed profiles with their inner samples withheld: larger errors, and sigma
    to match.
    """
    made = make(5, half_width=(9, 50))  # wide enough for all samples to be used
    assert np.all(made.profiles.cut == 0)
    whole = located(made.profiles, 0.7)
    for cut, wider in ((2, 1.1), (5, 1.3)):
        part = replace(made.profiles, cut=np.full(len(made.truth), cut))
        at = located(part, 0.7)
        assert np.median(at.sigma / whole.sigma) > wider
        off = at.position - made.truth
        assert rms(off) > 1.1 * rms(whole.position - made.truth)
        assert rms((off / at.sigma)[at.valid]) < 1.2


def test_clipped_samples_that_are_not_cut_would_bias():
    """The same profiles with the clipped samples used: several times further off."""
    made = make(5, 600, gain=1.7, albedo=(150, 230))
    blind = replace(made.profiles, cut=np.zeros_like(made.profiles.cut))
    cut = located(made.profiles, 0.7)
    used = (made.profiles.cut > 0) & cut.valid
    naive = located(blind, 0.7).position - made.truth
    assert rms(naive[used]) > 1.5 * rms((cut.position - made.truth)[used])


def test_cut_of_reaches_to_the_outermost_saturated_sample():
    saturated = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [1, 0, 1, 0], [0, 0, 0, 1]], dtype=bool)
    # profiles of four samples would be all outside: a wide leg keeps every unsaturated one
    offsets = PROFILE_OPTIONS.profile_offsets
    wide = np.zeros((4, len(offsets)), dtype=bool)
    wide[:, :4] = saturated
    assert cut_of(wide, np.full(4, 40.0)).tolist() == [0, 1, 3, 4]


def test_slim_legs_are_looked_at_near_their_limb_only():
    """Under half of the half width, where shading is diffuse; never less than a pixel and a bit."""
    offsets = PROFILE_OPTIONS.profile_offsets
    width = np.array([2.0, 5.0, 8.0, 50.0])
    cut = cut_of(np.zeros((4, len(offsets)), dtype=bool), width)
    depth = -offsets[cut]
    assert depth.tolist() == [1.0, 2.0, 3.0, 3.0]
    assert np.all(depth <= np.maximum(0.45 * width, 1.25))


def test_a_highlight_is_not_taken_for_the_limb():
    """Its outer border lies up to a pixel within the limb, and is the likelier edge of the two."""
    dark = {"albedo": (20, 30), "ground": (30, 60), "light": FRONTAL, "least_contrast": 2}
    made = make(8, half_width=(7, 14), lamp=10.0, **dark)
    less, highlight = without_highlights(made.profiles, {0: 0.7})
    assert highlight.mean() > 0.85
    at = located(less, 0.7)
    off = at.position - made.truth
    assert rms(off[at.valid & highlight]) > 0.9
    assert rms(off[at.valid & ~highlight]) < 0.3


def test_what_lies_beyond_a_highlights_middle_is_left_out():
    """If the highlight has less contrast than the limb itself, the profile is used."""
    dark = {"albedo": (20, 30), "ground": (30, 60), "light": FRONTAL, "least_contrast": 2}
    made = make(8, half_width=(7, 14), lamp=3.0, **dark)
    less, highlight = without_highlights(made.profiles, {0: 0.7})
    assert np.mean(less.cut > made.profiles.cut) > 0.9
    cut, whole = located(less, 0.7), located(made.profiles, 0.7)
    off, before = (np.abs(at.position - made.truth)[at.valid] for at in (cut, whole))
    assert cut.valid.sum() > whole.valid.sum()
    assert np.mean(off > 0.5) < 0.5 * np.mean(before > 0.5)
    assert rms(off) < 0.7 * rms(before)
    assert rms(off[~highlight[cut.valid]]) < 0.8 * rms(off)


def test_diffuse_light_is_kept():
    """The limb of a matt tube under a lamp from the side turns from light to dark as well."""
    made = make(5, half_width=(9, 50))
    less, highlight = without_highlights(made.profiles, {0: 0.7})
    assert np.mean(less.cut > made.profiles.cut) < 0.02
    assert not highlight.any()


def test_paint_with_the_light_behind_it_shows_no_highlight():
    """Its limbs are bright strips too, of which the model is true."""
    made = make(5, half_width=(9, 50), light=(1.5, 2.2), least_contrast=20)
    less, highlight = without_highlights(made.profiles, {0: 0.7})
    assert np.mean(less.cut > made.profiles.cut) > 0.2
    assert highlight.mean() < 0.01


@pytest.mark.parametrize(
    "blur",
    [0.5, 0.7, 1.2,
     *(pytest.param(blur, marks=pytest.mark.slow) for blur in (0.55, 0.63, 0.85, 1.0))],
)  # fmt: skip
def test_the_blur_is_recovered(blur):
    """To 0.03 px: half a hundredth of a pixel in the edges' places comes from 0.005 px of it."""
    assert estimate_blur(make(6, 300, blur=blur).profiles) == pytest.approx(blur, abs=0.03)


def test_the_blur_survives_profiles_of_something_else():
    """A third of the profiles are ramps and noise; the median is over the others."""
    made = make(7, 300).profiles
    grey = made.grey.copy()
    rng = np.random.default_rng(0)
    grey[::3] = 100 + 20 * rng.normal(size=grey[::3].shape)
    assert estimate_blur(replace(made, grey=grey)) == pytest.approx(0.7, abs=0.05)


@pytest.mark.parametrize("blur", [0.5, 0.5125, 0.6, 0.613, 0.7, 0.774, 0.8, 0.849])
def test_the_place_does_not_depend_on_the_blurs_digits(blur):
    """A plain step, whatever the blur: blurred by a table of even length, the model would stand
    0.025 px aside. The parabola through trial positions 0.1 px apart leaves 0.005 to 0.012."""
    step = np.where(PLACE < 0, 180.0, 40.0)
    level = blurred(step, blur)
    truth = np.linspace(-1, 1, 9)
    grey = np.stack([np.interp(PROFILE_OPTIONS.profile_offsets - t, PLACE, level) for t in truth])
    profiles = plain(grey, 12.0)
    at = located(profiles, blur)
    assert at.valid.all()
    np.testing.assert_allclose(at.position, truth, atol=0.014)


def test_profiles_of_many_widths_cuts_and_blurs_are_worked_out_as_each_by_itself():
    profiles, rng = make(22, 60, half_width=(2, 90)).profiles, np.random.default_rng(22)
    cut = rng.integers(0, len(PROFILE_OPTIONS.profile_offsets) - 2, len(profiles.cut))
    mixed = replace(profiles, cut=cut, station=rng.choice([0, 3, 7], len(cut)))
    blur = {0: 0.7, 3: 0.5, 7: 1.1}
    together = residual_curves(mixed, blur)
    alone = [residual_curves(mixed.select(np.array([k])), blur)[0] for k in range(len(cut))]
    np.testing.assert_allclose(together, alone, rtol=1e-9, atol=1e-14)


def test_where_there_is_no_edge_none_is_found():
    rng = np.random.default_rng(8)
    for noise in (0.2, 1.0, 5.0):
        grey = 120 + noise * rng.normal(size=(200, len(PROFILE_OPTIONS.profile_offsets)))
        flat = plain(grey, 12.0)
        assert located(flat, 0.7).valid.mean() < 0.01


@pytest.mark.parametrize("away", [-2.5, -1.7, 1.7])
def test_an_edge_out_of_reach_is_not_found(away):
    level = blurred(Limb(12, 0.8, 200, 30, 0.0).brightness(), 0.7)
    grey = np.interp(PROFILE_OPTIONS.profile_offsets - away, PLACE, level)[None]
    alone = plain(grey, 12.0)
    assert not located(alone, 0.7).valid.any()
