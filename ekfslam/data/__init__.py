"""Recordings: what a sequence is, its tracks, readers and simulated worlds."""
