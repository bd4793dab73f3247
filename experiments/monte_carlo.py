"""Test the consistency of the filter's variants in a Monte Carlo study.

A covariance P is honest if the error e of the estimate is as large as P says, on average over many drives:

    NEES = e^T P^-1 e,    mean over runs = degrees of freedom (pose 6, landmark 3).

The error must be in the coordinates of P. For the pose of all variants that is ``xi`` with
``T_imu_world = exp(xi^) T_hat``. For a landmark it is ``d = m - m_hat`` in the standard and first-estimates filters.
The error of the invariant filter turns the map with the pose,

    m = exp(e_theta) m_hat + J_l(e_theta) e,    d = e - m_hat^ e_theta,                       cf. (7)

with e_theta the rotation error of the pose at the same time. The frames of one run are strongly correlated, and only
runs are independent. So every run counts once, and ``±`` is three standard errors over runs.

Four levels of the same ring road, two rounds each: a good rig (`low`), an average one (`mid`), a very poor one
(`high`), and a first heading that is known to 15 degrees only (`large-heading`). All variants see the same data. The
standard filter gains information about its heading that no measurement holds, so its NEES grows round after round.

An interrupted study resumes.

    python experiments/monte_carlo.py [--runs N] [--out DIR]
"""

from __future__ import annotations

from common import argument_parser

from ekfslam.reports import check_consistency
from ekfslam.studies.study import LEVELS, STUDY_VARIANTS, Study


def main() -> None:
    parser = argument_parser(__doc__, "consistency")
    parser.add_argument("--runs", type=int, default=50, metavar="N", help="of each level (default: %(default)s)")
    parsed = parser.parse_args()
    study = Study(LEVELS, STUDY_VARIANTS, parsed.runs)
    print(check_consistency(study, parsed.out).table)


if __name__ == "__main__":  # the worker processes import this file
    main()
