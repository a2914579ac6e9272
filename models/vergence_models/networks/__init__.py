"""The networks: one recurrent step takes a stereo pair and a state to disparity and the next state.

`base` is the interface, `lite` our network for CPUs, `raft` the networks of the paper.
"""
