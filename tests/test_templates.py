"""Patches of first sight: alignment of features to them in an image that a surface deforms."""

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2")

from ekfslam.frontend.template import Greys, Templates  # noqa: E402

CENTRE = np.array([[100.0, 80.0]])


def texture(seed, blur_px, contrast):
    """Random image of a contrast, smooth over some pixels, about level 128."""
    grey = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal((160, 200)), (0, 0), blur_px)
    return 128.0 + contrast * grey / grey.std()


def seen_as(image, shape, to_px):
    """Image in which offsets from `CENTRE` are mapped by a shape (2, 2), about a pixel."""
    M = np.linalg.inv(shape)
    onto = np.column_stack([M, CENTRE[0] - M @ to_px])
    return cv2.warpAffine(image, onto, image.shape[1::-1], flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)


def picture(grey, seed=None):
    noise = 0.0 if seed is None else 2.0 * np.random.default_rng(seed).standard_normal(grey.shape)
    return Greys(np.clip(np.round(grey + noise), 0, 255).astype(np.uint8))


@pytest.mark.parametrize("seed", range(4))
def test_a_patch_that_is_sheared_scaled_and_dimmed_is_found_where_it_is(seed):
    image, shape = texture(seed, 2.0, 30.0), np.array([[1.1, 0.15], [-0.05, 0.9]])
    at = np.array([91.3, 84.6])
    patches = Templates.of(picture(image), CENTRE)
    now = picture(20.0 + 0.8 * seen_as(image, shape, at))
    found, found_shape, score = at[None] + [0.6, -0.4], patches.shape, None
    for _ in range(3):  # frames: the prior lets a shape change slowly
        found, found_shape, score = patches.align(now, found, found_shape)
    np.testing.assert_allclose(found[0], at, atol=0.06)
    np.testing.assert_allclose(found_shape[0], shape, atol=0.04)
    assert score[0] > 0.97


def test_a_shape_that_texture_does_not_tell_is_kept():
    ramp = 128.0 + 0.5 * (np.arange(200.0) - 100.0) + np.zeros((160, 1))
    patches = Templates.of(picture(ramp), CENTRE, np.zeros(1, dtype=bool))
    _, shape, _ = patches.align(picture(ramp, seed=3), CENTRE, patches.shape)
    np.testing.assert_allclose(shape[0], np.eye(2), atol=0.05)


def test_only_patches_of_weak_texture_are_coarse():
    strong, weak = (picture(texture(1, 4.0, contrast)) for contrast in (40.0, 4.0))
    assert not Templates.of(strong, CENTRE).is_coarse[0]
    patches = Templates.of(weak, CENTRE)
    assert patches.is_coarse[0]
    np.testing.assert_array_equal(patches.shape, 2.0 * np.eye(2)[None])


def test_coarse_patches_are_found_more_exactly_where_texture_is_weak():
    image, off = texture(2, 6.0, 10.0), {}
    for is_coarse in (False, True):
        patches = Templates.of(picture(image), CENTRE, np.array([is_coarse]))
        found = [patches.align(picture(image, seed), CENTRE, patches.shape)[0][0] - CENTRE[0] for seed in range(15)]
        off[is_coarse] = np.linalg.norm(found, axis=1).mean()
    assert off[True] < 0.6 * off[False]


def test_noise_moves_a_patch_as_far_as_its_gradients_say():
    """Covariance ``sigma^2 S S^T`` with the solution S of the patch, and of the noise of the image alone."""
    image = texture(5, 1.5, 40.0)
    patches = Templates.of(picture(image), CENTRE)
    off = np.array([patches.align(picture(image, k), CENTRE, patches.shape)[0][0] - CENTRE[0] for k in range(60)])
    stated = 2.0 * np.linalg.norm(patches.solver[0, :2], axis=1)
    np.testing.assert_allclose(off.std(axis=0), stated, rtol=0.3)
