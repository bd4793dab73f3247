"""State blocks, processes, sensors and noise."""
