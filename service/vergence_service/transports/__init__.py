"""Transports translate, and nothing else: bytes to values, errors to statuses, calls to calls."""
