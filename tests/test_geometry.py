"""Rigid motions: algebraic laws, also near the identity and near an angle of pi, with MuJoCo and scipy as oracles."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from twin.core import geometry as g
from twin.scenes.gl import mujoco

settings.register_profile("compiling", deadline=None)  # the first call of a kernel includes its compilation
settings.load_profile("compiling")

ANGLES = st.one_of(
    st.floats(0, 1e-9), st.floats(1e-9, 1e-3), st.floats(1e-3, 3.0), st.floats(np.pi - 1e-3, np.pi - 1e-6)
)


@st.composite
def motions(draw):
    """Draws twists with angles from zero to just below pi."""
    direction = np.array([draw(st.floats(-1, 1)) for _ in range(3)]) + [0.0, 0.0, 1.5]
    rotation = draw(ANGLES) * direction / np.linalg.norm(direction)
    return np.concatenate([rotation, [draw(st.floats(-10, 10)) for _ in range(3)]])


@st.composite
def poses(draw):
    """Draws poses."""
    return g.exp(draw(motions()))


def wedge(motion):
    """Returns the matrix (4, 4) of a twist in the Lie algebra."""
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = g.skew(motion[:3]), motion[3:]
    return matrix


@given(motions())
def test_exp_is_the_matrix_exponential(motion):
    np.testing.assert_allclose(g.exp(motion), expm(wedge(motion)), atol=1e-11)


@given(motions())
def test_log_inverts_exp(motion):
    # Near pi the antisymmetric part of the matrix is 1e-6: relative precision 1e-16 / 1e-6 of the angle, times 10 m.
    np.testing.assert_allclose(g.log(g.exp(motion)), motion, atol=3e-8)


@given(poses())
def test_exp_inverts_log(pose):
    np.testing.assert_allclose(g.exp(g.log(pose)), pose, atol=1e-8)


@given(motions())
def test_the_derivative_of_log_agrees_with_finite_differences(motion):
    motion[:3] *= 0.9  # away from pi, where log is discontinuous
    step = 1e-6
    pairs = [[g.log(g.exp(motion) @ g.exp(sign * d)) for sign in (1, -1)] for d in np.eye(6) * step]
    numeric = np.column_stack([(ahead - behind) / (2 * step) for ahead, behind in pairs])
    np.testing.assert_allclose(g.log_derivative(motion), numeric, atol=1e-6)


@pytest.mark.parametrize("angle", [0.0999999, 0.1000001])
def test_the_derivative_of_log_is_continuous_where_its_series_ends(angle):
    motion = np.array([0.6, -0.48, 0.64, 3.0, -2.0, 1.0])
    motion[:3] *= angle
    other = motion.copy()
    other[:3] *= 0.1 / angle
    np.testing.assert_allclose(g.log_derivative(motion), g.log_derivative(other), atol=1e-6)


@given(poses(), poses())
def test_poses_compose_as_matrices_multiply(a, b):
    np.testing.assert_allclose(g.compose(a, b), a @ b, atol=1e-12)


def test_transformed_covariances_are_exactly_symmetric():
    rng = np.random.default_rng(0)
    matrix, root = rng.normal(size=(2, 6, 6))
    product = g.transform_covariance(matrix, root @ root.T)
    np.testing.assert_allclose(product, matrix @ root @ root.T @ matrix.T, atol=1e-12)
    np.testing.assert_array_equal(product, product.T)


@given(poses(), motions())
def test_the_covariance_of_a_transported_pose_is_that_of_its_error(a_from_b, error):
    """An error e of the pose of a is the error f of that of b with exp(e) a_from_b = a_from_b exp(f)."""
    moved = g.inverse(a_from_b) @ g.exp(1e-4 * error) @ a_from_b
    transported = g.log(moved) / 1e-4
    expected = np.outer(transported, transported)
    found = g.transport_covariance(np.outer(error, error), a_from_b)
    # log and exp of an error of 1e-4 rad are exact to 1e-4 of it squared
    np.testing.assert_allclose(found, expected, atol=1e-6 * max(1.0, np.abs(expected).max()))


def test_log_is_defined_at_an_angle_of_pi():
    half = g.pose(np.diag([1.0, -1.0, -1.0]), np.array([1.0, 2.0, 3.0]))
    assert np.linalg.norm(g.log(half)[:3]) == np.pi
    np.testing.assert_allclose(g.exp(g.log(half)), half, atol=1e-12)


@given(poses())
def test_the_product_of_a_pose_and_its_inverse_is_the_identity(pose):
    np.testing.assert_allclose(pose @ g.inverse(pose), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(g.inverse(g.inverse(pose)), pose, atol=1e-12)
    assert np.linalg.det(g.inverse(pose)[:3, :3]) > 0.999999


@given(poses(), motions())
def test_the_adjoint_transforms_a_motion_between_frames(pose, motion):
    np.testing.assert_allclose(pose @ g.exp(motion), g.exp(g.adjoint(pose) @ motion) @ pose, atol=1e-8)


@given(poses(), poses())
def test_the_adjoint_of_a_product_is_the_product_of_adjoints(a, b):
    np.testing.assert_allclose(g.adjoint(a @ b), g.adjoint(a) @ g.adjoint(b), atol=1e-10)


@given(poses(), poses())
def test_transforms_compose(a, b):
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 0.0]])
    np.testing.assert_allclose(g.transform(a @ b, points), g.transform(a, g.transform(b, points)), atol=1e-10)


@given(motions())
def test_quaternions_agree_with_mujoco(motion):
    rotation = g.so3_exp(motion[:3])
    quaternion, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    computed = g.quaternion_wxyz(rotation)
    np.testing.assert_allclose(computed, quaternion * np.sign(quaternion @ computed), atol=1e-9)
    mujoco.mju_quat2Mat(matrix, computed)
    np.testing.assert_allclose(matrix.reshape(3, 3), rotation, atol=1e-9)
    np.testing.assert_allclose(g.rotation_from_wxyz(computed), rotation, atol=1e-12)
    np.testing.assert_array_equal(g.quaternion_xyzw(rotation), np.roll(computed, -1))
    assert computed[0] >= 0


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_rpy_from_rotation_inverts_rotation_from_rpy(roll, pitch, yaw):
    np.testing.assert_allclose(
        g.rpy_from_rotation(g.rotation_from_rpy(roll, pitch, yaw)), [roll, pitch, yaw], atol=1e-9
    )


def test_roll_pitch_yaw_have_the_signs_of_the_body_axes():
    np.testing.assert_allclose(g.rotation_from_rpy(0.0, 0.0, np.pi / 2) @ [1, 0, 0], [0, 1, 0], atol=1e-12)  # bow north
    np.testing.assert_allclose(g.rotation_from_rpy(0.0, np.pi / 2, 0.0) @ [1, 0, 0], [0, 0, -1], atol=1e-12)  # bow down
    np.testing.assert_allclose(g.rotation_from_rpy(np.pi / 2, 0.0, 0.0) @ [0, 1, 0], [0, 0, 1], atol=1e-12)  # port up


@given(st.floats(-1e3, 1e3))
def test_wrapping_changes_an_angle_by_full_turns(angle):
    wrapped = g.wrap_angle(angle)
    assert -np.pi <= wrapped < np.pi
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-10)


@given(st.floats(-3.1, 3.1))
def test_the_heading_of_a_down_looking_camera_is_the_yaw_of_the_body(yaw):
    rotation = g.rotation_from_rpy(0.0, 0.0, yaw) @ g.BODY_FROM_DOWN_CAMERA
    np.testing.assert_allclose(g.heading_of_camera(g.pose(rotation, np.zeros(3))), yaw, atol=1e-12)


def test_camera_axes_are_right_down_forward():
    right, down, forward = g.BODY_FROM_DOWN_CAMERA.T
    np.testing.assert_array_equal(right, [0, -1, 0])  # starboard
    np.testing.assert_array_equal(down, [-1, 0, 0])  # the lower edge of the image points to the stern
    np.testing.assert_array_equal(forward, [0, 0, -1])  # the optical axis points to the floor


def test_the_nearest_rigid_motion_is_orthogonal_and_close():
    true = g.exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, 3.0]))
    perturbed = true + np.pad(np.full((3, 3), 1e-6), ((0, 1), (0, 1)))
    restored = g.nearest_rigid(perturbed)
    np.testing.assert_allclose(restored[:3, :3].T @ restored[:3, :3], np.eye(3), atol=1e-14)
    np.testing.assert_allclose(restored, true, atol=5e-6)
    np.testing.assert_allclose(g.nearest_rigid(np.stack([true, perturbed])), [true, restored], atol=1e-14)
