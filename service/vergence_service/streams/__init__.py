"""Streams and their recurrent states: everything that a transport may ask for.

Read ``engine`` first, then ``stream``, ``table`` and ``continuity``, then ``conversion`` and
``rectify``.
"""
