"""The `lite` tier: our network, made for CPUs."""
