"""How messages reach a server. A transport translates, and nothing else."""
