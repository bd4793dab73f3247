"""Pure maths: rigid motions, the stereo camera, motion over an interval."""
