"""Names that both sides spell the same way: metadata keys and Zenoh key expressions."""

# gRPC metadata of every StreamDepth call: a proxy in front of several servers hashes it, so that
# a stream's frames always reach the server that holds its state.
STREAM_ID_METADATA = "x-stream-id"
