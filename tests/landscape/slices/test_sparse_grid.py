import numpy as np
import pytest

from landscape.slices.sparse_grid import SparseGrid, hierarchy

UNEVEN = np.sort(np.random.default_rng(0).uniform(-1, 1, 22))


def interpolated(f, x, y, points=None):
    """The interpolant of f from the points (all by default) and their ancestors."""
    grid, values = SparseGrid(x, y), f(x[:, None], y[None, :]).ravel()
    nodes = grid.with_ancestors(range(values.size) if points is None else points)
    grid.insert(nodes, values[nodes])
    return grid, values.reshape(grid.shape)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 10, 33, 41])
def test_every_coordinate_is_a_node_of_the_tree_below_its_parent(n):
    tree = hierarchy(np.linspace(0, 1, n))
    below = tree.parent >= 0
    assert (tree.parent == -1).sum() == 1 and tree.level[n // 2] == 0
    assert (tree.level[below] == tree.level[tree.parent[below]] + 1).all()
    assert tree.level.max() <= 1 + np.ceil(np.log2(n))


def test_a_basis_function_is_one_at_its_node_and_zero_outside_its_subtree():
    tree = hierarchy(UNEVEN)
    for node, (support, basis) in enumerate(zip(tree.support, tree.basis, strict=True)):
        full = np.zeros(len(UNEVEN))
        full[support] = basis
        below = [other for other in range(len(UNEVEN)) if node in tree.ancestry(other)]
        assert full[node] == 1 and not np.delete(full, below).any()


def test_where_every_point_is_a_node_the_interpolant_is_the_function():
    random = np.random.default_rng(1)
    values = random.standard_normal((22, 7))
    grid, _ = interpolated(lambda x, y: values, UNEVEN, UNEVEN[:7])
    assert abs(grid.interpolant - values).max() < 1e-14 and grid.node.all()


def test_a_sum_of_functions_of_one_axis_needs_only_the_two_axes():
    x, y = UNEVEN, UNEVEN[:9]
    axes = [i * 9 + 4 for i in range(22)] + [11 * 9 + j for j in range(9)]
    grid, values = interpolated(lambda x, y: abs(x) + np.sign(y) * y**3, x, y, axes)
    assert grid.node.sum() == 30 and abs(grid.interpolant - values).max() < 1e-14


def test_products_of_parabolas_are_exact_from_two_intervals_a_side():
    five = [int(i) for i in np.flatnonzero(hierarchy(UNEVEN).level <= 2)]
    points = [22 * i + j for i in five for j in five]
    grid, values = interpolated(lambda x, y: (x**2 - x) * (2 * y**2 + y) + x, UNEVEN, UNEVEN, points)
    # each half of an axis has three nodes
    assert grid.node.sum() == 25 and abs(grid.interpolant - values).max() < 1e-14


def test_doubt_is_the_error_of_predicting_the_parent_and_zero_at_nodes():
    x = np.linspace(-1, 1, 9)
    grid, values = SparseGrid(x, x), abs(x[:, None] - 0.5).repeat(9, axis=1).ravel()
    coarse = grid.with_ancestors(grid.coarse())
    grid.insert(coarse, values[coarse])
    doubt = grid.doubt().reshape(9, 9)
    # between 0 and 1 the line says 1/2 at the kink, where the function is 0; (6, 0) lies below (6, 4)
    assert grid.node[6, 4] and not grid.node[6, 0] and doubt[6, 0] == 0.5
    # at -1/2 the line is right
    assert grid.node[2, 4] and not grid.node[2, 0] and doubt[2, 0] == 0
    assert doubt[grid.node].max() == 0


def test_ancestors_come_first_and_nodes_are_not_named_again():
    x = np.linspace(-1, 1, 17)
    grid = SparseGrid(x, x)
    nodes = grid.with_ancestors([17 * 3 + 5]).tolist()
    assert len(nodes) == len(grid.axes[0].ancestry(3)) * len(grid.axes[1].ancestry(5)) == 25
    for index, node in enumerate(nodes):
        for axis, position in enumerate(divmod(node, 17)):
            parent = int(grid.axes[axis].parent[position])
            if parent >= 0:
                above = parent * 17 + node % 17 if axis == 0 else (node // 17) * 17 + parent
                assert above in nodes[:index]
    grid.insert(np.array(nodes[:6]), np.zeros(6))
    assert grid.with_ancestors([17 * 3 + 5]).tolist() == nodes[6:]


def test_a_value_that_is_not_finite_affects_only_the_doubt_of_its_children():
    x = np.linspace(-1, 1, 9)
    grid, values = SparseGrid(x, np.zeros(1)), x**2
    values[8] = np.nan
    coarse = np.array([4, 0, 8, 2, 6])
    grid.insert(coarse, values[coarse])
    assert np.isfinite(grid.interpolant).all() and np.flatnonzero(np.isinf(grid.doubt())).size == 0
    other = SparseGrid(x, np.zeros(1))
    other.insert(coarse[:3], values[coarse[:3]])
    assert np.flatnonzero(np.isinf(other.doubt())).tolist() == [6]
