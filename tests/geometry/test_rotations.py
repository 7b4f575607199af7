"""Rotation vectors."""

import cv2
import numpy as np
import pytest

from pipeline.geometry.rotations import rotation_from_vector


@pytest.mark.parametrize("length", [0.0, 1e-9, 0.3, np.pi, 7.0])
def test_rotation_vectors_are_those_of_opencv(length):
    vector = length * np.array([2.0, -1.0, 2.0]) / 3
    np.testing.assert_allclose(rotation_from_vector(vector), cv2.Rodrigues(vector)[0], atol=1e-12)
