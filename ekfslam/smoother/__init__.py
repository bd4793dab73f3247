"""The joint posterior over all poses and landmarks."""
