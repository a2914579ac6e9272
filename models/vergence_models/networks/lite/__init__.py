"""The `lite` tier: the recurrence on an encoder made for CPUs."""
