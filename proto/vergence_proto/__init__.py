"""The contract between client, service and models: geometry, value types, errors, the wire."""
