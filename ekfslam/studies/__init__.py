"""Many runs: Monte Carlo studies and tuning."""
