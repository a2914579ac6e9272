"""Zenoh, as client and server use it: keys, a session for asyncio, and a queue of messages."""
