"""The ``vergence`` command, which needs the extra ``vergence[cli]``; the SDK does not."""
