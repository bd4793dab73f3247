"""How good an estimate is: trajectory errors, consistency (NEES, NIS bounds), and the summary of a run."""
