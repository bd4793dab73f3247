"""One file a subcommand, see `ekfslam.cli`."""
