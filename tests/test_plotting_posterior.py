"""Figures of posteriors: what they show, and that they say so."""

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection

from ekfslam.data.simulate import builtin
from ekfslam.figures.posterior import block_patterns, plot_map_before_and_after, plot_sparsity
from ekfslam.runner import run
from ekfslam.smoother.posterior import posterior, smooth


@pytest.fixture(scope="module")
def world():
    return builtin("loop?frames=60")


@pytest.fixture(scope="module")
def full(world):
    return run(world, "full")


def test_maps_share_scale_and_units_and_show_ellipses(world, full):
    figure = plot_map_before_and_after(full, smooth(full), world.truth)
    left, right = figure.axes
    assert left.get_xlim() == right.get_xlim()
    for ax in (left, right):
        assert ax.get_aspect() == 1.0
        assert ax.get_xlabel() == "x [m]"
        ellipses, of_poses = (child for child in ax.collections if isinstance(child, EllipseCollection))
        assert len(ellipses.get_offsets()) > 5
        assert len(of_poses.get_offsets()) == 16
        assert " m" in ax.get_title()


def test_sparsity_shows_every_block_of_the_matrix_and_of_its_factor(full):
    information = posterior(full).information
    own, (row, column), size = block_patterns(information)
    assert size == len(information.eps) + len(information.d)
    dense = np.zeros((size, size), dtype=bool)
    dense[own] = True
    # The factor of the matrix permuted as it was eliminated, symbolically.
    factor = np.zeros((size, size), dtype=bool)
    factor[row, column] = True
    assert not np.triu(dense, 1).any()
    assert not np.triu(factor, 1).any()
    assert len(row) == factor.sum() >= dense.sum()
    for j in range(size):
        below = np.flatnonzero(factor[j + 1 :, j]) + j + 1
        assert factor[np.ix_(below, below)][np.tril_indices(len(below))].all()  # elimination fills in
    for ax, count in zip(plot_sparsity(information).axes, (dense.sum(), factor.sum()), strict=True):
        assert f"{count:,} blocks" in ax.get_title()
        assert ax.get_xlabel()
