"""Transports translate bytes to values, errors to statuses and calls to calls; they decide nothing.

Read ``stream_call`` first (one StreamDepth call, for every transport), then ``mailbox``, ``outbox``
and ``open_calls``, then one of ``grpc``, ``http`` and ``zenoh``.
"""
