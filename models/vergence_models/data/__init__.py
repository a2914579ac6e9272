"""Synthetic stereo video with exact ground truth: scenes, rendering, sensor, pools."""
