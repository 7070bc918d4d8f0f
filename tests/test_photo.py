"""Cameras refined on a photo: what colours tell, where they tell nothing, and what is refused."""

import jax
import numpy as np
import pytest
from masks import wavy
from numpy.testing import assert_allclose, assert_array_equal
from oracles import body, drawn, lump, turned, usual_camera
from refusals import refusal, refuses
from scipy.ndimage import binary_dilation, gaussian_filter
from scipy.spatial.transform import Rotation

import pinhole_jax as pj

CAMERA = usual_camera(192, 160)
START = turned(CAMERA, 3)
TURN = Rotation.from_euler("y", 120, degrees=True).as_matrix()
SCENE = lump(3)
SHOWN = drawn(CAMERA, SCENE)
FRONT, BACK = np.array([0.7, 0.3, 0.1]), np.array([0.1, 0.3, 0.5])


def photo_of(shown, front=FRONT, back=BACK):
    """Return a noisy uint8 photo: light mixes, blurs a little, and is then seen as sRGB."""
    random = np.random.default_rng(0)
    light = shown[..., None] * front + (1 - shown[..., None]) * back
    light = gaussian_filter(light, (0.8, 0.8, 0))
    srgb = 1.055 * light ** (1 / 2.4) - 0.055
    noisy = srgb + 0.02 * random.normal(size=srgb.shape)
    return np.round(255 * np.clip(noisy, 0, 1)).astype(np.uint8)


def grown(shown):
    return binary_dilation(shown > 0.5, iterations=2)


def fitted(mask, photo=None, **more):
    return pj.fit_camera(SCENE, mask, START, photo=photo, **more)


def off(fit):
    """A camera's error: degrees, and a share of the distance."""
    angle, shift = pj.pose_error(fit.camera, CAMERA)
    return np.array([np.rad2deg(angle), shift / 5])


def test_photo_corrects_a_grown_mask():
    by_mask, fit = fitted(grown(SHOWN)), fitted(grown(SHOWN), photo_of(SHOWN))
    assert np.all(off(fit) < off(by_mask) / 6)
    assert fit.status == "converged"
    assert "fitted to the photo" in fit.weak[-1]
    assert "px too large" in fit.weak[-1]
    # What is reported beside it is the mask's: it is larger than what is seen.
    assert abs(fit.iou - np.sum(SHOWN) / np.sum(grown(SHOWN))) < 0.01

    floats = photo_of(SHOWN).astype(np.float32) / 255
    again = fitted(grown(SHOWN), floats)
    assert_allclose(pj.pose_error(again.camera, fit.camera), 0, atol=1e-4)


def test_right_mask_is_kept():
    for mask in (SHOWN, SHOWN > 0.5):
        by_mask, fit = fitted(mask), fitted(mask, photo_of(SHOWN))
        assert "fitted to the mask: its edge" in fit.weak[-1]
        assert_array_equal(fit.camera.e, by_mask.camera.e)
        assert_array_equal(fit.covariance, by_mask.covariance)


def test_photo_decides_between_cameras_that_a_mask_leaves_open():
    mask = wavy(SHOWN, np.random.default_rng(3), 3, 15)
    by_mask, fit = fitted(mask), fitted(mask, photo_of(SHOWN))
    assert (by_mask.status, fit.status) == ("ambiguous", "converged")
    assert not fit.modes
    assert off(fit)[0] < 0.1


@pytest.mark.parametrize("mask", [SHOWN, SHOWN > 0.5])
def test_photo_beside_a_mask_that_errs_nowhere_is_of_another_camera(mask):
    fit = fitted(mask, photo_of(np.roll(SHOWN, 3, axis=1)))
    assert fit.status == "misfit"
    assert "not of one camera" in fit.weak[0]


@pytest.mark.long
def test_colours_that_tell_nothing_leave_the_mask_alone():
    by_mask = fitted(grown(SHOWN))
    for photo in (photo_of(SHOWN, BACK, BACK), photo_of(np.roll(SHOWN, 120, axis=1))):
        fit = fitted(grown(SHOWN), photo)
        assert "fitted to the mask: the photo shows" in fit.weak[-1]
        assert_array_equal(fit.camera.e, by_mask.camera.e)


def beside(masks, photos):
    """Return views of the scene in place, and turned by a third of a circle."""
    given = zip(masks, photos, (None, np.pad(TURN, (0, 1)) + np.diag([0, 0, 0, 1])), strict=True)
    return [pj.JointView(SCENE, mask, photo=photo, placed=at) for mask, photo, at in given]


def turned_away():
    """The mask of the second view of `beside`."""
    vertices = np.asarray(SCENE.mesh.vertices) @ TURN.T
    return drawn(CAMERA, body(vertices, SCENE.mesh.faces))


@pytest.mark.long
def test_photos_put_grown_masks_right_together():
    seen = [SHOWN, turned_away()]
    masks, pictures = [grown(x) for x in seen], [photo_of(x) for x in seen]
    by_masks = pj.fit_joint(beside(masks, (None, None)), START)
    fit = pj.fit_joint(beside(masks, pictures), START)
    errors = [off(f.cameras["camera"]) for f in (fit, by_masks)]
    assert np.all(errors[0] < errors[1] / 6)
    assert fit.status == "converged"
    for k, words in enumerate(fit.weak):
        assert words.startswith(f"view {k}: fitted to the photo")
    # (A sixth of the error, but any edge may be biased by half a px.)
    assert np.all(fit.cameras["camera"].std < by_masks.cameras["camera"].std / 1.5)

    # A photo of something else is not believed, nor does it spoil the other's.
    pictures[1] = photo_of(np.roll(seen[1], 120, axis=1))
    fit = pj.fit_joint(beside(masks, pictures), START)
    assert fit.weak[-2].startswith("view 0: fitted to the photo")
    assert "fitted to the mask" in fit.weak[-1]
    assert np.all(off(fit.cameras["camera"]) < errors[1] / 3)


def test_view_with_a_bad_photo_is_named():
    views = beside([SHOWN, SHOWN], [None, PHOTO[:, :100]])
    with refusal(r"`views\[1\]`: `photo`: expected .* \(160, 192, 3\)"):
        pj.fit_joint(views, START)


def test_pixels_of_zero_weight_do_not_count_in_the_photo():
    photo, mask, weight = photo_of(SHOWN), grown(SHOWN), np.ones(SHOWN.shape)
    photo[:, :80], mask[:, :80], weight[:, :80] = (220, 0, 220), False, 0
    fit = fitted(mask, photo, weight=weight)
    assert "fitted to the photo" in fit.weak[-1]
    assert np.all(off(fit) < [0.5, 0.01])


PHOTO = np.zeros((160, 192, 3), np.uint8)


test_photos_are_checked_at_the_door = refuses(
    pj.fit_camera,
    {"scene": SCENE, "target": SHOWN, "camera": START},
    {
        r"`photo`: expected .* \(160, 192, 3\), got shape \(160, 100, 3\)": {
            "photo": PHOTO[:, :100]
        },
        r"got shape \(160, 192\); stack a grey photo": {"photo": PHOTO[..., 0]},
        r"give `photo\[..., :3\]`": {"photo": np.zeros((160, 192, 4), np.uint8)},
        "`photo`: expected dtype uint8 or float, got int64": {"photo": PHOTO.astype(int)},
        r"`photo`: expected floats in \[0, 1\], got 200 to 200": {"photo": PHOTO + 200.0},
        r"`photo`: expected finite values, got nan at \[0, 0": {
            "photo": np.where(PHOTO == 0, np.nan, 1.0)
        },
    },
)


def test_fit_on_a_photo_is_not_differentiated():
    with refusal("`photo`: expected none where the fit is differentiated"):
        jax.grad(lambda target: fitted(target, photo_of(SHOWN)).camera.e[0])(SHOWN)
