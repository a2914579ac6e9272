"""The composition of the server, and the only package that reads the settings.

Read ``server`` first; ``http`` and ``zenoh`` build the parts that only one transport has.
"""
