"""Figures of results, posteriors and studies."""
