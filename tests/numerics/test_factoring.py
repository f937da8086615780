"""Products by pieces (`multipos.numerics.factoring`)."""

import numpy as np
from numpy.testing import assert_allclose

from multipos.numerics.factoring import gram


def test_gram_by_pieces_is_the_product():
    X = np.random.default_rng(1).standard_normal((1003, 60))
    assert_allclose(gram(X), X.T @ X, rtol=0, atol=1e-11)
    assert_allclose(gram(X[:3]), X[:3].T @ X[:3], rtol=0, atol=1e-13)
