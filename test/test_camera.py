"""Cameras: consistency of pixels and rays for every lens model."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monoforce_ros.bags import builders
from monoforce_ros.core import CameraModel
from monoforce_ros.messages import MessageError
from monoforce_ros.messages.decoding import decode_camera_info

MATRIX = np.array([[300.0, 0, 321.5], [0, 305.0, 238.0], [0, 0, 1]])
LENSES = {
    "none": ("plumb_bob", []),
    "plumb_bob": ("plumb_bob", [-0.22, 0.065, -0.0001, -0.0002, 0.0]),
    "rational": ("plumb_bob", [0.224, -0.0219, -4e-7, -1e-6, 0.0015, 0.4906, -0.026, 0.0019]),
    "fisheye": ("equidistant", [0.02, -0.004, 0.001, 0.0]),
}


def camera(lens: str) -> CameraModel:
    skew = 12.0 if lens.startswith("skewed") else 0.0
    model, coefficients = LENSES[{"skewed": "plumb_bob", "skewed fisheye": "fisheye"}.get(lens, lens)]
    matrix = MATRIX + np.array([[0.0, skew, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    return CameraModel(640, 480, matrix, np.array(coefficients), model)


@pytest.mark.parametrize("lens", [*LENSES, "skewed", "skewed fisheye"])
@given(u=st.floats(0, 639), v=st.floats(0, 479), depth=st.floats(0.3, 50))
@settings(max_examples=40, deadline=None)
def test_a_ray_projects_back_to_its_pixel(lens, u, v, depth):
    model = camera(lens)
    pixels, inside = model.project(depth * model.rays(np.array([u, v])))
    assert inside[0]
    np.testing.assert_allclose(pixels[0], [u, v], atol=0.05)


@pytest.mark.parametrize(
    ("coefficients", "focal"),
    [([0.0, 0.0, 0.0, 0.0], 180.0), ([-0.0075, 0.0445, -0.0418, 0.0073], 286.0), ([0.02, -0.004, 0.001, 0.0], 200.0)],
)
def test_a_wide_fisheye_has_rays_by_its_polynomial_and_none_beyond_80_degrees(coefficients, focal):
    """Pixels by the polynomial of Kannala and Brandt, up to the black corners around a circular image."""
    matrix = np.array([[focal, 0, 424.0], [0, focal, 400.0], [0, 0, 1]])
    lens = CameraModel(848, 800, matrix, np.array(coefficients), "equidistant")

    def radius(angle):
        return angle * (1.0 + sum(k * angle ** (2 * n + 2) for n, k in enumerate(coefficients)))

    directions = np.random.default_rng(0).uniform(-np.pi, np.pi, 200)
    angles = np.linspace(0.01, np.radians(100.0), 200)
    pixels = matrix[:2, 2] + focal * radius(angles)[:, None] * np.c_[np.cos(directions), np.sin(directions)]
    rays = lens.rays(pixels)
    known = angles < np.radians(79.9)
    monotone = np.gradient(radius(angles), angles) > 0
    found = np.arctan(np.linalg.norm(rays[known, :2], axis=1))
    np.testing.assert_allclose(found, angles[known], atol=1e-6)
    np.testing.assert_allclose(np.arctan2(rays[known, 1], rays[known, 0]), directions[known], atol=1e-6)
    assert np.isnan(rays[(angles > np.radians(80.1)) & monotone, :2]).all()
    # Points are seen up to the same angle, also where no pixel of the border has a ray.
    points = np.c_[np.sin(angles) * np.cos(directions), np.sin(angles) * np.sin(directions), np.cos(angles)] * 3.0
    placed, inside = lens.project(points)
    in_image = ((pixels > 0) & (pixels < [847, 799])).all(axis=1)
    assert (inside == (in_image & (angles <= np.radians(80.0)))).mean() > 0.98
    both = inside & in_image & known
    np.testing.assert_allclose(placed[both], pixels[both], atol=0.05)


@pytest.mark.parametrize("lens", LENSES)
def test_points_behind_or_far_to_the_side_of_the_camera_have_no_pixel(lens):
    points = np.array([[0, 0, -3.0], [30.0, 0, 1.0], [0, -40.0, 0.9], [0.0, 0.0, 0.0]])
    pixels, inside = camera(lens).project(points)
    assert not inside.any() and np.isnan(pixels).all()


def test_points_beyond_where_a_distortion_folds_have_no_pixel():
    """Of nearer ones they would get the pixels: here those at 60° from the axis the pixels of those at 45°."""
    matrix = np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]])
    camera = CameraModel(640, 480, matrix, np.array([-0.37, 0.12, 0, 0, -0.02]), "plumb_bob", "camera")
    camera.check()
    along = np.array([0.8, 0.6])
    slopes = np.linspace(0.05, 2.5, 100)
    pixels, inside = camera.project(np.c_[slopes[:, None] * along, np.ones(100)])
    radii = np.linalg.norm(pixels - matrix[:2, 2], axis=1)[inside]
    assert (np.diff(radii) > 0.0).all() and slopes[inside].max() > 0.9
    assert not inside[slopes > 1.6].any()


def test_skew_moves_what_lies_below_the_axis_to_the_right():
    straight, skewed = camera("none"), CameraModel(640, 480, MATRIX + np.eye(3, k=1) * [[12.0], [0], [0]], np.zeros(5))
    point = np.array([[0.2, 0.5, 1.0]])
    np.testing.assert_allclose(skewed.project(point)[0] - straight.project(point)[0], [[6.0, 0.0]], atol=1e-9)


@pytest.mark.parametrize("lens", ["plumb_bob", "skewed"])
def test_a_resized_image_keeps_its_rays(lens):
    model = camera(lens)
    half = model.resized(320, 240)
    np.testing.assert_allclose(half.rays(np.array([100.0, 60.0])), model.rays(np.array([200.5, 120.5])), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"matrix": np.zeros((3, 3))}, "not calibrated"),
        ({"distortion": np.zeros(3)}, "expected 0, 4, 5, 8, 12 or 14"),
        ({"distortion_model": "wide"}, "got 'wide'"),
        ({"width": 0}, "expected at least one pixel"),
        ({"distortion_model": "equidistant", "distortion": np.full(5, 0.01)}, "'equidistant', expected 4 coefficients"),
        ({"matrix": np.full((3, 3), np.nan)}, "finite"),
    ],
)
def test_invalid_calibrations_are_refused(change, message):
    fields = {"width": 640, "height": 480, "matrix": MATRIX, "distortion": np.zeros(5)} | change
    with pytest.raises(ValueError, match=message):
        CameraModel(**fields)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"distortion": np.array([1e6, 0.0, 0.0, 0.0, 0.0])}, "a lens would show only"),
        # Coefficients of a fisheye, read as those of a pinhole with distortion.
        ({"distortion": np.array([-4.0, 9.0, 0.0, 0.0, -12.0])}, "a lens would show only"),
        ({"distortion_model": "equidistant", "distortion": np.array([-5.0, 3.0, 0.0, 0.0])}, "a lens would show only"),
        ({"matrix": np.array([[400.0, 0, 1e5], [0, 400.0, 240], [0, 0, 1]])}, "principal point"),
        ({"matrix": np.array([[400.0, 0, 640], [0, 400.0, 480], [0, 0, 1]])}, "is the matrix that of a larger image"),
        # Of 1280 × 720, 1920 × 1080 and 320 × 240 px.
        ({"matrix": np.array([[600.0, 0, 640], [0, 600.0, 360], [0, 0, 1]])}, "is the matrix that of a larger image"),
        ({"matrix": np.array([[900.0, 0, 960], [0, 900.0, 540], [0, 0, 1]])}, "is the matrix that of a larger image"),
        ({"matrix": np.array([[160.0, 0, 160], [0, 160.0, 120], [0, 0, 1]])}, "is the matrix that of a smaller image"),
        ({"matrix": np.array([[400.0, 0, 0], [0, 400.0, 0], [0, 0, 1]])}, "is the matrix that of a smaller image"),
        ({"matrix": np.eye(3)}, "are they in pixels"),
        ({"matrix": np.diag([3.6, 3.6, 1.0])}, "are they in pixels"),
        ({"matrix": np.diag([1e6, 1e6, 1.0])}, "are they in pixels"),
        ({"matrix": np.diag([100.0, 900.0, 1.0])}, "expected a ratio of at most 3"),
        ({"matrix": MATRIX.T}, r"expected \[\[fx, s, cx\]"),
    ],
)
def test_calibrations_of_no_lens_are_refused(change, message):
    fields = {"width": 640, "height": 480, "matrix": MATRIX, "distortion": np.zeros(5)} | change
    with pytest.raises(ValueError, match=message):
        CameraModel(**fields).check()


def test_a_region_of_an_image_beside_the_axis_passes():
    """Cut off by the driver, which shifted the principal point, in both directions."""
    matrix = np.array([[400.0, 0, 640 * 0.34], [0, 400.0, 480 * 0.24], [0, 0, 1]])
    CameraModel(640, 480, matrix, np.zeros(5)).check()


@pytest.mark.parametrize("lens", LENSES)
def test_calibrations_of_lenses_pass(lens):
    model = camera(lens)
    model.check()
    # A crop beside the optical axis, and one far finer.
    beside = model.matrix + np.array([[0, 0, 900.0], [0, 0, 0], [0, 0, 0]])
    CameraModel(model.width, model.height, beside, np.zeros(0)).check()
    model.resized(4 * model.width, 4 * model.height).check()


@pytest.mark.parametrize(
    ("width", "height", "focal"),
    [(1920, 1080, 344), (1280, 720, 223), (1280, 960, 282), (1024, 1024, 293), (1024, 1024, 267), (640, 480, 120)],
)
def test_circular_fisheyes_with_black_corners_pass(width, height, focal):
    """Of 180° to 220°; in half of the image, and beyond 90°, pixels have no ray with z > 0."""
    matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    for coefficients in ([0.0] * 4, [0.02, -0.004, 0.001, 0.0], [-0.03, 0.002, -0.001, 0.0]):
        CameraModel(width, height, matrix, np.array(coefficients), "equidistant").check()


def test_binned_images_and_regions_have_the_rays_of_the_calibrated_one():
    """CameraInfo describes the whole sensor; the image that is sent is a region of it, with pixels combined."""
    info = builders.camera_info(0, "camera", 640, 480, MATRIX, [0.0] * 5)
    full = decode_camera_info(info)
    info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height = 100, 40, 400, 200
    info.binning_x = info.binning_y = 2
    part = decode_camera_info(info)
    assert (part.width, part.height) == (200, 100)
    np.testing.assert_allclose(part.rays(np.array([30.0, 20.0])), full.rays(np.array([160.5, 80.5])), atol=1e-9)
    info.roi.width = 600
    with pytest.raises(MessageError, match=r"roi: got 600 × 200 px at \(100, 40\), expected a part of 640 × 480"):
        decode_camera_info(info)


def test_coefficients_of_a_fisheye_may_be_padded_with_zeros():
    padded = CameraModel(640, 480, MATRIX, np.array([-0.02, 0.003, 0.0, 0.0, 0.0]), "equidistant")
    padded.check()


@pytest.mark.parametrize("name", ["none", "NONE", "pinhole", "undistorted", ""])
def test_names_of_no_distortion_are_harmless_without_coefficients(name):
    for coefficients in ([], [0.0] * 3, [0.0] * 5):
        assert not decode_camera_info(builders.camera_info(0, "c", 640, 480, MATRIX, coefficients, name)).is_distorted
    if name:
        with pytest.raises(MessageError, match="distortion model"):
            decode_camera_info(builders.camera_info(0, "c", 640, 480, MATRIX, [-0.2, 0.05, 0.0, 0.0, 0.0], name))
