"""Kernels of a filter's frame: stacks of small matrices, one call for all landmarks that are seen.

There are two forms of the same functions. `ekfslam.kernels.plain` is NumPy, the readable one, and the oracle of the
other. `ekfslam.kernels.compiled` calls C, which an ordinary installation builds where there is a compiler; it spares
the dozens of NumPy calls that a frame would need. They equal each other to rounding. ``EKFSLAM_KERNELS=plain`` in the
environment chooses the first one; ``ekfslam info --build`` says which one runs.
"""

from __future__ import annotations

from ekfslam.kernels import plain
from ekfslam.kernels.chosen import FORM

if FORM == "compiled":
    from ekfslam.kernels import compiled as _form
else:
    from ekfslam.kernels import plain as _form  # type: ignore[no-redef]

whiten = _form.whiten
own_variances = _form.own_variances
given_others = _form.given_others
correct = _form.correct
change = _form.change
moved_by_image = _form.moved_by_image
change_by_image = _form.change_by_image
normalised_squares = _form.normalised_squares
squares_given_others = _form.squares_given_others
whitened = _form.whitened

__all__ = [
    "FORM",
    "change",
    "change_by_image",
    "correct",
    "given_others",
    "moved_by_image",
    "normalised_squares",
    "own_variances",
    "plain",
    "squares_given_others",
    "whiten",
    "whitened",
]
