from __future__ import annotations

import numpy as np
import pytest

from caryatid.geometry.linear import solve_positive


@pytest.mark.parametrize("size", [7, 8, 9])
def test_equations_are_solved_as_numpy_solves_them(size):
    rng = np.random.default_rng(size)
    for conditioned in (1.0, 1e-4, 1e-7):
        J = rng.normal(size=(40, size)) * np.geomspace(1.0, conditioned, size)
        A, b = J.T @ J, rng.normal(size=size)
        scaled = np.sqrt(np.diag(A))
        found = solve_positive(A.copy(), b.copy())
        np.testing.assert_allclose(found * scaled, np.linalg.solve(A, b) * scaled, rtol=1e-6)


def test_equations_without_a_solution_give_no_number():
    assert np.isnan(solve_positive(np.diag([1.0, -1.0, 1.0]), np.ones(3))).any()
