"""Training: noise, loss, one plain loop per network, checkpoints."""
