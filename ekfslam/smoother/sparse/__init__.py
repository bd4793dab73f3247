"""Sparse linear algebra of the batch problem."""
