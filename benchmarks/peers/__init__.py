"""Other implementations that benchmarks compare with; each is driven as its own training loop drives it."""
