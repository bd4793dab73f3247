"""``python -m ekfslam`` is ``ekfslam``."""

import sys

from ekfslam.cli import main

if __name__ == "__main__":
    sys.exit(main())
