"""What client, service and models must agree on: geometry, value types, errors, bytes."""
