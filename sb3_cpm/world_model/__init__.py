"""DreamerV2 in PyTorch: the world model and the actor-critics trained in its imagination (report, B.1)."""
