"""A path-traced stereo benchmark of indoor scenes: `python -m vergence_models.data.xrbench --help`.

A `Recipe` names everything that a sequence depends on; the same recipe gives the same sequence.
`rooms` builds the scene, `motion` the head's path, `tracer` asks Mitsuba 3 for light and first
hits, `truths` computes every ground truth from the hits, `effects` states what the camera of the
final pass does, `camera` films with all of them, and `writer` lays it out as SceneFlow does.

World axes: x right, y DOWN, z forward; the floor is y = 0. Metres, seconds.
"""
