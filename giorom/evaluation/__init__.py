"""Metrics, trivial predictions, rollouts and the comparison with MPM."""
