"""Products by pieces (`multipos.numerics.factoring`)."""

import numpy as np
from numpy.testing import assert_allclose

from multipos.numerics.cofactors import cofactors_of
from multipos.numerics.factoring import gram


def test_gram_by_pieces_is_the_product():
    X = np.random.default_rng(1).standard_normal((1003, 60))
    assert_allclose(gram(X), X.T @ X, rtol=0, atol=1e-11)
    assert_allclose(gram(X[:3]), X[:3].T @ X[:3], rtol=0, atol=1e-13)


def test_cofactors_are_the_determinant_times_the_inverse():
    matrices = np.random.default_rng(3).normal(size=(5, 3, 3))
    expected = np.linalg.det(matrices)[:, None, None] * np.linalg.inv(matrices)
    found = cofactors_of(np.moveaxis(matrices, 0, 2))
    np.testing.assert_allclose(np.moveaxis(found, 2, 0), expected.transpose(0, 2, 1), rtol=1e-9)
