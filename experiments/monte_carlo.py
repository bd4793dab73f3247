"""Do the error bars hold what they promise? A Monte Carlo study of the filter's variants.

A covariance P is honest if the error e of the estimate is as large as P says, on average over many drives:

    NEES = e^T P^-1 e,    mean over runs = degrees of freedom (pose 6, landmark 3).

The error must be taken in the coordinates that P is of. For all variants that is ``xi`` with
``T_imu_world = exp(xi^) T_hat`` for the pose; for a landmark it is ``d = m - m_hat`` for the standard and the
first-estimates filter, and for the invariant filter, whose error turns the map with the pose,

    m = exp(e_theta) m_hat + J_l(e_theta) e,    d = e - m_hat^ e_theta,                       cf. (7)

with e_theta the rotation error of the pose at the same time. The frames of one run are strongly correlated; only runs
are independent. So every run counts once, and what follows ``±`` is three standard errors over runs.

Four levels of the same ring road, two rounds each: a good rig (`low`), an average one (`mid`), a very poor one
(`high`), and a first heading that is known to 15 degrees only (`large-heading`). All variants see the same data. The
standard filter gains information about its heading that no measurement holds, and its NEES grows round after round.

A study that was interrupted goes on where it was.

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
