"""Values of the contract, the random ones made by other formulas than the code under test."""

import cv2
import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from vergence_proto.geometry import Matrix, Pose, RectifiedRig

RIG = RectifiedRig(8, 6, 10.0, 11.0, 3.5, 3.0, 2.5, 0.1)
NOT_FINITE = [float("nan"), float("inf"), -float("inf")]

# Whole turns, and turns so small that a careless formula loses them to rounding.
ANGLES = st.one_of(
    st.floats(-np.pi, np.pi),
    st.sampled_from([0.0, np.pi, -np.pi, np.pi / 2, 1e-3, 1e-7, 1e-12]),
)
DIRECTIONS = st.one_of(
    st.sampled_from([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]),
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
)
POSITIONS = arrays.arrays(np.float64, 3, elements=st.floats(-10, 10))


def rotation_about(direction: tuple[float, ...], angle: float) -> Matrix:
    """Rodrigues' formula, by OpenCV."""
    axis = np.array(direction) / np.linalg.norm(direction)
    return np.asarray(cv2.Rodrigues(axis * angle)[0], np.float64)


ROTATIONS = st.builds(rotation_about, DIRECTIONS, ANGLES)
POSES = st.builds(Pose, ROTATIONS, POSITIONS)
SMALL_POSES = st.builds(
    Pose,
    st.builds(rotation_about, DIRECTIONS, st.floats(-0.3, 0.3)),
    arrays.arrays(np.float64, 3, elements=st.floats(-0.3, 0.3)),
)
RIGS = st.builds(
    RectifiedRig,
    width=st.just(640),
    height=st.just(480),
    fx=st.floats(200, 900),
    fy=st.floats(200, 900),
    cx_left=st.floats(250, 390),
    cx_right=st.floats(250, 390),
    cy=st.floats(180, 300),
    baseline_m=st.floats(0.03, 0.6),
)


def assert_same_pose(actual: Pose, expected: Pose, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(actual.rotation, expected.rotation, rtol=0, atol=tolerance)
    np.testing.assert_allclose(actual.translation_m, expected.translation_m, rtol=0, atol=tolerance)
