"""What a recording says about its inertial unit: the first state in motion, and the noise of the samples."""
