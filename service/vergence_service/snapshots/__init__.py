"""Snapshots of streams outside of the server, so that another server can resume them.

Read ``snapshot`` first, then ``saver``, then ``store`` and ``redis_store``.
"""
