"""The `full` and `fast` tiers: the networks of the paper, after RAFT-Stereo."""
