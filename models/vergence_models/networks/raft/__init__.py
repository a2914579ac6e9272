"""The `full` and `fast` tiers: RAFT-Stereo's realtime network, carried through time by a warp."""
