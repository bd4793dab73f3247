"""The filter against the rows that it has conditioned on, frozen where it linearised them."""

import numpy as np

from ekfslam.smoother.problem import BatchProblem
from ekfslam.smoother.revival import filter_covariance
from ekfslam.smoother.sparse.information import JointInformation


def assert_equal_to_frozen_rows(ekf):
    """Blocks, landmarks and the whole covariance, to 1e-8 of their standard deviations or better."""
    problem = BatchProblem(ekf.log(), ekf.model)
    information, unknowns = JointInformation(problem.as_filtered()), problem.unknowns
    landmarks, layout = ekf.table.log_row, ekf.model.layout
    found = np.zeros(layout.body)
    found[unknowns.frame_columns] = information.eps[-1]
    found[unknowns.aux_columns], found[unknowns.drive_columns] = (
        unknowns.aux_mean + information.aux[-1],
        information.drive,
    )
    by = problem.observations.frozen_views.by
    for name, frame in (("view", -1), ("previous_view", -2)):
        if name in layout:
            of_frame = found.copy()
            of_frame[unknowns.frame_columns] = information.eps[frame]
            found[layout[name]] = by[frame] @ of_frame[: layout.seen]
    np.testing.assert_allclose(found, ekf.coordinates, atol=1e-8)
    np.testing.assert_allclose(
        problem.log.first_position_m[landmarks] + information.d[landmarks], ekf.positions_m, atol=1e-8
    )
    P = filter_covariance(ekf.model, unknowns, information, problem.log.frames - 1, landmarks, by)
    std = np.sqrt(np.diag(ekf.P))
    assert (np.abs(P - ekf.P) <= 1e-8 * np.outer(std, std)).all()
    assert (std > 0).all()
