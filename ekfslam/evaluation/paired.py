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
_MOST_CHOICES = 4  # of more, each is compared with the first only
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
    figures: Mapping[str, Mapping[str, Mapping[Any, float]]],
) -> tuple[Grid | None, tuple[str, ...]]:
    """Return the tests of all figures, and sentences on comparisons that are not possible.

    Args:
        figures: Heading of the figure, name of the choice, and recording with seed, to the value.
    """
    rows, tested, short = list[tuple[str, str, str]](), list[Paired](), dict[int, list[str]]()
    for heading, choices in figures.items():
        names = list(choices)
        pairs = list(combinations(names, 2)) if len(names) <= _MOST_CHOICES else [(names[0], n) for n in names[1:]]
        for first, second in pairs:
            both = [key for key in choices[first] if key in choices[second]]
            a, b = (np.array([choices[name][key] for key in both], dtype=float) for name in (first, second))
            found = paired_test(a, b)
            if found is None:
                n = int((np.isfinite(a) & np.isfinite(b)).sum())
                short.setdefault(n, []).append(f"{first} and {second}")
            else:
                rows.append((heading, first, second))
                tested.append(found)
    said = tuple(
        f"{n} pairs are not enough for a test, {LEAST_PAIRS} are needed: {', '.join(dict.fromkeys(names))}"
        for n, names in short.items()
    )
    if not rows:
        return None, said
    texts = [Column(name, [row[i] for row in rows]) for i, name in enumerate(("figure", "a", "b"))]
    difference = Column("b - a", [f.mean for f in tested], [f.error for f in tested], is_mixed=True)
    tests = [Column(f"p, {n}", [getattr(f, p) for f in tested], is_mixed=True) for n, p in _TESTS.items()]
    words = "Each p value is of one test, two-sided; ± is the standard error over pairs."
    if any(len(choices) > _MOST_CHOICES for choices in figures.values()):
        words += f" Of more than {_MOST_CHOICES} choices, each is compared with the first."
    return Grid([*texts, Column("pairs", [f.n for f in tested]), difference, *tests], notes=(words, *said)), said
