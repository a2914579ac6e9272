"""``vergence.v1`` over Zenoh. Read ``server``, then ``call`` and ``errors``."""
