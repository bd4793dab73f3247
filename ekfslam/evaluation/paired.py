"""Paired tests: whether two estimators or settings differ on the same recordings."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from ekfslam.arrays import Array
from ekfslam.evaluation.tables import Column, Grid

LEAST_PAIRS = 6  # the Wilcoxon test of five pairs never comes below a p value of 0.05
_MOST_CHOICES = 4  # of more, those that differ in one part are compared
_MOST_PAIRS = 15  # of more, each choice is compared with the first only
_ANY = "-"  # the part of a choice that does not know a setting
_TESTS = {"paired t": "p_t", "Wilcoxon": "p_wilcoxon"}


class Paired(NamedTuple):
    """Differences b - a of n pairs: mean, its standard error, two-sided p values of both tests (NaN if all are 0)."""

    n: int
    mean: float
    error: float
    p_t: float
    p_wilcoxon: float


def paired_test(a: Array, b: Array) -> Paired | None:
    """Return the paired t test and the Wilcoxon signed-rank test of values (n,); None of fewer than six pairs.

    Pairs with a missing value (NaN) do not count.
    """
    from scipy import stats

    difference = (b - a)[np.isfinite(a) & np.isfinite(b)]
    n = len(difference)
    if n < LEAST_PAIRS:
        return None
    error = float(difference.std(ddof=1) / np.sqrt(n))
    p_t = p_wilcoxon = np.nan
    if difference.any():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of zeros and ties, for which scipy approximates
            p_t = float(stats.ttest_1samp(difference, 0.0).pvalue)
            p_wilcoxon = float(stats.wilcoxon(difference).pvalue)
    return Paired(n, float(difference.mean()), error, p_t, p_wilcoxon)


def paired_grid(
    figures: Mapping[str, Mapping[tuple[str, ...], Mapping[Any, float]]],
) -> tuple[Grid | None, tuple[str, ...]]:
    """Return the tests of all figures, and sentences on comparisons that are not possible.

    Args:
        figures: Heading of the figure, parts of the choice (estimator and settings, ``-`` for those that it does not
            know), and recording with seed, to the value.
    """
    rows, tested, short = list[tuple[str, str, str]](), list[Paired](), dict[int, list[str]]()
    for heading, choices in figures.items():
        for first, second in _compared(list(choices))[0]:
            both = [key for key in choices[first] if key in choices[second]]
            a, b = (np.array([choices[name][key] for key in both], dtype=float) for name in (first, second))
            found = paired_test(a, b)
            if found is not None:
                rows.append((heading, _label(first), _label(second)))
                tested.append(found)
            elif not both or (np.isfinite(a).any() and np.isfinite(b).any()):  # else one of them has no such figure
                n = int((np.isfinite(a) & np.isfinite(b)).sum())
                short.setdefault(n, []).append(f"{_label(first)} and {_label(second)}")
    said = tuple(
        f"{n} pairs are not enough for a test, {LEAST_PAIRS} are needed: {'; '.join(dict.fromkeys(names))}"
        for n, names in short.items()
    )
    if not rows:
        return None, said
    texts = [Column(name, [row[i] for row in rows]) for i, name in enumerate(("figure", "a", "b"))]
    difference = Column("b - a", [f.mean for f in tested], [f.error for f in tested], is_mixed=True)
    tests = [Column(f"p, {n}", [getattr(f, p) for f in tested], is_mixed=True) for n, p in _TESTS.items()]
    words = "Each p value is of one test, two-sided; ± is the standard error over pairs."
    words += "".join({how: "" for choices in figures.values() if (how := _compared(list(choices))[1])})
    return Grid([*texts, Column("pairs", [f.n for f in tested]), difference, *tests], notes=(words, *said)), said


def _label(choice: tuple[str, ...]) -> str:
    return ", ".join(part for part in choice if part != _ANY)


def _compared(choices: list[tuple[str, ...]]) -> tuple[list[tuple[tuple[str, ...], tuple[str, ...]]], str]:
    """Return the pairs of choices to be compared, and how they were chosen; nothing if all are compared."""
    pairs = list(combinations(choices, 2))
    if len(choices) <= _MOST_CHOICES:
        return pairs, ""
    near = [pair for pair in pairs if sum(a != b and _ANY not in (a, b) for a, b in zip(*pair, strict=True)) <= 1]
    if len(near) <= _MOST_PAIRS:
        return near, " Only choices that differ in one part are compared." if len(near) < len(pairs) else ""
    return [(choices[0], other) for other in choices[1:]], " Each choice is compared with the first only."
