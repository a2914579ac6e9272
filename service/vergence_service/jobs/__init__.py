"""Uploaded sequences: they are queued, stepped one after the other and kept as results.

Read ``job`` and ``queue`` (admission) first, then ``worker``, ``run`` and ``stepping`` (the work),
then ``registry``, ``store``, ``checkpoints`` and ``results`` (memory and disk). ``archives``,
``upload_checks`` and ``sources`` examine uploads.
"""
