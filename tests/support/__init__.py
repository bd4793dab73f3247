"""Shared helpers of the tests: worlds, recordings, second filters, comparisons."""
