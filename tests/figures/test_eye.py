"""The eye over a surface: seen from where the valley lies open."""

import numpy as np
import pytest

from figures.eye import RISES, eye_over, hidden_points


def test_a_surface_is_seen_from_where_its_valley_is_nothidden_points():
    x, y = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21), indexing="ij")
    for toward in ((1, -1), (1, 1), (-1, -1), (-1, 1)):  # a quarter alone is low, behind walls
        wall = np.where((x * toward[0] > 0) & (y * toward[1] > 0), 0.0, 1.0)
        assert (*np.sign(eye_over(wall, 1.0)[:2]),) == toward
    pit = np.where(np.hypot(x, y) < 0.3, 0.0, 1.0)  # steep all around, and deeper than wide: from above alone
    flat, deep = eye_over(np.zeros((5, 7)), 1.0), eye_over(pit, 1.0)
    rises = [eye[2] / np.hypot(*eye[:2]) for eye in (flat, deep)]
    assert rises == pytest.approx([RISES[0], RISES[-1]])
    assert not hidden_points(np.zeros((5, 7)), np.array([0.6, 0.8]), 0.1).any()
    ridge = np.zeros((21, 3))
    ridge[15] = 1.0  # hides what is behind it, as far as its height over the rise
    hidden = hidden_points(ridge, np.array([1.0, 0.0]), 2.0)[:, 1]
    assert hidden.tolist() == [10 < i < 15 for i in range(21)]
