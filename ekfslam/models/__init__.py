"""What is believed: state blocks, sensors, noise."""
