"""Which form of the kernels runs: ``compiled``, or ``plain`` where there was no compiler or the environment says so."""

from __future__ import annotations

import os

FORM = "plain"
if os.environ.get("EKFSLAM_KERNELS", "") != "plain":
    try:
        from ekfslam.kernels import _compiled  # noqa: F401
    except ImportError:
        pass
    else:
        FORM = "compiled"
