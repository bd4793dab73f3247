"""Comparison of nested results, bit for bit."""

from __future__ import annotations

import dataclasses

import numpy as np


def assert_same(a, b, where: str = "", apart: tuple[str, ...] = ()) -> None:
    """Equal bit for bit, in value and type, all through dataclasses, mappings and arrays, apart from some fields."""
    assert type(a) is type(b), where
    if dataclasses.is_dataclass(a):
        for f in dataclasses.fields(a):
            if f.name not in apart:
                assert_same(getattr(a, f.name), getattr(b, f.name), f"{where}.{f.name}", apart)
    elif isinstance(a, tuple):
        for i, (one, other) in enumerate(zip(a, b, strict=True)):
            assert_same(one, other, f"{where}[{i}]", apart)
    elif isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}[{key}]", apart)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype, where
        np.testing.assert_array_equal(a, b, err_msg=where)
    else:
        assert a == b, where
