"""The HTTP API. Read ``app``, then the routes: ``pairs``, ``sequences`` and ``streams``.

``uploads`` and ``forms`` receive files; ``errors`` translates errors to statuses.
"""
