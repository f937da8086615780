"""A sensor that is turned by hand: truth, readings and what is known of the positions."""

from dataclasses import dataclass, field

import numpy as np

from multipos.numerics.rotations import step_on_sphere, tangent_basis
from multipos.positions.readings import Readings
from multipos.positions.scheme import read_scheme

BIAS = np.array([0.012, -0.02, 0.03])
MATRIX = np.array([[0.99, 0.012, -0.008], [-0.015, 1.015, 0.011], [0.009, -0.013, 1.004]])
QUADRATIC = np.array([8e-4, -6e-4, 5e-4])


@dataclass(frozen=True)
class Sensor:
    """y = bias + matrix f + quadratic f²."""

    bias: np.ndarray = field(default_factory=lambda: BIAS)
    matrix: np.ndarray = field(default_factory=lambda: MATRIX)
    quadratic: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def read(self, force):
        return self.bias + force @ self.matrix.T + self.quadratic * force**2

    def truth(self, model):
        """Return the parameters of a model that was built on ax, ay, az."""
        found = []
        for output, term in model.keys:
            i = model.outputs.index(output)
            axis = "xyz".find(str(term))
            found.append(
                self.bias[i]
                if str(term) == "1"
                else self.matrix[i, axis]
                if axis >= 0
                else self.quadratic[i]
            )
        return np.array(found)


def scatter(up, sd_deg, rng):
    """Return up vectors that are off by a step of N(0, sd²) about each of two axes."""
    step = np.radians(sd_deg) * rng.standard_normal((len(up), 2))
    return step_on_sphere(up, tangent_basis(up), step)


def readings_of(sensor, scheme, rng, *, sd=1e-5, off_deg=0.0, **known):
    """Return readings at positions of a scheme; they carry the up vectors as listed."""
    up = read_scheme(scheme).up if isinstance(scheme, str) else scheme
    force = scatter(up, off_deg, rng)
    values = sensor.read(force) + sd * rng.standard_normal(up.shape)
    return Readings(values, up=up, **known)


def lower(matrix):
    """Return the lower-triangular L with positive diagonal and L L' = M M'."""
    return np.linalg.cholesky(matrix @ matrix.T)
